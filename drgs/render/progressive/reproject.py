"""A camera's move takes along what was already known: the temporal half of SVGF.

In: the picture before the move with the samples behind each pixel, and what the camera sees now. Out: for each pixel what the picture
before says about it, and how many samples that is worth. A point of the surface is looked up where the old camera saw it, among the four pixels
around that place; one that lies off the point's tangent plane, too far along it, or faces elsewhere shows another surface and is rejected. Both parts
are kept demodulated. Specular light moves over the surface with the camera: its samples are worth
less the more the view has turned in units of the lobe's width, and nothing on a mirror.

History only helps a frame begin: its worth is at most MOST_SAMPLES and fades to nothing at FADE_SAMPLES of the frame's own, so a frame
that is left alone is the plain mean. After any other change than the camera's (an edit, another light) there is no history at all.

Source: Schied et al. 2017, section 4.1; we weigh by samples instead of a fixed share, and take no filtered colour back. Twin:
drgs/reference/reproject.py.
"""

from typing import Any

import warp as wp
from torch import Tensor

from drgs.render.integrate.brdf_warp import alpha_of
from drgs.render.progressive.demodulate_albedo import demodulate_albedo, diffuse_reflectance, mean_square, specular_reflectance
from drgs.render.records import DemodulatedLight, GBuffer, History, Radiance, Reprojected
from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_device, warp_view

wp.set_module_options({"enable_backward": False})

MOST_SAMPLES = 64.0
"""What a pixel's history is worth at most [samples]: more would let old errors live long."""
FADE_SAMPLES = wp.constant(256.0)
"""A frame's own samples after which history counts for nothing."""
PLANE = wp.constant(2.0)
"""Largest distance of an old point from the new one's tangent plane [pixel footprints at its distance]."""
SPREAD = wp.constant(2.0)
"""Largest distance of an old point from the new one, seen face on [pixel footprints]: the planes of two surfaces may be one."""
GRAZING = wp.constant(0.1)
"""Cosine towards the old camera below which a point was hardly seen."""
FACING = wp.constant(0.9)
"""Smallest cosine between old and new normal."""
LOBE = wp.constant(4.0)
"""Specular samples fall by exp(-(LOBE angle / alpha)^2) when the view turns by `angle`."""


@wp.struct
class PinholeArrays:
    """Camera as kernels see it."""

    width: int
    height: int
    camera_from_world: wp.mat44
    intrinsics: wp.mat33
    center: wp.vec3
    """In the world."""


@wp.struct
class SurfaceMaps:
    """The part of a GBuffer that says where surfaces are, and how the view turns their highlights."""

    coverage: wp.array2d[float]
    position: wp.array2d[wp.vec3]
    normal: wp.array2d[wp.vec3]
    wo: wp.array2d[wp.vec3]
    roughness: wp.array2d[float]


@wp.struct
class LightMaps:
    """DemodulatedLight and the samples behind it."""

    diffuse: wp.array2d[wp.vec3]
    specular: wp.array2d[wp.vec3]
    variance: wp.array2d[wp.vec2]
    samples: wp.array2d[wp.vec2]


@wp.struct
class OldLight:
    """What a picture before says about one point of the surface."""

    diffuse: wp.vec3
    specular: wp.vec3
    variance: wp.vec2
    samples: wp.vec2
    """That this is worth; 0 where nothing is known."""


