"""What rays bring from surfaces that they meet, by the light that is kept there.

In: kept light, the mesh. Out: SurfaceLight, for the integrators. A ray that meets paint asks two more rays for what light falls there, a thing that
vertices already know: the environment's own part of their light, by sixteen rays or more, times what the surface reflects in all. A vertex is left to
rays where less than LEAST_DIFFUSE of what it reflects is diffuse, a face where it bends more than FLAT, or is wider than WIDEST. Where a vertex would do
but has no light yet, the rays write down that they asked for it.

For paths of one surface between the environment and the points; of longer ones the kept light would have to tell how long its own were.
"""

from weakref import WeakKeyDictionary

import torch
import warp as wp
from torch import Tensor

from drgs.maths.constants import F0
from drgs.render.integrate.surface_light import SurfaceLight
from drgs.render.intersect.mesh_surface import MeshArrays, mesh_arrays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.progressive.kept_light.kept_light import KeptArrays, KeptLight, kept_arrays
from drgs.render.progressive.kept_light.read_light import LEAST_DIFFUSE, is_fit
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

WIDEST = 1 / 48
"""Longest side of a face, as a share of the mesh's extent: six pixels of a picture that the mesh fills to two thirds."""

MEAN_FRESNEL = wp.constant(1 / 21)
"""Of (1 - cosine)^5 over the cosine-weighted hemisphere: Schlick's term, by which surfaces mirror more than they do face on."""


@wp.kernel
def mark_fit_faces(
    first: int,
    mesh: MeshArrays,
    widest: float,
    # outputs
    face_normal: wp.array[wp.vec3],
):
    i = first + wp.tid()
    a = mesh.faces[3 * i]
    b = mesh.faces[3 * i + 1]
    c = mesh.faces[3 * i + 2]
    face_normal[i] = wp.vec3(0.0, 0.0, 0.0)
    if is_fit(mesh, a, b, c, widest):
        face_normal[i] = wp.normalize(wp.cross(mesh.vertices[b] - mesh.vertices[a], mesh.vertices[c] - mesh.vertices[a]))


@wp.kernel
def send_light(
    first: int,
    mesh: MeshArrays,
    kept: KeptArrays,
    # outputs
    light: wp.array[wp.vec4],
):
    i = first + wp.tid()
    light[i] = wp.vec4(0.0, 0.0, 0.0, -1.0)
    rounds = float(kept.rounds[i])
    metallic = mesh.metallic[i]
    base = mesh.albedo[i]
    diffuse = (1.0 - metallic) * wp.max(base)
    if diffuse < LEAST_DIFFUSE * (diffuse + F0 * (1.0 - metallic) + metallic * wp.max(base)):
        return
    if rounds < 1.0:
        light[i] = wp.vec4(0.0, 0.0, 0.0, 0.0)
        return
    one = wp.vec3(1.0, 1.0, 1.0)
    facing = F0 * (1.0 - metallic) * one + metallic * base
    mirrored = facing + MEAN_FRESNEL * (one - facing)
    sent = wp.cw_mul(kept.direct[i] / rounds, (1.0 - metallic) * base + mirrored)
    light[i] = wp.vec4(sent[0], sent[1], sent[2], 1.0)


_fit_faces: WeakKeyDictionary[TriangleMesh, Tensor] = WeakKeyDictionary()
"""SurfaceLight.face_normal of meshes that live: it depends on neither camera nor light."""


def light_of_hits(kept: KeptLight, tracer: AbstractTracer) -> SurfaceLight:
    """What surfaces of the tracer's mesh are known to send."""
    mesh, device = tracer.mesh, warp_device(tracer.mesh.vertices)
    arrays = mesh_arrays(mesh, tracer.lift)
    if mesh not in _fit_faces:
        normals = torch.empty(len(mesh.faces), 3, device=mesh.vertices.device)
        launch(mark_fit_faces, len(mesh.faces), [arrays, WIDEST * tracer.extent], [warp_array(normals, wp.vec3)], device)
        _fit_faces[mesh] = normals
    vertex = torch.empty(len(mesh.vertices), 4, device=mesh.vertices.device)
    launch(send_light, len(mesh.vertices), [arrays, kept_arrays(kept)], [warp_array(vertex, wp.vec4)], device)
    return SurfaceLight(vertex, _fit_faces[mesh], torch.zeros(len(vertex), dtype=torch.bool, device=vertex.device))
