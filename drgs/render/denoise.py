"""Noise out of a frame without its edges: an edge-avoiding wavelet filter led by the variance of the samples.

In: radiance with the variance of its diffuse and specular part, G-buffer. Out: radiance. The spatial half of SVGF: both parts
are divided by the reflectance that textures carry, filtered in rounds of a 5 x 5 kernel with holes of 1, 2, 4, ... pixels,
and multiplied again. A neighbour counts for less the more it differs in normal, the farther it is off the pixel's tangent plane, and
the more its luminance differs in units of the standard deviation; where there is no variance nothing is blurred, so
the picture converges to the unfiltered mean as samples grow.

Source: Schied et al. 2017 (weights, variance update); Dammertz et al. 2010 (kernel). We measure distance to the
tangent plane instead of depth gradients, which splats make noisy. Twin: drgs/reference/denoise.py.
"""

from dataclasses import replace
from pathlib import Path
from typing import Literal

import torch
import warp as wp
from torch import Tensor

from drgs.render.records import GBuffer, Radiance
from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_array, warp_device, warp_view

wp.set_module_options({"enable_backward": False})

LEVELS = ((12, 4), (48, 2), (1 << 62, 1))
"""(samples a pixel up to which, rounds). Schied et al. take 5 always. Wide kernels blur what many samples already know: relmse at 64 samples
with 0, 1, 2, 5 rounds: 0.0054, 0.0036, 0.0045, 0.0059 (metal under a dawn), 0.016, 0.0089, 0.0084, 0.0087 (matt under lamps); at 8 samples
0.067, 0.034, 0.030, 0.032 and 0.16, 0.068, 0.050, 0.043."""
SIGMA_LUMINANCE = 2.0
"""Standard deviations; Schied et al. take 4 with the pixel's own variance alone."""
SIGMA_PLANE = 2.0
"""Distance off the tangent plane at which a neighbour's weight has fallen to 1/e [pixel footprints at the neighbour's distance]."""
NORMAL_POWER = wp.constant(64.0)
NEIGHBOUR_VARIANCE = 0.25
"""Share of the neighbour's variance in the standard deviation. At 0 dark pixels, whose variance is underestimated, refuse
bright neighbours that do not refuse them, and the picture darkens (teapot under lamps, 32 samples: -3.3 % at 26.4 dB, with 0.25 and
SIGMA_LUMINANCE 2: -2.3 % at 26.6 dB); at 1 it keeps its energy but spreads outliers (-1.5 %, 26.3 dB)."""
MIN_REFLECTANCE = wp.constant(0.02)
"""Division by darker textures would only amplify noise."""


@wp.kernel
def smooth_variance(
    first: int,
    pixels: wp.array[int],
    width: int,
    height: int,
    step: int,
    coverage: wp.array[float],
    variance: wp.array[wp.vec2],
    # outputs
    smooth: wp.array[wp.vec2],
):
    """5 x 5 binomial mean over covered pixels: one pixel's variance is itself too noisy to go by."""
    p = pixels[first + wp.tid()]
    x = p % width
    y = p // width
    total = wp.vec2(0.0, 0.0)
    weights = wp.float32(0.0)
    for dy in range(-2, 3):
        for dx in range(-2, 3):
            qx = x + dx * step
            qy = y + dy * step
            if qx >= 0 and qy >= 0 and qx < width and qy < height:
                q = qy * width + qx
                if coverage[q] > 0.0:
                    w = float(3 - wp.abs(dx)) * float(3 - wp.abs(dy))
                    total += w * variance[q]
                    weights += w
    smooth[p] = total / wp.max(weights, 1.0e-12)


@wp.func
def luminance_of(c: wp.vec3) -> float:
    return 0.2126 * c[0] + 0.7152 * c[1] + 0.0722 * c[2]


