"""Noise out of a frame without its edges: an edge-avoiding wavelet filter led by the variance of the samples.

In: radiance with the variance of its diffuse and specular part, G-buffer. Out: radiance. The spatial half of SVGF: both parts
are divided by the reflectance that textures carry, filtered in rounds of a 5 x 5 kernel with holes of 1, 2, 4, ... pixels,
and multiplied again. A neighbour counts for less the more it differs in normal, the farther it is off the pixel's tangent plane, and
the more its luminance differs in units of the standard deviation; where there is no variance nothing is blurred, so
the picture converges to the unfiltered mean as samples grow.

Source: Schied et al. 2017 (weights, variance update); Dammertz et al. 2010 (kernel). We measure distance to the
tangent plane instead of depth gradients, which splats make noisy. Twin: drgs/reference/denoise.py.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import warp as wp

from drgs.maths.constants import LUMINANCE_BLUE, LUMINANCE_GREEN, LUMINANCE_RED
from drgs.render.color_warp import luminance_of
from drgs.render.film.denoise.planes import LIGHT_PLANES, PAD, PLANES, PLANES_APART, VARIANCE, flat, planes_for
from drgs.render.native_source import native_source
from drgs.render.progressive.demodulate_albedo import demodulate_albedo, remodulate_albedo
from drgs.render.records import DemodulatedLight, GBuffer, Radiance
from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_array, warp_device, warp_view

wp.set_module_options({"enable_backward": False})

SIGMA_LUMINANCE = 2.0
"""Standard deviations; Schied et al. take 4 with the pixel's own variance alone."""
SIGMA_PLANE = 2.0
"""Distance off the tangent plane at which a neighbour's weight has fallen to 1/e [pixel footprints at the neighbour's distance]."""
NORMAL_POWER = wp.constant(64.0)
NEIGHBOUR_VARIANCE = 0.25
"""Share of the neighbour's variance in the standard deviation. At 0 dark pixels, whose variance is underestimated, refuse
bright neighbours that do not refuse them, and the picture darkens (teapot under lamps, 32 samples: -3.3 % at 26.4 dB, with 0.25 and
SIGMA_LUMINANCE 2: -2.3 % at 26.6 dB); at 1 it keeps its energy but spreads outliers (-1.5 %, 26.3 dB)."""


@dataclass(frozen=True)
class FilterSettings:
    """How far the filter goes."""

    levels: int
    """Rounds."""
    sigma_luminance: float = SIGMA_LUMINANCE
    neighbour_variance: float = NEIGHBOUR_VARIANCE


MOVING = FilterSettings(levels=1, sigma_luminance=4.0, neighbour_variance=1.0)
"""Of moving pictures: history has averaged outliers, and the next picture's history shall not be of its neighbours. Against two rounds with the numbers above,
relmse of full assets with 8 rays: 0.0081 for 0.0083 (teapot), 0.0024 for 0.0031 (bunny); light lost 0.2 for 1.2 % and 0.7 for 1.1 %."""

AT_REST: tuple[tuple[int, FilterSettings], ...] = (
    (4, FilterSettings(3, sigma_luminance=4.0, neighbour_variance=0.5)),
    (12, FilterSettings(4)),
    (48, FilterSettings(2)),
    (1 << 62, FilterSettings(1)),
)
"""(samples a pixel up to which, settings). Schied et al. take five rounds always. Wide kernels blur what many samples already know: relmse at 64 samples
with 0, 1, 2, 5 rounds: 0.0054, 0.0036, 0.0045, 0.0059 (metal under a dawn), 0.016, 0.0089, 0.0084, 0.0087 (matt under lamps); at 8 samples
0.067, 0.034, 0.030, 0.032 and 0.16, 0.068, 0.050, 0.043. Of four samples and fewer, whose variance is itself uncertain, a standard deviation says little: with four rounds and
the numbers above relmse at 4 is 1.37 times as large in the geometric mean over three built assets in three materials each (0.8 to 1.9), and pictures are up to 5.7 % too dark
instead of 3.8; of the benchmark's teapot after edits 0.68 to 1.0 times under a dawn, 1.06 to 1.4 times under a city and in a room. At 8 samples the new numbers, in two
rounds, are 0.88 times on assets, but up to 1.45 on metal, and 1.33 under a dawn."""


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


