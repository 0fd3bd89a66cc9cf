"""The picture of a frame in the making: sums in, Frame out, at any time.

All but the last step happens in the window around the tiles that show something; around it the picture is empty.
"""

import time
from dataclasses import asdict, replace
from weakref import WeakKeyDictionary

import torch
import warp as wp
from torch import Tensor

from drgs.render.blur_environment import blurred_light
from drgs.render.converge import mean_variance, tile_errors
from drgs.render.denoise import denoise
from drgs.render.denoise_oidn import denoise_oidn
from drgs.render.environment_table import EnvironmentLight, lookup_radiance, table_place
from drgs.render.frame_state import FrameState, samples_a_pass
from drgs.render.image_tiles import TILE, Window, spread_over_pixels, tile_grid
from drgs.render.records import Frame, GBuffer, Radiance
from drgs.render.reproject import History, blend_history, remember
from drgs.render.tonemap import tonemap
from drgs.scene.camera import world_from_pixel
from drgs.warp_torch import launch, warp_array, warp_device, warp_view

wp.set_module_options({"enable_backward": False})


def resolve_frame(state: FrameState) -> Frame:
    """The picture so far."""
    clock = time.perf_counter()
    settings = state.settings
    window, part = state.window, window_gbuffer(state)
    radiance = _blended(state)
    seconds = dict(state.seconds)
    if settings.denoise == "oidn":
        shown = denoise_oidn(radiance, part)
    else:
        shown = denoise(radiance, part, window.camera(state.camera), settings.denoise)
    seconds["denoise"] = time.perf_counter() - clock
    background = _background(state)
    linear = window.pad(shown.diffuse + shown.specular)
    if background is None:
        rgba = window.pad(tonemap(window.crop(linear), part.coverage, settings.exposure, curve=settings.tone_curve))
    else:
        rgba = tonemap(linear, window.pad(part.coverage), settings.exposure, background, settings.tone_curve)
    gbuffer = _padded(part, window) if state.gbuffer is None else state.gbuffer
    shown = replace(shown, **{name: window.pad(value) for name, value in vars(shown).items() if isinstance(value, Tensor)})
    seconds["resolve"] = time.perf_counter() - clock - seconds["denoise"]
    metadata = {
        "samples": radiance.samples,
        "passes": state.passes,
        "bounces": settings.bounces,
        "counts": asdict(state.plan.counts),
        "skipped": [asdict(skip) for skip in state.plan.skips],
        "horizons": _horizons(state),
        "made": list(state.made),
        "error": round(float(frame_errors(state).max()), 6),
        "tiles_at_rest": int((~state.active).sum()),
        "tiles": len(state.active),
        "primary": "mesh" if state.fixed is None else "gaussians",
        "milliseconds": {step: round(1000 * duration, 3) for step, duration in seconds.items()},
    }
    return Frame(rgba, linear, gbuffer, shown, metadata)


def linear_picture(state: FrameState) -> Tensor:
    """(height, width, 4) the light behind the picture so far, before exposure and tone curve.

    Radiance is multiplied with the coverage, the last channel, as OpenEXR defines alpha. Over a background the coverage is 1.
    """
    frame, background = resolve_frame(state), _background(state)
    alpha = frame.gbuffer.coverage.clamp(0, 1)[..., None]
    color = torch.where(alpha > 0, alpha * frame.radiance_linear, 0.0)
    if background is not None:
        color, alpha = color + (1 - alpha) * background, torch.ones_like(alpha)
    return torch.cat([color, alpha], -1)


def _horizons(state: FrameState) -> dict[str, float]:
    """How far the search for rays that need no tracing has come, and what it found."""
    horizons = state.tracer.horizons if state.settings.skip else None
    if horizons is None:
        return {"faces": 0, "faces_known": 0, "rays_spared": 0.0}
    return {"faces": horizons.faces, "faces_known": horizons.found, "rays_spared": round(horizons.spared(), 4)}


def _part(state: FrameState, name: str) -> Tensor:
    """(rows, columns, ...) of the window: one of the state's flat sums."""
    return state.window.crop(getattr(state, name).unflatten(0, (state.camera.height, state.camera.width)))


def _passes(state: FrameState) -> Tensor:
    """(rows, columns) int: passes of each pixel's tile."""
    return spread_over_pixels(state.tile_passes, state.window)


def _variance(state: FrameState, passes: Tensor) -> Tensor:
    """(rows, columns) variance of the mean luminance."""
    return mean_variance(_part(state, "luminance"), _part(state, "luminance_squared"), _part(state, "scatter")[..., 0], passes)


def frame_errors(state: FrameState) -> Tensor:
    """(tile,) relative error of each tile (converge.tile_errors); 0 outside the window."""
    passes, window = _passes(state), state.window
    variance, mean = _variance(state, passes), _part(state, "luminance") / passes.clamp(min=1)
    height, width = mean.shape
    errors = tile_errors(mean.flatten(), variance.flatten(), (_part(state, "weight") > 0).flatten(), width, height)
    across, down = tile_grid(width, height)
    of_all = Window(*tile_grid(window.width, window.height)[::-1], *window.tiles)
    return of_all.pad(errors.view(down, across)).flatten()


def window_gbuffer(state: FrameState) -> GBuffer:
    """Of the window: the rasterised one, or the mean over passes of what rays to the mesh saw."""
    if state.gbuffer is not None:
        return GBuffer(**{name: state.window.crop(values) for name, values in vars(state.gbuffer).items()})
    weight = _part(state, "weight")
    coverage = weight / _passes(state).clamp(min=1)
    mean = _part(state, "surface") / weight.clamp(min=1)[..., None]
    depth = torch.where(coverage > 0, mean[..., 14], torch.inf)
    normal, wo = (torch.nn.functional.normalize(mean[..., a : a + 3].contiguous(), dim=-1) for a in (3, 6))
    return GBuffer(coverage, depth, mean[..., :3], normal, wo, mean[..., 9:12], mean[..., 12], mean[..., 13])