@wp.kernel
def filter_level(
    first: int,
    pixels: wp.array[int],
    width: int,
    height: int,
    step: int,
    footprint: float,
    sigma_luminance: float,
    sigma_plane: float,
    neighbour_variance: float,
    coverage: wp.array[float],
    depth: wp.array[float],
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    diffuse: wp.array[wp.vec3],
    specular: wp.array[wp.vec3],
    variance: wp.array[wp.vec2],
    smooth: wp.array[wp.vec2],
    # outputs
    diffuse_out: wp.array[wp.vec3],
    specular_out: wp.array[wp.vec3],
    variance_out: wp.array[wp.vec2],
):
    p = pixels[first + wp.tid()]
    x = p % width
    y = p // width
    local = smooth[p]
    n = normal[p]
    here = position[p]
    y_d = luminance_of(diffuse[p])
    y_s = luminance_of(specular[p])
    plane_scale = 1.0 / wp.max(sigma_plane * footprint * depth[p] * float(step), 1.0e-12)
    sum_d = wp.vec3(0.0, 0.0, 0.0)
    sum_s = wp.vec3(0.0, 0.0, 0.0)
    sum_variance = wp.vec2(0.0, 0.0)
    weights_d = wp.float32(0.0)
    weights_s = wp.float32(0.0)
    for dy in range(-2, 3):
        qy = y + dy * step
        if qy >= 0 and qy < height:
            row = wp.where(dy == 0, 0.375, wp.where(dy * dy == 1, 0.25, 0.0625))
            for dx in range(-2, 3):
                qx = x + dx * step
                if qx >= 0 and qx < width:
                    q = qy * width + qx
                    if coverage[q] > 0.0:
                        column = wp.where(dx == 0, 0.375, wp.where(dx * dx == 1, 0.25, 0.0625))
                        alike = wp.max(wp.dot(n, normal[q]), 0.0)
                        off_plane = wp.abs(wp.dot(n, position[q] - here)) * plane_scale
                        shared = row * column * wp.pow(alike, NORMAL_POWER) * coverage[q]
                        both = local + neighbour_variance * smooth[q]
                        difference_d = wp.abs(luminance_of(diffuse[q]) - y_d) / (sigma_luminance * wp.sqrt(both[0]) + 1.0e-6)
                        difference_s = wp.abs(luminance_of(specular[q]) - y_s) / (sigma_luminance * wp.sqrt(both[1]) + 1.0e-6)
                        w_d = shared * wp.exp(-off_plane - difference_d)
                        w_s = shared * wp.exp(-off_plane - difference_s)
                        sum_d += w_d * diffuse[q]
                        sum_s += w_s * specular[q]
                        sum_variance += wp.vec2(w_d * w_d * variance[q][0], w_s * w_s * variance[q][1])
                        weights_d += w_d
                        weights_s += w_s
    # The pixel itself always counts, so the weights are positive wherever it is covered.
    diffuse_out[p] = sum_d / wp.max(weights_d, 1.0e-20)
    specular_out[p] = sum_s / wp.max(weights_s, 1.0e-20)
    variance_out[p] = wp.vec2(
        sum_variance[0] / wp.max(weights_d * weights_d, 1.0e-30), sum_variance[1] / wp.max(weights_s * weights_s, 1.0e-30)
    )


PAD = wp.constant(32)
"""Empty pixels at both ends of a row: as far as the widest kernel reaches."""


def _native_source(part: int) -> str:
    folder = Path(__file__).parent
    vectors = (folder / "rasterize_gbuffer" / "tile_vector.h").read_text()
    return f"constexpr int NORMAL_POWER = {int(NORMAL_POWER)};\n" + vectors + (folder / "denoise.h").read_text().split("// ----\n")[part]


@wp.func_native(_native_source(0))
def smooth_sixteen(
    at: int, height: int, pitch: int, step: int, coverage: wp.array(dtype=float), variance: wp.array(dtype=float), smooth: wp.array(dtype=float)
): ...  # fmt: skip


@wp.func_native(_native_source(1))
def filter_sixteen(
    at: int, height: int, pitch: int, step: int, sigma_luminance: float, sigma_plane: float, neighbour_variance: float,
    guides: wp.array(dtype=float), source: wp.array(dtype=float), smooth: wp.array(dtype=float), target: wp.array(dtype=float),
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="unique")
def smooth_variance_simd(
    first: int,
    groups: wp.array[int],
    height: int,
    pitch: int,
    step: int,
    coverage: wp.array[float],
    variance: wp.array[float],
    # outputs
    smooth: wp.array[float],
):
    """smooth_variance on the CPU, for maps in planes (denoise.h)."""
    smooth_sixteen(groups[first + wp.tid()], height, pitch, step, coverage, variance, smooth)


@wp.kernel(enable_backward=False, module="unique")
def filter_level_simd(
    first: int,
    groups: wp.array[int],
    height: int,
    pitch: int,
    step: int,
    sigma_luminance: float,
    sigma_plane: float,
    neighbour_variance: float,
    guides: wp.array[float],
    source: wp.array[float],
    smooth: wp.array[float],
    # outputs
    target: wp.array[float],
):
    """filter_level on the CPU, for maps in planes (denoise.h)."""
    at = groups[first + wp.tid()]
    filter_sixteen(at, height, pitch, step, sigma_luminance, sigma_plane, neighbour_variance, guides, source, smooth, target)


