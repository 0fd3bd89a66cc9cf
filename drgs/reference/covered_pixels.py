"""drgs/reconstruct/fit/surfels/covered_pixels.py as operations on whole maps, in any precision."""

from torch import Tensor

from drgs.render.visible.rasterize.gbuffer import face_camera
from drgs.scene.camera import Camera, pixel_rays_world


def covered_pixels(features: Tensor, coverage: Tensor, pixels: Tensor, camera: Camera) -> tuple[Tensor, ...]:
    """Normal, diffuse albedo, F0, roughness, residual and wo of each of the flat pixels."""
    values = features.flatten(1)[:, pixels] / coverage.flatten()[pixels].clamp(min=0.02)
    blended, diffuse, f0, roughness, residual = (plane.T for plane in values.split([3, 3, 3, 1, 3]))
    wo = -pixel_rays_world(camera)[1].reshape(-1, 3)[pixels].to(features)
    return face_camera(blended, wo), diffuse, f0, roughness[:, 0], residual, wo
