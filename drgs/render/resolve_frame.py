"""The picture of a frame in the making: sums in, Frame out, at any time."""

import time
from dataclasses import asdict

import torch
from torch import Tensor

from drgs.render.converge import mean_variance, tile_errors
from drgs.render.denoise import denoise
from drgs.render.frame_state import FrameState, samples_a_pass
from drgs.render.image_tiles import tile_of_pixels
from drgs.render.records import Frame, GBuffer, Radiance
from drgs.render.reproject import History, blend_history, remember
from drgs.render.tonemap import tonemap
from drgs.scene.camera import pixel_rays_world
from drgs.scene.environment import Environment, environment_radiance


def resolve_frame(state: FrameState) -> Frame:
    """The picture so far."""
    clock = time.perf_counter()
    settings = state.settings
    gbuffer = frame_gbuffer(state)
    radiance = _blended(state, gbuffer)
    seconds = dict(state.seconds)
    shown = denoise(radiance, gbuffer, state.camera, settings.denoise)
    seconds["denoise"] = time.perf_counter() - clock
    linear = shown.diffuse + shown.specular
    rgba = tonemap(linear, gbuffer.coverage, settings.exposure, _background(state))
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


def pixel_passes(state: FrameState) -> Tensor:
    """(pixel,) int: passes of each pixel's tile."""
    pixel = torch.arange(state.camera.width * state.camera.height, device=state.weight.device)
    return state.tile_passes[tile_of_pixels(pixel, state.camera.width)]


def frame_errors(state: FrameState) -> Tensor:
    """(tile,) relative error of each tile (converge.tile_errors)."""
    passes = pixel_passes(state)
    variance = mean_variance(state.luminance, state.luminance_squared, state.scatter[:, 0], passes)
    mean = state.luminance / passes.clamp(min=1)
    return tile_errors(mean, variance, state.weight > 0, state.camera.width, state.camera.height)


def frame_gbuffer(state: FrameState) -> GBuffer:
    """The rasterised one, or the mean over passes of what rays to the mesh saw."""
    if state.gbuffer is not None:
        return state.gbuffer
    shape = (state.camera.height, state.camera.width)
    coverage = (state.weight / pixel_passes(state).clamp(min=1)).reshape(shape)
    mean = (state.surface / state.weight.clamp(min=1)[:, None]).reshape(*shape, 15)
    depth = torch.where(coverage > 0, mean[..., 14], torch.inf)
    normal, wo = (torch.nn.functional.normalize(mean[..., a : a + 3], dim=-1) for a in (3, 6))
    return GBuffer(coverage, depth, mean[..., :3], normal, wo, mean[..., 9:12], mean[..., 12], mean[..., 13])


def frame_history(state: FrameState) -> History | None:
    """What the frame is worth to the next one, seen by another camera; None before the first pass."""
    if state.passes == 0:
        return state.history
    gbuffer = frame_gbuffer(state)
    return remember(_blended(state, gbuffer), gbuffer, state.camera, _own_samples(state), state.reprojected)


def _own_samples(state: FrameState) -> Tensor:
    total = samples_a_pass(state.settings, state.fixed is None).total
    return (pixel_passes(state) * total).float().reshape(state.camera.height, state.camera.width)


def _blended(state: FrameState, gbuffer: GBuffer) -> Radiance:
    """Straight (alpha-normalised) radiance with what history adds; the variance is that of the mean of one pixel's passes."""
    shape = (state.camera.height, state.camera.width)
    weight, passes = state.weight.clamp(min=1), pixel_passes(state)
    variance = mean_variance(state.luminance, state.luminance_squared, state.scatter[:, 0], passes) * (passes.clamp(min=1) / weight) ** 2
    scatter = state.scatter / (weight * weight)[:, None]
    radiance = Radiance(
        (state.diffuse / weight[:, None]).reshape(*shape, 3),
        (state.specular / weight[:, None]).reshape(*shape, 3),
        variance.reshape(shape),
        (state.visibility / weight).reshape(shape),
        state.passes * samples_a_pass(state.settings, state.fixed is None).total,
        scatter[:, 1].reshape(shape),
        scatter[:, 2].reshape(shape),
    )
    if state.reprojected is None:
        return radiance
    return blend_history(radiance, state.reprojected, gbuffer, _own_samples(state))


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