Maps = tuple[Tensor, Tensor, Tensor]
"""Diffuse and specular light over reflectance (height, width, 3), and the variance of their luminance (height, width, 2)."""


def levels_for(samples: int) -> int:
    """Rounds for a picture of so many samples a pixel."""
    return next(levels for most, levels in LEVELS if samples <= most)


def filter_maps(maps: Maps, gbuffer: GBuffer, footprint: float, levels: int) -> Maps:
    """All rounds, one pixel after another.

    Args:
        footprint: of a pixel at distance 1 [world units].
    """
    height, width = gbuffer.coverage.shape
    source = [t.contiguous().clone() for t in maps]
    target = [t.clone() for t in source]
    pixels = torch.nonzero(gbuffer.coverage.reshape(-1) > 0).squeeze(-1).int()
    depth = torch.where(torch.isfinite(gbuffer.depth), gbuffer.depth, 0.0)
    guides = [
        warp_array(gbuffer.coverage.reshape(-1)),
        warp_array(depth.reshape(-1)),
        warp_array(gbuffer.position_world.reshape(-1, 3), wp.vec3),
        warp_array(gbuffer.normal_world.reshape(-1, 3), wp.vec3),
    ]

    def arrays(buffers: list[Tensor]) -> list:
        flat = [t.view(height * width, -1) for t in buffers]
        return [warp_array(flat[0], wp.vec3), warp_array(flat[1], wp.vec3), warp_array(flat[2], wp.vec2)]

    smooth = torch.zeros_like(source[2])
    smooth_array = warp_array(smooth.view(-1, 2), wp.vec2)
    for level in range(levels):
        step = 1 << level
        inputs = [warp_array(pixels), width, height, step, guides[0], arrays(source)[2]]
        launch(smooth_variance, len(pixels), inputs, [smooth_array], warp_device(depth))
        settings = [warp_array(pixels), width, height, step, footprint, SIGMA_LUMINANCE, SIGMA_PLANE, NEIGHBOUR_VARIANCE]
        launch(filter_level, len(pixels), [*settings, *guides, *arrays(source), smooth_array], arrays(target), warp_device(depth))
        source, target = target, source
    return source[0], source[1], source[2]