@wp.struct
class Level:
    """One round of the filter."""

    width: int
    height: int
    step: int
    """Between the pixels of the kernel."""
    footprint: float
    """Of a pixel at distance 1 [world units]."""
    sigma_luminance: float
    sigma_plane: float
    neighbour_variance: float


@wp.struct
class Guides:
    """Flat maps of where surfaces are."""

    coverage: wp.array[float]
    depth: wp.array[float]
    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]


@wp.struct
class LightPixels:
    """DemodulatedLight, flat."""

    diffuse: wp.array[wp.vec3]
    specular: wp.array[wp.vec3]
    variance: wp.array[wp.vec2]


@wp.kernel
def filter_level(
    first: int,
    pixels: wp.array[int],
    level: Level,
    guides: Guides,
    source: LightPixels,
    smooth: wp.array[wp.vec2],
    # outputs
    target: LightPixels,
):
    p = pixels[first + wp.tid()]
    x = p % level.width
    y = p // level.width
    local = smooth[p]
    n = guides.normal[p]
    here = guides.position[p]
    y_d = luminance_of(source.diffuse[p])
    y_s = luminance_of(source.specular[p])
    variance_scale = level.sigma_luminance * level.sigma_luminance
    plane_scale = 1.0 / wp.max(level.sigma_plane * level.footprint * guides.depth[p] * float(level.step), 1.0e-12)
    sum_d = wp.vec3(0.0, 0.0, 0.0)
    sum_s = wp.vec3(0.0, 0.0, 0.0)
    sum_variance = wp.vec2(0.0, 0.0)
    weights_d = wp.float32(0.0)
    weights_s = wp.float32(0.0)
    for dy in range(-2, 3):
        qy = y + dy * level.step
        if qy >= 0 and qy < level.height:
            row = wp.where(dy == 0, 0.375, wp.where(dy * dy == 1, 0.25, 0.0625))
            for dx in range(-2, 3):
                qx = x + dx * level.step
                if qx >= 0 and qx < level.width:
                    q = qy * level.width + qx
                    if guides.coverage[q] > 0.0:
                        column = wp.where(dx == 0, 0.375, wp.where(dx * dx == 1, 0.25, 0.0625))
                        alike = wp.max(wp.dot(n, guides.normal[q]), 0.0)
                        off_plane = wp.abs(wp.dot(n, guides.position[q] - here)) * plane_scale
                        shared = row * column * wp.pow(alike, NORMAL_POWER) * guides.coverage[q]
                        both = local + level.neighbour_variance * smooth[q]
                        difference_d = wp.abs(luminance_of(source.diffuse[q]) - y_d) / wp.sqrt(variance_scale * both[0] + 1.0e-12)
                        difference_s = wp.abs(luminance_of(source.specular[q]) - y_s) / wp.sqrt(variance_scale * both[1] + 1.0e-12)
                        w_d = shared * wp.exp(-off_plane - difference_d)
                        w_s = shared * wp.exp(-off_plane - difference_s)
                        sum_d += w_d * source.diffuse[q]
                        sum_s += w_s * source.specular[q]
                        sum_variance += wp.vec2(w_d * w_d * source.variance[q][0], w_s * w_s * source.variance[q][1])
                        weights_d += w_d
                        weights_s += w_s
    # The pixel itself always counts, so the weights are positive wherever it is covered.
    target.diffuse[p] = sum_d / wp.max(weights_d, 1.0e-20)
    target.specular[p] = sum_s / wp.max(weights_s, 1.0e-20)
    target.variance[p] = wp.vec2(
        sum_variance[0] / wp.max(weights_d * weights_d, 1.0e-30), sum_variance[1] / wp.max(weights_s * weights_s, 1.0e-30)
    )