@wp.func
def look_up(
    here: wp.vec3,
    n: wp.vec3,
    wo: wp.vec3,
    roughness: float,
    old_camera: PinholeArrays,
    old_surface: SurfaceMaps,
    old_light: LightMaps,
    most_samples: float,
) -> OldLight:
    """Of a point with its normal, the direction it is seen from, and its roughness."""
    found = OldLight()
    in_camera = wp.transform_point(old_camera.camera_from_world, here)
    if in_camera[2] <= 0.0:
        return found
    on_screen = old_camera.intrinsics * in_camera
    u = on_screen[0] / on_screen[2] - 0.5
    v = on_screen[1] / on_screen[2] - 0.5
    column = int(wp.floor(u))
    row = int(wp.floor(v))
    if column < -1 or row < -1 or column >= old_camera.width or row >= old_camera.height:
        return found
    footprint = in_camera[2] / old_camera.intrinsics[0, 0]
    reach = PLANE * footprint
    towards_old = wp.dot(n, wp.normalize(old_camera.center - here))
    if towards_old <= GRAZING:
        return found
    spread = SPREAD * footprint / wp.max(towards_old, 0.25)
    sum_d = wp.vec3(0.0, 0.0, 0.0)
    sum_s = wp.vec3(0.0, 0.0, 0.0)
    sum_variance = wp.vec2(0.0, 0.0)
    sum_samples = wp.vec2(0.0, 0.0)
    weights = wp.float32(0.0)
    for tap in range(4):
        dx = tap % 2
        dy = tap // 2
        qx = column + dx
        qy = row + dy
        if qx >= 0 and qy >= 0 and qx < old_camera.width and qy < old_camera.height:
            apart = old_surface.position[qy, qx] - here
            near = wp.abs(wp.dot(n, apart)) <= reach and wp.length(apart) <= spread
            if near and old_surface.coverage[qy, qx] > 0.0 and wp.dot(n, old_surface.normal[qy, qx]) >= FACING:
                w = wp.abs(1.0 - float(dx) - (u - float(column))) * wp.abs(1.0 - float(dy) - (v - float(row)))
                sum_d += w * old_light.diffuse[qy, qx]
                sum_s += w * old_light.specular[qy, qx]
                sum_variance += w * old_light.variance[qy, qx]
                sum_samples += w * old_light.samples[qy, qx]
                weights += w
    if weights < 0.05:
        return found
    # The lobe of a rougher surface forgives a larger turn.
    alpha = alpha_of(roughness)
    turned = wp.length(wo - wp.normalize(old_camera.center - here))
    still = wp.exp(-wp.min((LOBE * turned / alpha) * (LOBE * turned / alpha), 80.0))
    worth = sum_samples / weights
    found.diffuse = sum_d / weights
    found.specular = sum_s / weights
    found.variance = sum_variance / weights
    found.samples = wp.vec2(wp.min(worth[0], most_samples), still * wp.min(worth[1], most_samples))
    return found


@wp.kernel
def look_up_history(
    first: int,
    width: int,
    surface: SurfaceMaps,
    old_camera: PinholeArrays,
    old_surface: SurfaceMaps,
    old_light: LightMaps,
    most_samples: float,
    # outputs
    light: LightMaps,
):
    i = first + wp.tid()
    y = i / width
    x = i - y * width
    light.diffuse[y, x] = wp.vec3(0.0, 0.0, 0.0)
    light.specular[y, x] = wp.vec3(0.0, 0.0, 0.0)
    light.variance[y, x] = wp.vec2(0.0, 0.0)
    light.samples[y, x] = wp.vec2(0.0, 0.0)
    if surface.coverage[y, x] <= 0.0:
        return
    here = surface.position[y, x]
    found = look_up(here, surface.normal[y, x], surface.wo[y, x], surface.roughness[y, x], old_camera, old_surface, old_light, most_samples)
    light.diffuse[y, x] = found.diffuse
    light.specular[y, x] = found.specular
    light.variance[y, x] = found.variance
    light.samples[y, x] = found.samples


@wp.func
def faded(samples: float) -> float:
    """What is left of history's worth beside so many of the frame's own samples."""
    return wp.max(1.0 - samples / FADE_SAMPLES, 0.0)


@wp.func
def history_share(worth: float, samples: float) -> float:
    """Of the mean of a frame's own samples and of history that is worth so many."""
    left = worth * faded(samples)
    return left / wp.max(left + samples, 1.0e-6)


@wp.kernel
def add_history(
    first: int,
    width: int,
    samples: wp.array2d[wp.vec2],
    albedo: wp.array2d[wp.vec3],
    metallic: wp.array2d[float],
    old: LightMaps,
    # in and out
    diffuse: wp.array2d[wp.vec3],
    specular: wp.array2d[wp.vec3],
    diffuse_variance: wp.array2d[float],
    specular_variance: wp.array2d[float],
):
    i = first + wp.tid()
    y = i / width
    x = i - y * width
    worth = old.samples[y, x]
    d = diffuse_reflectance(albedo[y, x], metallic[y, x])
    share = history_share(worth[0], samples[y, x][0])
    diffuse[y, x] = (1.0 - share) * diffuse[y, x] + share * wp.cw_mul(old.diffuse[y, x], d)
    diffuse_variance[y, x] = (1.0 - share) * (1.0 - share) * diffuse_variance[y, x] + share * share * old.variance[y, x][0] * mean_square(d)
    s = specular_reflectance(albedo[y, x], metallic[y, x])
    share = history_share(worth[1], samples[y, x][1])
    specular[y, x] = (1.0 - share) * specular[y, x] + share * wp.cw_mul(old.specular[y, x], s)
    specular_variance[y, x] = (1.0 - share) * (1.0 - share) * specular_variance[y, x] + share * share * old.variance[y, x][1] * mean_square(
        s
    )


