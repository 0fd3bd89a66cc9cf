"""New materials for what the camera already sees: the geometry of the view stays as it is."""

from dataclasses import replace

import torch
import warp as wp

from drgs.render.intersect.mesh_surface import MeshArrays, mesh_arrays, surface_at
from drgs.render.records import GBuffer, PrimaryPoints, ShadingPoints
from drgs.render.visible.rasterize import rasterize_gbuffer
from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedSurfels
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


def refresh_gbuffer(gbuffer: GBuffer, surfels: PosedSurfels, camera: Camera) -> GBuffer:
    """The G-buffer of surfels that differ from those it was rasterised from in their materials only.

    The weights of surfels in pixels are not kept, so materials are blended anew; what rests on geometry (points, where their rays
    start, the rays met) is taken over.
    """
    fresh = rasterize_gbuffer(surfels, camera)
    return replace(gbuffer, albedo=fresh.albedo, roughness=fresh.roughness, metallic=fresh.metallic)


def refresh_points(points: ShadingPoints, gbuffer: GBuffer) -> ShadingPoints:
    """The same points with the materials of the G-buffer that they are pixels of."""
    pixel = points.pixel.long()
    return replace(
        points,
        albedo=gbuffer.albedo.reshape(-1, 3)[pixel],
        roughness=gbuffer.roughness.reshape(-1)[pixel],
        metallic=gbuffer.metallic.reshape(-1)[pixel],
    )


@wp.kernel
def materials_at(
    first: int,
    face: wp.array[int],
    barycentric: wp.array[wp.vec2],
    mesh: MeshArrays,
    # outputs
    albedo: wp.array[wp.vec3],
    roughness: wp.array[float],
    metallic: wp.array[float],
):
    i = first + wp.tid()
    surface = surface_at(mesh, face[i], barycentric[i])
    albedo[i] = surface.albedo
    roughness[i] = surface.roughness
    metallic[i] = surface.metallic


def refresh_primary(primary: PrimaryPoints, mesh: TriangleMesh) -> PrimaryPoints:
    """The same points of a mesh of the same shape with other materials."""
    face, barycentric = primary.starts.face, primary.barycentric
    assert face is not None and barycentric is not None
    albedo, roughness, metallic = (torch.empty_like(getattr(primary.points, name)) for name in ("albedo", "roughness", "metallic"))
    launch(
        materials_at,
        len(face),
        [warp_array(face), warp_array(barycentric, wp.vec2), mesh_arrays(mesh, 0.0)],
        [warp_array(albedo, wp.vec3), warp_array(roughness), warp_array(metallic)],
        warp_device(albedo),
    )
    return replace(primary, points=replace(primary.points, albedo=albedo, roughness=roughness, metallic=metallic))