def filter_maps_simd(maps: Maps, gbuffer: GBuffer, footprint: float, levels: int) -> Maps:
    """filter_maps, sixteen pixels at once on the CPU; 0 where nothing is covered."""
    height, width = gbuffer.coverage.shape
    columns = -(-width // 16) * 16
    pitch = columns + 2 * PAD
    guides, source = torch.zeros(8, height, pitch), torch.zeros(8, height, pitch)
    launch(
        lay_in_planes,
        height * width,
        [
            width, footprint, warp_view(gbuffer.coverage), warp_view(gbuffer.depth), warp_view(gbuffer.position_world, wp.vec3),
            warp_view(gbuffer.normal_world, wp.vec3), warp_view(maps[0], wp.vec3), warp_view(maps[1], wp.vec3), warp_view(maps[2], wp.vec2),
        ],
        [warp_array(guides), warp_array(source)],
        "cpu",
    )  # fmt: skip
    target, smooth = torch.zeros_like(source), torch.zeros(2, height, pitch)
    full = (guides[0, :, PAD : PAD + columns].reshape(height, -1, 16) > 0).any(-1).nonzero()
    groups = warp_array((full[:, 0] * pitch + PAD + 16 * full[:, 1]).int())
    smooth_array, guide_array = warp_array(smooth.view(-1)), warp_array(guides.view(-1))
    for level in range(levels):
        place = [groups, height, pitch, 1 << level]
        variance = warp_array(source[6:].view(-1))
        launch(smooth_variance_simd, len(full), [*place, warp_array(guides[0].view(-1)), variance], [smooth_array], "cpu")
        inputs = [*place, SIGMA_LUMINANCE, SIGMA_PLANE, NEIGHBOUR_VARIANCE, guide_array, warp_array(source.view(-1)), smooth_array]
        launch(filter_level_simd, len(full), inputs, [warp_array(target.view(-1))], "cpu")
        source, target = target, source
    inside = source[:, :, PAD : PAD + width].permute(1, 2, 0)
    return inside[..., :3], inside[..., 3:6], inside[..., 6:]


@wp.kernel
def lay_in_planes(
    first: int,
    width: int,
    footprint: float,
    coverage: wp.array2d[float],
    depth: wp.array2d[float],
    position: wp.array2d[wp.vec3],
    normal: wp.array2d[wp.vec3],
    diffuse: wp.array2d[wp.vec3],
    specular: wp.array2d[wp.vec3],
    variance: wp.array2d[wp.vec2],
    # outputs
    guides: wp.array3d[float],
    source: wp.array3d[float],
):
    """Maps as denoise.h wants them; what is not covered stays 0."""
    i = first + wp.tid()
    y = i / width
    x = i - y * width
    if coverage[y, x] <= 0.0:
        return
    at = x + PAD
    guides[0, y, at] = coverage[y, x]
    guides[1, y, at] = footprint * depth[y, x]
    for k in range(3):
        guides[2 + k, y, at] = position[y, x][k]
        guides[5 + k, y, at] = normal[y, x][k]
        source[k, y, at] = diffuse[y, x][k]
        source[3 + k, y, at] = specular[y, x][k]
    source[6, y, at] = variance[y, x][0]
    source[7, y, at] = variance[y, x][1]


@wp.func
def diffuse_reflectance(albedo: wp.vec3, metallic: float) -> wp.vec3:
    return wp.max((1.0 - metallic) * albedo, wp.vec3(MIN_REFLECTANCE, MIN_REFLECTANCE, MIN_REFLECTANCE))


@wp.func
def specular_reflectance(albedo: wp.vec3, metallic: float) -> wp.vec3:
    f0 = metallic * albedo + wp.vec3(0.04, 0.04, 0.04) * (1.0 - metallic)
    return wp.max(f0, wp.vec3(MIN_REFLECTANCE, MIN_REFLECTANCE, MIN_REFLECTANCE))


@wp.func
def mean_square(v: wp.vec3) -> float:
    return wp.dot(v, v) / 3.0


@wp.kernel
def take_reflectance_out(
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
def put_reflectance_in(
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


def without_reflectance(radiance: Radiance, gbuffer: GBuffer) -> Maps:
    """Both parts over what textures carry, and the variance of their luminance.

    Raises:
        ValueError: the radiance carries no variance of its parts.
    """
    if radiance.diffuse_variance is None or radiance.specular_variance is None:
        raise ValueError("denoising needs the variance of the diffuse and specular part; this radiance carries none")
    height, width = gbuffer.coverage.shape
    maps = tuple(radiance.diffuse.new_empty(height, width, channels) for channels in (3, 3, 2))
    launch(
        take_reflectance_out,
        height * width,
        [
            width, warp_view(gbuffer.albedo, wp.vec3), warp_view(gbuffer.metallic), warp_view(radiance.diffuse, wp.vec3),
            warp_view(radiance.specular, wp.vec3), warp_view(radiance.diffuse_variance), warp_view(radiance.specular_variance),
        ],
        [warp_array(maps[0], wp.vec3), warp_array(maps[1], wp.vec3), warp_array(maps[2], wp.vec2)],
        warp_device(maps[0]),
    )  # fmt: skip
    return maps


def denoise_svgf(radiance: Radiance, gbuffer: GBuffer, camera: Camera) -> Radiance:
    """The spatial filter; radiance must carry the variances of both parts."""
    maps = without_reflectance(radiance, gbuffer)
    filter_all = filter_maps if gbuffer.coverage.is_cuda else filter_maps_simd
    footprint = 1.0 / float(camera.intrinsics[0, 0])  # of a pixel at distance 1
    filtered = filter_all(maps, gbuffer, footprint, levels_for(radiance.samples))
    height, width = gbuffer.coverage.shape
    shown = [torch.empty_like(maps[0]) for _ in range(2)]
    variances = [shown[0].new_empty(height, width) for _ in range(2)]
    launch(
        put_reflectance_in,
        height * width,
        [width, warp_view(gbuffer.albedo, wp.vec3), warp_view(gbuffer.metallic), *(warp_view(values) for values in filtered)],
        [*(warp_array(values, wp.vec3) for values in shown), *(warp_array(values) for values in variances)],
        warp_device(maps[0]),
    )
    return replace(radiance, diffuse=shown[0], specular=shown[1], diffuse_variance=variances[0], specular_variance=variances[1])


def denoise(radiance: Radiance, gbuffer: GBuffer, camera: Camera, method: Literal["none", "svgf", "oidn"]) -> Radiance:
    """Radiance as shown.

    Raises:
        ValueError: the method is not there.
    """
    if method == "none":
        return radiance
    if method == "svgf":
        return denoise_svgf(radiance, gbuffer, camera)
    raise ValueError(f"denoiser {method!r} is not available; expected none or svgf")
