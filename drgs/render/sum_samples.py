"""What the rays of a shading point brought, summed: outgoing light, how its samples scatter, and how open the sky is."""

import warp as wp

from drgs.render.brdf_warp import PI
from drgs.render.sample_rays import PointArrays, SampleSet, split_at

wp.set_module_options({"enable_backward": False})


@wp.func
def luminance(c: wp.vec3) -> float:
    return 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]


@wp.func
def sum_point(
    point: int,
    first_ray: int,
    points: PointArrays,
    samples: SampleSet,
    cosine_weight: wp.array[float],
    specular: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
    blocked: wp.array[wp.bool],
    indirect: wp.array[wp.vec3],
    bounces: int,
    # outputs
    diffuse_out: wp.array[wp.vec3],
    specular_out: wp.array[wp.vec3],
    variance_out: wp.array[wp.vec3],
    visibility_out: wp.array[float],
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
            w = cosine_weight[ray]
            incoming = radiance[ray]
            all_sum += w
            if blocked[ray]:
                incoming = wp.vec3(0.0, 0.0, 0.0)
                if bounces > 0:
                    incoming = indirect[ray]
            else:
                open_sum += w
            d = w * wp.cw_mul(diffuse_brdf, incoming)
            s = wp.cw_mul(specular[ray], incoming)
            ray += 1
            diffuse_sum += d
            specular_sum += s
            y = wp.vec3(luminance(d + s), luminance(d), luminance(s))
            total += y
            total_squares += wp.cw_mul(y, y)
        if size > 1:  # independent samples would scatter like this; stratified ones do better
            scatter = total_squares - wp.cw_mul(total, total) / float(size)
            variance += wp.max(scatter, wp.vec3(0.0, 0.0, 0.0)) * (float(size) / float(size - 1))
        else:
            variance += total_squares
    diffuse_out[point] = diffuse_sum
    specular_out[point] = specular_sum
    variance_out[point] = variance
    visibility_out[point] = wp.where(all_sum > 0.0, open_sum / wp.max(all_sum, 1.0e-30), 1.0)


@wp.kernel
def sum_samples(
    first: int,
    points: PointArrays,
    samples: SampleSet,
    cosine_weight: wp.array[float],
    specular: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
    blocked: wp.array[wp.bool],
    indirect: wp.array[wp.vec3],
    bounces: int,
    # outputs
    diffuse_out: wp.array[wp.vec3],
    specular_out: wp.array[wp.vec3],
    variance_out: wp.array[wp.vec3],
    visibility_out: wp.array[float],
):
    """sum_point for the points from `first` on, whose rays the arrays hold."""
    i = wp.tid()
    count = samples.cosine + samples.ggx + samples.environment
    sum_point(
        first + i, i * count, points, samples, cosine_weight, specular, radiance, blocked, indirect, bounces,
        diffuse_out, specular_out, variance_out, visibility_out,
    )  # fmt: skip
