"""Light without the reflectance that textures carry, and with it again: what is left is smooth, and stays the same where the camera moves.

In: radiance of both parts with their variances, and the G-buffer. Out: light, the quotient. The diffuse part is divided by (1 - metallic)
albedo, the specular one by its reflectance at normal incidence. Source: Schied et al. 2017, section 4.2.
"""

from dataclasses import replace

import warp as wp

from drgs.maths.constants import F0
from drgs.render.records import DemodulatedLight, GBuffer, Radiance
from drgs.warp_torch import launch, warp_array, warp_device, warp_view

wp.set_module_options({"enable_backward": False})

MIN_REFLECTANCE = wp.constant(0.02)
"""Division by darker textures would only amplify noise."""


@wp.func
def diffuse_reflectance(albedo: wp.vec3, metallic: float) -> wp.vec3:
    return wp.max((1.0 - metallic) * albedo, wp.vec3(MIN_REFLECTANCE, MIN_REFLECTANCE, MIN_REFLECTANCE))


@wp.func
def specular_reflectance(albedo: wp.vec3, metallic: float) -> wp.vec3:
    f0 = metallic * albedo + wp.vec3(F0, F0, F0) * (1.0 - metallic)
    return wp.max(f0, wp.vec3(MIN_REFLECTANCE, MIN_REFLECTANCE, MIN_REFLECTANCE))


@wp.func
def mean_square(v: wp.vec3) -> float:
    return wp.dot(v, v) / 3.0


@wp.kernel
def demodulate_pixels(
    first: int,
    width: int,
    albedo: wp.array2d[wp.vec3],
    metallic: wp.array2d[float],
    diffuse: wp.array2d[wp.vec3],
    specular: wp.array2d[wp.vec3],
    diffuse_variance: wp.array2d[float],
    specular_variance: wp.array2d[float],
    # outputs
    diffuse_out: wp.array2d[wp.vec3],
    specular_out: wp.array2d[wp.vec3],
    variance_out: wp.array2d[wp.vec2],
):
    i = first + wp.tid()
    y = i / width
    x = i - y * width
    d = diffuse_reflectance(albedo[y, x], metallic[y, x])
    s = specular_reflectance(albedo[y, x], metallic[y, x])
    diffuse_out[y, x] = wp.cw_div(diffuse[y, x], d)
    specular_out[y, x] = wp.cw_div(specular[y, x], s)
    variance_out[y, x] = wp.vec2(diffuse_variance[y, x] / mean_square(d), specular_variance[y, x] / mean_square(s))


@wp.kernel
def remodulate_pixels(
    first: int,
    width: int,
    albedo: wp.array2d[wp.vec3],
    metallic: wp.array2d[float],
    diffuse: wp.array3d[float],
    specular: wp.array3d[float],
    variance: wp.array3d[float],
    # outputs
    diffuse_out: wp.array2d[wp.vec3],
    specular_out: wp.array2d[wp.vec3],
    diffuse_variance: wp.array2d[float],
    specular_variance: wp.array2d[float],
):
    i = first + wp.tid()
    y = i / width
    x = i - y * width
    d = diffuse_reflectance(albedo[y, x], metallic[y, x])
    s = specular_reflectance(albedo[y, x], metallic[y, x])
    diffuse_out[y, x] = wp.cw_mul(wp.vec3(diffuse[y, x, 0], diffuse[y, x, 1], diffuse[y, x, 2]), d)
    specular_out[y, x] = wp.cw_mul(wp.vec3(specular[y, x, 0], specular[y, x, 1], specular[y, x, 2]), s)
    diffuse_variance[y, x] = variance[y, x, 0] * mean_square(d)
    specular_variance[y, x] = variance[y, x, 1] * mean_square(s)


def demodulate_albedo(radiance: Radiance, gbuffer: GBuffer) -> DemodulatedLight:
    """Both parts over their reflectance, and the variance of their luminance.

    Raises:
        ValueError: the radiance carries no variance of its parts.
    """
    if radiance.diffuse_variance is None or radiance.specular_variance is None:
        raise ValueError("denoising needs the variance of the diffuse and specular part; this radiance carries none")
    height, width = gbuffer.coverage.shape
    diffuse, specular, variance = (radiance.diffuse.new_empty(height, width, channels) for channels in (3, 3, 2))
    launch(
        demodulate_pixels,
        height * width,
        [
            width, warp_view(gbuffer.albedo, wp.vec3), warp_view(gbuffer.metallic), warp_view(radiance.diffuse, wp.vec3),
            warp_view(radiance.specular, wp.vec3), warp_view(radiance.diffuse_variance), warp_view(radiance.specular_variance),
        ],
        [warp_array(diffuse, wp.vec3), warp_array(specular, wp.vec3), warp_array(variance, wp.vec2)],
        warp_device(diffuse),
    )  # fmt: skip
    return DemodulatedLight(diffuse, specular, variance)


def remodulate_albedo(light: DemodulatedLight, radiance: Radiance, gbuffer: GBuffer) -> Radiance:
    """The radiance with this light in place of its own."""
    height, width = gbuffer.coverage.shape
    diffuse, specular = (radiance.diffuse.new_empty(height, width, 3) for _ in range(2))
    diffuse_variance, specular_variance = (radiance.diffuse.new_empty(height, width) for _ in range(2))
    launch(
        remodulate_pixels,
        height * width,
        [
            width, warp_view(gbuffer.albedo, wp.vec3), warp_view(gbuffer.metallic),
            warp_view(light.diffuse), warp_view(light.specular), warp_view(light.variance),
        ],
        [warp_array(diffuse, wp.vec3), warp_array(specular, wp.vec3), warp_array(diffuse_variance), warp_array(specular_variance)],
        warp_device(diffuse),
    )  # fmt: skip
    return replace(radiance, diffuse=diffuse, specular=specular, diffuse_variance=diffuse_variance, specular_variance=specular_variance)