def reproject(history: History, gbuffer: GBuffer, camera: Camera) -> Reprojected:
    """What the picture before says about each pixel of the present view."""
    height, width = gbuffer.coverage.shape
    diffuse, specular, variance, samples = (gbuffer.coverage.new_empty(height, width, channels) for channels in (3, 3, 2, 2))
    found = Reprojected(DemodulatedLight(diffuse, specular, variance), samples)
    launch(
        look_up_history,
        height * width,
        [
            width, surface_maps(gbuffer), pinhole_arrays(history.camera, history.gbuffer), surface_maps(history.gbuffer),
            light_maps(history), MOST_SAMPLES,
        ],
        [light_maps(found)],
        warp_device(gbuffer.coverage),
    )  # fmt: skip
    return found


def blend_history(radiance: Radiance, reprojected: Reprojected, gbuffer: GBuffer, samples: Tensor) -> None:
    """Make a frame's own mean the mean of that and of what history is worth, in place.

    Args:
        samples: (height, width, 2) behind the diffuse and the specular part of the frame's own mean.
    """
    assert radiance.diffuse_variance is not None and radiance.specular_variance is not None
    height, width = gbuffer.coverage.shape
    launch(
        add_history,
        height * width,
        [width, warp_view(samples, wp.vec2), warp_view(gbuffer.albedo, wp.vec3), warp_view(gbuffer.metallic), light_maps(reprojected)],
        [
            warp_view(radiance.diffuse, wp.vec3), warp_view(radiance.specular, wp.vec3),
            warp_view(radiance.diffuse_variance), warp_view(radiance.specular_variance),
        ],
        warp_device(samples),
    )  # fmt: skip


def remember(radiance: Radiance, gbuffer: GBuffer, camera: Camera, samples: Tensor, reprojected: Reprojected | None) -> History:
    """A picture as history of the next.

    Args:
        radiance: with history blended in, not filtered. samples: (height, width, 2) of the frame's own, of both parts.
        reprojected: the history that was blended in.
    """
    behind = samples
    if reprojected is not None:
        behind = samples + reprojected.samples * (1 - samples / FADE_SAMPLES).clamp(min=0)
    return History(camera, gbuffer, demodulate_albedo(radiance, gbuffer), behind)


def brighten_light(light: DemodulatedLight, factor: float) -> DemodulatedLight:
    """The same under an environment `factor` times as strong."""
    return DemodulatedLight(light.diffuse * factor, light.specular * factor, light.variance * factor**2)


def pinhole_arrays(camera: Camera, gbuffer: GBuffer) -> Any:
    """The camera of a picture with these maps."""
    arrays = PinholeArrays()
    arrays.height, arrays.width = gbuffer.coverage.shape
    arrays.camera_from_world = wp.mat44(*camera.camera_from_world.flatten().tolist())
    arrays.intrinsics = wp.mat33(*camera.intrinsics.flatten().tolist())
    arrays.center = wp.vec3(*camera.center_world.tolist())
    return arrays


def surface_maps(gbuffer: GBuffer) -> Any:
    """The struct that kernels read; shares memory with the tensors."""
    maps = SurfaceMaps()
    maps.coverage, maps.roughness = warp_view(gbuffer.coverage), warp_view(gbuffer.roughness)
    maps.position, maps.normal = warp_view(gbuffer.position_world, wp.vec3), warp_view(gbuffer.normal_world, wp.vec3)
    maps.wo = warp_view(gbuffer.wo_world, wp.vec3)
    return maps


def light_maps(picture: History | Reprojected) -> Any:
    """The struct that kernels read and write; shares memory with the tensors."""
    maps, light = LightMaps(), picture.light
    maps.diffuse, maps.specular = warp_view(light.diffuse, wp.vec3), warp_view(light.specular, wp.vec3)
    maps.variance, maps.samples = warp_view(light.variance, wp.vec2), warp_view(picture.samples, wp.vec2)
    return maps
