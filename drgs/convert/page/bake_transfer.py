"""What of any distant light arrives at the vertices of a mesh: its own shadows, and what it reflects onto itself.

In: a mesh. Out: for each vertex nine numbers whose product with the light's spherical harmonics is its irradiance over pi, so that light
can change and turn without a ray. Shadows are as soft as nine numbers hold; surfaces reflect the luminance of their albedo, diffusely.
Source: Sloan, Kautz and Snyder 2002 (docs/sources.md: sloan2002), for diffuse surfaces.
"""

import torch
from jaxtyping import Bool, Float, Int
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
    cosine = (directions @ mesh.normals.T).clamp(min=0)
    weight = cosine / cosine.sum(0).clamp(min=1e-6)
    met = _faces_met(mesh, directions, cosine > 0)
    direct = (weight * (met < 0)).T @ sh_basis(directions, DEGREE)
    ways = [(rows := (faces >= 0).nonzero().squeeze(1), faces[rows].long(), weight[k, rows, None]) for k, faces in enumerate(met)]
    faces = mesh.faces.long()
    reflectance = luminance(mesh.albedo)[faces].mean(1, keepdim=True)
    total = direct
    for _ in range(BOUNCES):
        sent = reflectance * total[faces].mean(1)
        total = direct.clone()
        for rows, seen, share in ways:
            total[rows] += share * sent[seen]
    return total


def _faces_met(
    mesh: TriangleMesh, directions: Float[Tensor, "direction 3"], facing: Bool[Tensor, "direction vertex"]
) -> Int[Tensor, "direction vertex"]:
    """First face on each vertex' way in each direction; -1 where there is none, and where `facing` is false."""
    tracer = build_tracer(mesh)
    origins = mesh.vertices + LIFTS * tracer.lift * mesh.normals
    met = torch.full(facing.shape, -1, dtype=torch.int32)
    for k, direction in enumerate(directions):
        rows = facing[k].nonzero().squeeze(1)
        met[k, rows] = trace_rays(origins[rows], direction.expand(len(rows), 3), tracer).face
    return met
