"""What a mesh would look like if nothing of it were in the way of light: no shadows, nothing mirrored but the environment; our BRDF, and glTF's.

In: a posed scene and a camera. Out: linear radiance. Between this picture and ours lies what a file of surfaces cannot say; between its two
halves lies what two BRDFs make of the same numbers.
Sources: drgs/convert/gltf_reflectance.py's.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.convert.gltf_reflectance import brdf_factors, gltf_base_color, gltf_even_share
from drgs.maths.constants import VOID_ORIGIN
from drgs.render.integrate.choose_integrator import choose_integrator
from drgs.render.integrate.environment_table import build_environment_table, environment_light
from drgs.render.integrate.integrator import IntegratorSettings
from drgs.render.integrate.sample_rays import sample_counts
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.records import RayStarts, ShadingPoints
from drgs.render.visible.trace_primary import trace_primary_points
from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedScene

SAMPLES_A_PASS = 16
"""Each pass looks through another place of the pixel."""


@dataclass(frozen=True, eq=False)
class OpenPictures:
    """Of one camera; means over what covers a pixel, 0 where nothing does."""

    ours: Float[Tensor, "height width 3"]
    gltf: Float[Tensor, "height width 3"]
    """Of the base colours that exported files have."""


def shade_open(scene: PosedScene, camera: Camera, samples_per_pixel: int, seed: int = 0) -> OpenPictures:
    """Linear radiance under the scene's environment."""
    tracer = build_tracer(scene.mesh)
    integrator = choose_integrator(tracer)
    table = build_environment_table(scene.environment)
    light = environment_light(table, scene.environment_rotation_degrees, scene.environment_intensity)
    how = IntegratorSettings(sample_counts(SAMPLES_A_PASS), seed=seed)
    sums = torch.zeros(camera.height * camera.width, 7)
    for index in range(max(1, samples_per_pixel // SAMPLES_A_PASS)):
        points = trace_primary_points(tracer, camera, seed, index).points
        # From beyond the scene rays meet nothing, and the environment is equally far from everywhere.
        starts = RayStarts(torch.full_like(points.position_world, VOID_ORIGIN), points.normal_world)
        found = integrator.shade(points, starts, light, how, index)
        white = replace(points, albedo=torch.ones_like(points.albedo), metallic=torch.zeros_like(points.metallic))
        irradiance = integrator.shade(white, starts, light, how, index).diffuse
        written = replace(points, albedo=gltf_base_color(points.albedo, points.roughness, points.metallic))
        mirrored = integrator.shade(written, starts, light, how, index).specular
        both = [found.diffuse + found.specular, gltf_radiance(written, mirrored, irradiance), torch.ones(len(irradiance), 1)]
        sums.index_add_(0, points.pixel.long(), torch.cat(both, -1))
    mean = (sums[:, :6] / sums[:, 6:].clamp(min=1)).reshape(camera.height, camera.width, 6)
    return OpenPictures(mean[..., :3].contiguous(), mean[..., 3:].contiguous())


def gltf_radiance(
    points: ShadingPoints, specular: Float[Tensor, "point 3"], irradiance: Float[Tensor, "point 3"]
) -> Float[Tensor, "point 3"]:
    """What glTF's BRDF sends back.

    Args:
        specular: reflected radiance of the surface met once, the part that both BRDFs share.
        irradiance: over pi: what a white matt surface would send back.
    """
    factors = brdf_factors((points.normal_world * points.wo_world).sum(-1), points.roughness)
    return specular + gltf_even_share(points.albedo, factors, points.metallic[:, None]) * irradiance