def _padded(part: GBuffer, window: Window) -> GBuffer:
    """The whole image's G-buffer."""
    return GBuffer(**{name: window.pad(values, torch.inf if name == "depth" else 0.0) for name, values in vars(part).items()})


def frame_history(state: FrameState) -> History | None:
    """What the frame is worth to the next one, seen by another camera; None before the first pass."""
    if state.passes == 0:
        return state.history
    camera = state.window.camera(state.camera)
    return remember(_blended(state), window_gbuffer(state), camera, _own_samples(state), state.reprojected)


def _own_samples(state: FrameState) -> Tensor:
    return (_passes(state) * samples_a_pass(state.settings, state.fixed is None).total).float()


_blends: WeakKeyDictionary[FrameState, Radiance] = WeakKeyDictionary()
"""Of states that live: the picture that is shown is the next one's history."""


def _blended(state: FrameState) -> Radiance:
    """Straight (alpha-normalised) radiance of the window, with what history adds; the variance is that of the mean of one pixel's passes."""
    if state in _blends:
        return _blends[state]
    names = ("diffuse", "specular", "weight", "luminance", "luminance_squared", "scatter", "visibility")
    dtypes = (wp.vec3, wp.vec3, None, None, None, wp.vec3, None)
    sums = [warp_view(_part(state, name), dtype) for name, dtype in zip(names, dtypes, strict=True)]
    window, own = state.window, _own_samples(state)
    height, width = own.shape
    vectors = [own.new_empty(height, width, 3) for _ in range(2)]
    scalars = [own.new_empty(height, width) for _ in range(4)]
    inputs = [
        width,
        tile_grid(window.width, window.height)[0],
        *(side.start for side in window.tiles),
        warp_array(state.tile_passes),
        *sums,
    ]
    outputs = [*(warp_array(values, wp.vec3) for values in vectors), *(warp_array(values) for values in scalars)]
    launch(mean_over_passes, height * width, inputs, outputs, warp_device(own))
    diffuse, specular, (variance, visibility, diffuse_variance, specular_variance) = *vectors, scalars
    samples = state.passes * samples_a_pass(state.settings, state.fixed is None).total
    radiance = Radiance(diffuse, specular, variance, visibility, samples, diffuse_variance, specular_variance)
    if state.reprojected is not None:
        blend_history(radiance, state.reprojected, window_gbuffer(state), own)
    _blends[state] = radiance
    return radiance


@wp.kernel
def mean_over_passes(
    first: int,
    width: int,
    tiles_across: int,
    tile_row: int,
    tile_column: int,
    tile_passes: wp.array[wp.int64],
    diffuse_sum: wp.array2d[wp.vec3],
    specular_sum: wp.array2d[wp.vec3],
    weight: wp.array2d[float],
    luminance: wp.array2d[float],
    luminance_squared: wp.array2d[float],
    scatter: wp.array2d[wp.vec3],
    open_sum: wp.array2d[float],
    # outputs
    diffuse: wp.array2d[wp.vec3],
    specular: wp.array2d[wp.vec3],
    variance: wp.array2d[float],
    visibility: wp.array2d[float],
    diffuse_variance: wp.array2d[float],
    specular_variance: wp.array2d[float],
):
    """Of a window that begins at a tile's corner. Variance: converge.mean_variance, of passes that found a surface."""
    i = first + wp.tid()
    y = i / width
    x = i - y * width
    passes = float(tile_passes[(tile_row + y / TILE) * tiles_across + tile_column + x / TILE])
    count = wp.max(passes, 1.0)
    w = wp.max(weight[y, x], 1.0)
    diffuse[y, x] = diffuse_sum[y, x] / w
    specular[y, x] = specular_sum[y, x] / w
    visibility[y, x] = open_sum[y, x] / w
    within = scatter[y, x]
    of_mean = within[0]
    if passes > 1.0:
        mean = luminance[y, x] / count
        of_mean = wp.max(luminance_squared[y, x] / count - mean * mean, 0.0) / (count - 1.0)
    variance[y, x] = of_mean * (count / w) * (count / w)
    diffuse_variance[y, x] = within[1] / (w * w)
    specular_variance[y, x] = within[2] / (w * w)


def _background(state: FrameState) -> Tensor | None:
    background = state.settings.background
    if background == "transparent":
        return None
    if not isinstance(background, str):
        return torch.tensor(background, device=state.diffuse.device)
    scene = state.scene
    light = state.light
    if background == "blurred":
        light = blurred_light(scene.environment, scene.environment_rotation_degrees, scene.environment_intensity)
    camera = state.camera
    radiance = state.diffuse.new_empty(camera.height, camera.width, 3)
    inputs = [camera.width, wp.mat33(*world_from_pixel(camera).flatten().tolist()), light]
    launch(environment_behind, camera.height * camera.width, inputs, [warp_array(radiance.view(-1, 3), wp.vec3)], warp_device(radiance))
    return radiance


@wp.kernel
def environment_behind(
    first: int,
    width: int,
    world_of_pixel: wp.mat33,
    light: EnvironmentLight,
    # outputs
    radiance: wp.array[wp.vec3],
):
    i = first + wp.tid()
    y = i / width
    direction = world_of_pixel * wp.vec3(float(i - y * width) + 0.5, float(y) + 0.5, 1.0)
    radiance[i] = lookup_radiance(light, table_place(light, wp.normalize(direction)))
