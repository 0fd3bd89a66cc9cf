"""What the rays of a shading point brought, summed: outgoing light, how its samples scatter, and how open the sky is."""

from typing import Any

import torch
import warp as wp

from drgs.render.color_warp import luminance_of
from drgs.render.integrate.brdf_warp import PI
from drgs.render.integrate.sample_arrays import PointArrays, SampleSet
from drgs.render.integrate.sample_rays import point_at, split_at
from drgs.warp_torch import warp_array

wp.set_module_options({"enable_backward": False})


@wp.struct
class RaySamples:
    """What the rays of a batch bring, grouped by point; scratch."""

    cosine_weight: wp.array[float]
    """n.wi over the density of all strategies together; 0 for void rays."""
    specular: wp.array[wp.vec3]
    """Specular part of the BRDF, times that."""
    radiance: wp.array[wp.vec3]
    """The environment's."""
    blocked: wp.array[wp.bool]
    """Whether the ray meets a surface."""
    indirect: wp.array[wp.vec3]
    """Radiance that this surface sends back; read only with bounces."""


def ray_samples(count: int, device: torch.device) -> Any:
    """Space for what this many rays bring."""
    rays = RaySamples()
    rays.cosine_weight = warp_array(torch.empty(count, device=device))
    rays.specular, rays.radiance, rays.indirect = (warp_array(torch.empty(count, 3, device=device), wp.vec3) for _ in range(3))
    rays.blocked = warp_array(torch.empty(count, dtype=torch.bool, device=device))
    return rays


@wp.struct
class LightSums:
    """ShadedPoints as kernels write them."""

    diffuse: wp.array[wp.vec3]
    specular: wp.array[wp.vec3]
    variance: wp.array[wp.vec3]
    visibility: wp.array[float]
    indirect: wp.array[wp.vec3]
    """Empty unless it is asked for."""
    indirect_diffuse: wp.array[wp.vec3]
    """The same."""


@wp.func
def light_of_surfaces(diffuse_brdf: wp.vec3, first_ray: int, end: int, rays: RaySamples, bounces: int) -> wp.vec3:
    """What rays up to `end` bring that meet a surface. A loop of its own: who does not ask for it pays nothing."""
    total = wp.vec3(0.0, 0.0, 0.0)
    if bounces > 0:
        for ray in range(first_ray, end):
            if rays.blocked[ray]:
                incoming = rays.indirect[ray]
                total += rays.cosine_weight[ray] * wp.cw_mul(diffuse_brdf, incoming) + wp.cw_mul(rays.specular[ray], incoming)
    return total


@wp.func
def diffuse_light_of_surfaces(diffuse_brdf: wp.vec3, first_ray: int, end: int, rays: RaySamples, bounces: int) -> wp.vec3:
    """What is reflected diffusely of that."""
    total = wp.vec3(0.0, 0.0, 0.0)
    if bounces > 0:
        for ray in range(first_ray, end):
            if rays.blocked[ray]:
                total += rays.cosine_weight[ray] * wp.cw_mul(diffuse_brdf, rays.indirect[ray])
    return total


@wp.func
def sum_point(
    point: int,
    first_ray: int,
    points: PointArrays,
    samples: SampleSet,
    rays: RaySamples,
    bounces: int,
    # outputs
    sums: LightSums,
):
    """`first_ray` is the point's first in the arrays of rays."""
    diffuse_brdf = points.albedo[point] * ((1.0 - points.metallic[point]) / PI)
    diffuse_sum = wp.vec3(0.0, 0.0, 0.0)
    specular_sum = wp.vec3(0.0, 0.0, 0.0)
    variance = wp.vec3(0.0, 0.0, 0.0)
    open_sum = wp.float32(0.0)
    all_sum = wp.float32(0.0)
    split = split_at(samples, points, point)
    ray = wp.int32(first_ray)
    for strategy in range(3):
        size = split[strategy]
        total = wp.vec3(0.0, 0.0, 0.0)
        total_squares = wp.vec3(0.0, 0.0, 0.0)
        for _ in range(size):
            w = rays.cosine_weight[ray]
            incoming = rays.radiance[ray]
            all_sum += w
            if rays.blocked[ray]:
                incoming = wp.vec3(0.0, 0.0, 0.0)
                if bounces > 0:
                    incoming = rays.indirect[ray]
            else:
                open_sum += w
            d = w * wp.cw_mul(diffuse_brdf, incoming)
            s = wp.cw_mul(rays.specular[ray], incoming)
            ray += 1
            diffuse_sum += d
            specular_sum += s
            y = wp.vec3(luminance_of(d + s), luminance_of(d), luminance_of(s))
            total += y
            total_squares += wp.cw_mul(y, y)
        if size > 1:  # independent samples would scatter like this; stratified ones do better
            scatter = total_squares - wp.cw_mul(total, total) / float(size)
            variance += wp.max(scatter, wp.vec3(0.0, 0.0, 0.0)) * (float(size) / float(size - 1))
        else:
            variance += total_squares
    sums.diffuse[point] = diffuse_sum
    sums.specular[point] = specular_sum
    sums.variance[point] = variance
    if sums.indirect.shape[0] > 0:
        sums.indirect[point] = light_of_surfaces(diffuse_brdf, first_ray, ray, rays, bounces)
        sums.indirect_diffuse[point] = diffuse_light_of_surfaces(diffuse_brdf, first_ray, ray, rays, bounces)
    sums.visibility[point] = wp.where(all_sum > 0.0, open_sum / wp.max(all_sum, 1.0e-30), 1.0)


@wp.kernel
def sum_samples(
    first: int,
    points: PointArrays,
    samples: SampleSet,
    rays: RaySamples,
    bounces: int,
    # outputs
    sums: LightSums,
):
    """sum_point for the points that are meant, from the `first` on, whose rays the arrays hold."""
    i = wp.tid()
    count = samples.cosine + samples.ggx + samples.environment
    sum_point(point_at(points, first + i), i * count, points, samples, rays, bounces, sums)