@wp.func_native(native_source(Path(__file__).with_name("smooth_variance.h"), PLANES, constants=PLANES_APART))
def smooth_sixteen(
    at: int, height: int, pitch: int, step: int, coverage: wp.array[float], variance: wp.array[float], smooth: wp.array[float]
): ...  # fmt: skip


LUMINANCE_WEIGHTS = {"LUMINANCE_RED": LUMINANCE_RED, "LUMINANCE_GREEN": LUMINANCE_GREEN, "LUMINANCE_BLUE": LUMINANCE_BLUE}


@wp.func_native(
    native_source(
        Path(__file__).with_name("filter_level.h"),
        PLANES,
        constants={"NORMAL_POWER": int(NORMAL_POWER), **LUMINANCE_WEIGHTS, **PLANES_APART},
    )
)
def filter_sixteen(
    at: int, height: int, pitch: int, step: int, sigma_luminance: float, sigma_plane: float, neighbour_variance: float,
    guides: wp.array[float], source: wp.array[float], smooth: wp.array[float], target: wp.array[float],
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
    """smooth_variance on the CPU, for maps in planes (smooth_variance.h)."""
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
    """filter_level on the CPU, for maps in planes (filter_level.h)."""
    at = groups[first + wp.tid()]
    filter_sixteen(at, height, pitch, step, sigma_luminance, sigma_plane, neighbour_variance, guides, source, smooth, target)


def settings_for(samples: int) -> FilterSettings:
    """Of a picture at rest of so many samples a pixel, or the first one after an edit."""
    return next(settings for most, settings in AT_REST if samples <= most)


def filter_reach(samples: int) -> int:
    """How far from a pixel of such a picture another may lie that its filtered value depends on [pixels]."""
    # A round reads what lies two of its steps away, and the smoothed variance there, which reads as far again.
    return sum(4 << level for level in range(settings_for(samples).levels))


def filter_pixels(light: DemodulatedLight, gbuffer: GBuffer, footprint: float, settings: FilterSettings) -> DemodulatedLight:
    """All rounds, one pixel after another.

    Args:
        footprint: of a pixel at distance 1 [world units].
    """
    height, width = gbuffer.coverage.shape
    source, target = (DemodulatedLight(*(t.contiguous().clone() for t in vars(light).values())) for _ in range(2))
    pixels = torch.nonzero(gbuffer.coverage.reshape(-1) > 0).squeeze(-1).int()
    smooth, device = torch.zeros_like(source.variance), warp_device(gbuffer.coverage)
    guides, smooth_array = _guides(gbuffer), warp_array(smooth.view(-1, 2), wp.vec2)
    for number in range(settings.levels):
        step = 1 << number
        inputs = [warp_array(pixels), width, height, step, guides.coverage, _light_pixels(source).variance]
        launch(smooth_variance, len(pixels), inputs, [smooth_array], device)
        inputs = [warp_array(pixels), _level(width, height, step, footprint, settings), guides, _light_pixels(source), smooth_array]
        launch(filter_level, len(pixels), inputs, [_light_pixels(target)], device)
        source, target = target, source
    return source


def _level(width: int, height: int, step: int, footprint: float, settings: FilterSettings) -> Any:
    level = Level()
    level.width, level.height, level.step, level.footprint = width, height, step, footprint
    level.sigma_luminance, level.sigma_plane, level.neighbour_variance = settings.sigma_luminance, SIGMA_PLANE, settings.neighbour_variance
    return level


def _guides(gbuffer: GBuffer) -> Any:
    guides = Guides()
    guides.coverage = warp_array(gbuffer.coverage.reshape(-1))
    guides.depth = warp_array(torch.where(torch.isfinite(gbuffer.depth), gbuffer.depth, 0.0).reshape(-1))
    guides.position = warp_array(gbuffer.position_world.reshape(-1, 3), wp.vec3)
    guides.normal = warp_array(gbuffer.normal_world.reshape(-1, 3), wp.vec3)
    return guides


def _light_pixels(light: DemodulatedLight) -> Any:
    pixels = LightPixels()
    pixels.diffuse, pixels.specular = warp_array(light.diffuse.view(-1, 3), wp.vec3), warp_array(light.specular.view(-1, 3), wp.vec3)
    pixels.variance = warp_array(light.variance.view(-1, 2), wp.vec2)
    return pixels


def filter_sixteen_pixels(light: DemodulatedLight, gbuffer: GBuffer, footprint: float, settings: FilterSettings) -> DemodulatedLight:
    """filter_pixels on the CPU, sixteen at once; 0 where nothing is covered."""
    height, width = gbuffer.coverage.shape
    planes = planes_for(height, width)
    guides, source, target, pitch = planes.guides, planes.light, planes.other, planes.pitch
    launch(
        lay_in_planes,
        height * width,
        [
            width, footprint, warp_view(gbuffer.coverage), warp_view(gbuffer.depth), warp_view(gbuffer.position_world, wp.vec3),
            warp_view(gbuffer.normal_world, wp.vec3), warp_view(light.diffuse, wp.vec3), warp_view(light.specular, wp.vec3), warp_view(light.variance, wp.vec2),
        ],
        [warp_view(guides), warp_view(source)],
        "cpu",
    )  # fmt: skip
    full = (guides[0, :, PAD : pitch - PAD].reshape(height, -1, 16) > 0).any(-1).nonzero()
    groups = warp_array((full[:, 0] * pitch + PAD + 16 * full[:, 1]).int())
    coverage, guide_array, smooth_array = flat(guides[:1]), flat(guides), flat(planes.smooth)
    for level in range(settings.levels):
        if level == settings.levels - 1:
            target = planes.new_light()  # what is given away is nobody's to write into
        place = [groups, height, pitch, 1 << level]
        launch(smooth_variance_simd, len(full), [*place, coverage, flat(source[VARIANCE:])], [smooth_array], "cpu")
        sigmas = [settings.sigma_luminance, SIGMA_PLANE, settings.neighbour_variance]
        launch(filter_level_simd, len(full), [*place, *sigmas, guide_array, flat(source), smooth_array], [flat(target)], "cpu")
        source, target = target, source
    inside = source[:, :, PAD : PAD + width].permute(1, 2, 0)
    return DemodulatedLight(inside[..., :3], inside[..., 3:6], inside[..., VARIANCE : VARIANCE + 2])


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
    """Maps as smooth_variance.h wants them; 0 where nothing is covered."""
    i = first + wp.tid()
    y = i / width
    x = i - y * width
    at = x + PAD
    if coverage[y, x] <= 0.0:
        for k in range(8):
            guides[k, y, at] = 0.0
        for k in range(LIGHT_PLANES):
            source[k, y, at] = 0.0
        return
    guides[0, y, at] = coverage[y, x]
    guides[1, y, at] = footprint * depth[y, x]
    for k in range(3):
        guides[2 + k, y, at] = position[y, x][k]
        guides[5 + k, y, at] = normal[y, x][k]
        source[k, y, at] = diffuse[y, x][k]
        source[3 + k, y, at] = specular[y, x][k]
    source[6, y, at] = luminance_of(diffuse[y, x])
    source[7, y, at] = luminance_of(specular[y, x])
    source[VARIANCE, y, at] = variance[y, x][0]
    source[VARIANCE + 1, y, at] = variance[y, x][1]


def denoise_svgf(radiance: Radiance, gbuffer: GBuffer, camera: Camera, settings: FilterSettings | None = None) -> Radiance:
    """The spatial filter; radiance must carry the variances of both parts.

    Args:
        settings: None: by the samples behind the picture.
    """
    settings = settings or settings_for(radiance.samples)
    return remodulate_albedo(filter_light(demodulate_albedo(radiance, gbuffer), gbuffer, camera, settings), radiance, gbuffer)


def filter_light(light: DemodulatedLight, gbuffer: GBuffer, camera: Camera, settings: FilterSettings) -> DemodulatedLight:
    """The same for light without the reflectance of textures."""
    filter_all = filter_pixels if gbuffer.coverage.is_cuda else filter_sixteen_pixels
    return filter_all(light, gbuffer, 1.0 / float(camera.intrinsics[0, 0]), settings)
