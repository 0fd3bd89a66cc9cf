"""The picture of a frame in the making: sums in, Frame out, at any time.

All but the last step happens in the window around the tiles that show something; around it the picture is empty.
"""

import time
from dataclasses import asdict, dataclass
from typing import Any
from weakref import WeakKeyDictionary

import torch
import warp as wp
from torch import Tensor

from drgs.render.film.blur_environment import blurred_light
from drgs.render.film.denoise import denoise
from drgs.render.film.denoise.svgf import MOVING, filter_light, settings_for
from drgs.render.film.tonemap import tonemap
from drgs.render.integrate.environment_table import EnvironmentLight, lookup_radiance, uv_from_world_direction
from drgs.render.progressive.converge import frame_errors
from drgs.render.progressive.frame_state import FrameState, GaussianView
from drgs.render.progressive.invalidate import same_camera
from drgs.render.progressive.mean_radiance import mean_gbuffer, mean_radiance, quick_radiance
from drgs.render.records import Frame
from drgs.scene.camera import Camera, world_from_pixel
from drgs.scene.tone_curve import ToneCurve
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


def resolve_frame(state: FrameState) -> Frame:
    """The picture so far."""
    clock = time.perf_counter()
    settings, window = state.inputs.settings, state.window
    maps, camera, quick = mean_gbuffer(state), window.camera(state.inputs.camera), state.quick_picture
    if quick is not None and settings.denoise == "svgf":
        filtered = filter_light(quick.history.light, maps, camera, settings_for(state.samples) if quick.of_edit else MOVING)
        shown = quick_radiance(quick, filtered, state.samples)
    else:
        shown = denoise(mean_radiance(state), maps, camera, settings.denoise)
    denoised = time.perf_counter()
    linear = window.pad(shown.diffuse + shown.specular)
    rgba = _rgba(state, linear, maps.coverage)
    surface = state.view.gbuffer if isinstance(state.view, GaussianView) else maps
    seconds = {**state.seconds, "denoise": denoised - clock, "resolve": time.perf_counter() - denoised}
    return Frame(rgba, linear, surface, shown, window.pad, _metadata(state, seconds))


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


def _rgba(state: FrameState, linear: Tensor, coverage: Tensor) -> Tensor:
    """(height, width, 4) as it is shown.

    Args:
        linear: of the whole image. coverage: of the window.
    """
    settings, window = state.inputs.settings, state.window
    if (behind := _behind(state)) is None:
        return window.pad(tonemap(window.crop(linear), coverage, settings.exposure, curve=settings.tone_curve))
    look = settings.exposure, settings.tone_curve
    if look != behind.look:  # pictures of a moving camera look at each once
        behind.look, behind.seen = look, None
        return tonemap(linear, window.pad(coverage), settings.exposure, behind.radiance, settings.tone_curve)
    if behind.seen is None:
        nothing = torch.zeros_like(linear[..., 0])
        behind.seen = tonemap(linear, nothing, settings.exposure, behind.radiance, settings.tone_curve)
    rgba, radiance = behind.seen.clone(), behind.radiance
    inside = radiance if radiance.ndim == 1 else window.crop(radiance)
    shown = rgba[window.rows, window.columns]
    tonemap(window.crop(linear), coverage, settings.exposure, inside, settings.tone_curve, shown)
    return rgba


def _metadata(state: FrameState, seconds: dict[str, float]) -> dict:
    """Plain JSON: how the picture was made, and what was left out."""
    return {
        "samples": state.samples,
        "passes": state.passes,
        "bounces": state.inputs.settings.bounces,
        "counts": asdict(state.plan.counts),
        "candidates": state.plan.candidates,
        "skipped": [asdict(skip) for skip in state.plan.skips],
        "horizons": _horizons(state),
        "made": list(state.computed_parts),
        "error": None if state.is_quick else round(float(frame_errors(state).max()), 6),  # history and filter are in no estimate of it
        "tiles_at_rest": int((~state.tiles.active).sum()),
        "tiles": len(state.tiles.active),
        "primary": state.inputs.primary,
        "milliseconds": {step: round(1000 * duration, 3) for step, duration in seconds.items()},
    }


def _horizons(state: FrameState) -> dict[str, float]:
    """How far the search for rays that need no tracing has come, and what it found."""
    horizons = state.traced.tracer.horizons if state.inputs.settings.skip else None
    if horizons is None:
        return {"faces": 0, "faces_known": 0, "rays_spared": 0.0}
    return {"faces": horizons.faces, "faces_known": horizons.found, "rays_spared": round(horizons.spared(), 4)}


def _background(state: FrameState) -> Tensor | None:
    """(3,) or (height, width, 3) linear; None where the picture stays transparent."""
    behind = _behind(state)
    return None if behind is None else behind.radiance


def _behind(state: FrameState) -> "_Behind | None":
    """What is behind the picture; None where that stays transparent."""
    background, inputs = state.inputs.settings.background, state.inputs
    if background == "transparent":
        return None
    if not isinstance(background, str):
        return _Behind(inputs.camera, inputs.rows, torch.tensor(background, device=state.sums.weight.device))
    scene, light = inputs.scene, state.traced.environment_light
    if background == "blurred":
        light = blurred_light(scene.environment, scene.environment_rotation_degrees, scene.environment_intensity)
    known = _behinds.get(light)
    if known is None or known.rows != inputs.rows or not same_camera(known.camera, inputs.camera):
        known = _behinds[light] = _Behind(inputs.camera, inputs.rows, _environment_behind(state, light))
    return known


@dataclass(eq=False)
class _Behind:
    """What a camera sees of the environment where nothing is in its way."""

    camera: Camera
    rows: slice
    radiance: Tensor
    """(height, width, 3), or the (3,) colour of a screen."""
    look: tuple[float, ToneCurve] | None = None
    """Exposure [stops] and tone curve of the last picture."""
    seen: Tensor | None = None
    """(height, width, 4) under that look, from the second picture on."""


_behinds: WeakKeyDictionary[Any, _Behind] = WeakKeyDictionary()
"""Of lights that are used, by the last camera: pictures that get better, and those after an edit, have the same behind them."""


def _environment_behind(state: FrameState, light: Any) -> Tensor:
    camera, rows = state.inputs.camera, state.inputs.rows
    radiance = state.sums.weight.new_empty(state.inputs.height, camera.width, 3)
    inputs = [camera.width, rows.start, wp.mat33(*world_from_pixel(camera).flatten().tolist()), light]
    launch(
        environment_behind, state.inputs.height * camera.width, inputs, [warp_array(radiance.view(-1, 3), wp.vec3)], warp_device(radiance)
    )
    return radiance


@wp.kernel
def environment_behind(
    first: int,
    width: int,
    top: int,
    world_of_pixel: wp.mat33,
    light: EnvironmentLight,
    # outputs
    radiance: wp.array[wp.vec3],
):
    i = first + wp.tid()
    y = i / width
    direction = world_of_pixel * wp.vec3(float(i - y * width) + 0.5, float(top + y) + 0.5, 1.0)
    radiance[i] = lookup_radiance(light, uv_from_world_direction(light, wp.normalize(direction)))
