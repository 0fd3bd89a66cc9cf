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

from drgs.maths.brdf import f0_from_base
from drgs.render.records import GBuffer, Radiance
from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_array, warp_device

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
MIN_REFLECTANCE = 0.02
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


def reflectances(gbuffer: GBuffer) -> tuple[Tensor, Tensor]:
    """(height, width, 3) factors of the diffuse and the specular part that textures carry."""
    diffuse = (1 - gbuffer.metallic)[..., None] * gbuffer.albedo
    return diffuse.clamp(min=MIN_REFLECTANCE), f0_from_base(gbuffer.albedo, gbuffer.metallic).clamp(min=MIN_REFLECTANCE)


PAD = 32
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

    def planes(*values: Tensor) -> Tensor:
        """(plane, height, pitch)."""
        count = sum(1 if v.dim() == 2 else v.shape[-1] for v in values)
        result = torch.zeros(count, height, pitch)
        at = 0
        for v in values:
            size = 1 if v.dim() == 2 else v.shape[-1]
            result[at : at + size, :, PAD : PAD + width] = v[None] if v.dim() == 2 else v.permute(2, 0, 1)
            at += size
        return result

    depth = torch.where(torch.isfinite(gbuffer.depth), gbuffer.depth, 0.0)
    guides = planes(gbuffer.coverage, footprint * depth, gbuffer.position_world, gbuffer.normal_world)
    source = planes(*maps)
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


def denoise_svgf(radiance: Radiance, gbuffer: GBuffer, camera: Camera) -> Radiance:
    """The spatial filter; radiance must carry the variances of both parts."""
    if radiance.diffuse_variance is None or radiance.specular_variance is None:
        raise ValueError("denoising needs the variance of the diffuse and specular part; this radiance carries none")
    factors = reflectances(gbuffer)
    squares = [f.square().mean(-1) for f in factors]
    variance = torch.stack([radiance.diffuse_variance / squares[0], radiance.specular_variance / squares[1]], -1)
    filter_all = filter_maps if gbuffer.coverage.is_cuda else filter_maps_simd
    footprint = 1.0 / float(camera.intrinsics[0, 0])  # of a pixel at distance 1
    maps = (radiance.diffuse / factors[0], radiance.specular / factors[1], variance)
    diffuse, specular, variance = filter_all(maps, gbuffer, footprint, levels_for(radiance.samples))
    return replace(
        radiance,
        diffuse=diffuse * factors[0],
        specular=specular * factors[1],
        diffuse_variance=variance[..., 0] * squares[0],
        specular_variance=variance[..., 1] * squares[1],
    )


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
