"""What of any distant light arrives at the vertices of a mesh: its own shadows, and what it reflects onto itself.

In: a mesh. Out: for each vertex nine numbers whose product with the light's spherical harmonics is its irradiance over pi, so that light
can change and turn without a ray. Shadows are as soft as nine numbers hold; surfaces reflect the luminance of their albedo, diffusely.
Source: Sloan, Kautz and Snyder 2002 (docs/sources.md: sloan2002), for diffuse surfaces.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.color import luminance
from drgs.maths.sampling import sphere_lattice
from drgs.maths.spherical_harmonics import sh_basis
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.scene.mesh import TriangleMesh

DEGREE = 2
DIRECTIONS = 256
"""The same for all vertices, so that what neighbours see differs by shape and not by chance; half of them rise above a surface."""
BOUNCES = 3
LIFTS = 10.0
"""How far rays start off the surface, in lifts of the tracer: vertex normals lean over the faces around them."""


def bake_transfer(mesh: TriangleMesh) -> Float[Tensor, "vertex 9"]:
    """Trace the mesh against itself from all its vertices; coefficients in the basis of drgs/maths/spherical_harmonics.py."""
    directions = sphere_lattice(DIRECTIONS).to(mesh.vertices)
    basis = sh_basis(directions, DEGREE)
    tracer = build_tracer(mesh)
    origins = mesh.vertices + LIFTS * tracer.lift * mesh.normals
    whole = sum((_cosines(mesh, direction) for direction in directions), torch.full((len(origins),), 1e-6))
    direct = torch.zeros(len(origins), basis.shape[1])
    # Of each direction: vertices that see the object itself, the faces that they see, and its weight.
    met: list[tuple[Tensor, Tensor, Tensor]] = []
    for direction, values in zip(directions, basis, strict=True):
        share = _cosines(mesh, direction) / whole
        rows = (share > 0).nonzero().squeeze(1)
        face = trace_rays(origins[rows], direction.expand(len(rows), 3), tracer).face
        open_rows, met_rows = rows[face < 0], rows[face >= 0]
        direct[open_rows] += share[open_rows, None] * values
        met.append((met_rows.int(), face[face >= 0], share[met_rows, None]))
    faces = mesh.faces.long()
    reflectance = luminance(mesh.albedo)[faces].mean(1, keepdim=True)
    total = direct
    for _ in range(BOUNCES):
        sent = reflectance * total[faces].mean(1)
        total = direct.clone()
        for rows, seen, share in met:
            total[rows] += share * sent[seen]
    return total


def open_transfer(mesh: TriangleMesh) -> Float[Tensor, "vertex 9"]:
    """The same of places that nothing is in the way of, by the same directions."""
    directions = sphere_lattice(DIRECTIONS).to(mesh.vertices)
    total, whole = torch.zeros(len(mesh.vertices), (DEGREE + 1) ** 2), torch.full((len(mesh.vertices), 1), 1e-6)
    for direction, values in zip(directions, sh_basis(directions, DEGREE), strict=True):
        cosines = _cosines(mesh, direction)[:, None]
        total, whole = total + cosines * values, whole + cosines
    return total / whole


def _cosines(mesh: TriangleMesh, direction: Float[Tensor, "3"]) -> Float[Tensor, "vertex"]:
    return (mesh.normals @ direction).clamp(min=0)
