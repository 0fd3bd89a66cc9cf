"""New materials for what the camera already sees: the geometry of the view stays as it is."""

from dataclasses import replace

import torch

from drgs.render.records import GBuffer, PrimaryPoints, ShadingPoints
from drgs.render.visible.rasterize import rasterize_gbuffer
from drgs.scene.albedo_detail import detailed_albedo
from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedSurfels


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


def refresh_primary(primary: PrimaryPoints, mesh: TriangleMesh) -> PrimaryPoints:
    """The same points of a mesh of the same shape with other materials."""
    assert primary.starts.face is not None and primary.barycentric is not None
    corner = mesh.faces[primary.starts.face.long()].long()
    y, z = primary.barycentric.unbind(-1)
    weights = torch.stack([1 - y - z, y, z], -1)
    albedo = (weights[..., None] * mesh.albedo.detach()[corner]).sum(1)
    albedo = detailed_albedo(albedo, mesh.detail, mesh.faces, primary.starts.face, primary.barycentric)
    roughness, metallic = ((weights * values.detach()[corner]).sum(1) for values in (mesh.roughness, mesh.metallic))
    return replace(primary, points=replace(primary.points, albedo=albedo, roughness=roughness, metallic=metallic))
