"""The picture of a frame in the making: sums in, Frame out, at any time.

All but the last step happens in the window around the tiles that show something; around it the picture is empty.
"""

import time
from dataclasses import asdict, replace
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from drgs.render.converge import mean_variance, tile_errors
from drgs.render.denoise import denoise
from drgs.render.denoise_oidn import denoise_oidn
from drgs.render.frame_state import FrameState, samples_a_pass
from drgs.render.image_tiles import Window, spread_over_pixels, tile_grid
from drgs.render.records import Frame, GBuffer, Radiance
from drgs.render.reproject import History, blend_history, remember
from drgs.render.tonemap import tonemap
from drgs.scene.camera import pixel_rays_world
from drgs.scene.environment import Environment, environment_radiance


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
        rgba = window.pad(tonemap(window.crop(linear), part.coverage, settings.exposure))
    else:
        rgba = tonemap(linear, window.pad(part.coverage), settings.exposure, background)
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
    weight, passes = _part(state, "weight").clamp(min=1), _passes(state)
    scatter = _part(state, "scatter")[..., 1:] / (weight * weight)[..., None]
    radiance = Radiance(
        _part(state, "diffuse") / weight[..., None],
        _part(state, "specular") / weight[..., None],
        _variance(state, passes) * (passes.clamp(min=1) / weight) ** 2,
        _part(state, "visibility") / weight,
        state.passes * samples_a_pass(state.settings, state.fixed is None).total,
        scatter[..., 0],
        scatter[..., 1],
    )
    if state.reprojected is not None:
        radiance = blend_history(radiance, state.reprojected, window_gbuffer(state), _own_samples(state))
    _blends[state] = radiance
    return radiance


def _background(state: FrameState) -> Tensor | None:
    background, scene = state.settings.background, state.scene
    if background == "transparent":
        return None
    if background != "environment":
        return torch.tensor(background, device=state.diffuse.device)
    _, direction = pixel_rays_world(state.camera)
    angle = torch.tensor(scene.environment_rotation_degrees).deg2rad()
    cos, sin = torch.cos(angle), torch.sin(angle)
    x, y, z = direction.to(state.diffuse.device).unbind(-1)
    turned = torch.stack([cos * x + sin * y, cos * y - sin * x, z], -1)
    return scene.environment_intensity * environment_radiance(Environment(scene.environment.radiance.detach()), turned)
