"""Whether light stood still with the object or with the camera, where pictures do not show what is around: a short fit of surfels by either, compared
on photographs that it has not seen.

How brightness goes with the frames (capture/turning_light) is asked first, and costs nothing; but it goes with the camera's also where the hull is far
from the surface. Radiance may not depend on the view here, for it would explain what the wrong light does not.

In: Views with masks, points on their hull. Out: the errors of both, and what they say.
"""

from collections.abc import Callable
from dataclasses import replace

import torch

from drgs.reconstruct.capture.cut_to_box import chosen_views
from drgs.reconstruct.capture.hull_rays import SOLID
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.capture.turning_light import LightFound, with_light_of_camera
from drgs.reconstruct.fit.densify import DensifySettings
from drgs.reconstruct.fit.fit_loop import FitState
from drgs.reconstruct.fit.losses import display_image
from drgs.reconstruct.fit.surfels.fit_gaussians import FitSettings, drawn_object, fit_gaussians, size_factor, start_fit
from drgs.reconstruct.fit.view_targets import view_targets
from drgs.scene.views import Views

SETTINGS = FitSettings(iterations=100, half_size_share=0.0, most_pixels=112 * 112, sh_start=2.0, densify=DensifySettings(start=2.0))
"""Begins and ends with as many surfels; no harmonics."""
POINTS = 5000
LEFT_OUT = 8
"""One photograph in so many."""
BETTER = 0.9
"""The light is the camera's where that leaves at most this share of the error."""


def try_light_frames(
    views: Views,
    points: InitialPoints,
    seed: int,
    device: torch.device,
    report: Callable[[float], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> tuple[float, float] | None:
    """Mean squared error (display space) of what masks fill in the photographs left out, by light of the object and of the camera: 0 where they fill no
    pixel. None when should_stop() said so."""
    count, errors = len(views.cameras), []
    left_out = list(range(LEFT_OUT // 2, count, LEFT_OUT)) or [count - 1]
    kept = [number for number in range(count) if number not in left_out]
    every = slice(None, None, 1 + len(points.points_world) // POINTS)
    normals = points.normals_world
    fewer = replace(
        points,
        points_world=points.points_world[every],
        colors_srgb=points.colors_srgb[every],
        normals_world=None if normals is None else normals[every],
    )
    settings = replace(SETTINGS, seed=seed)
    for index, lit in enumerate((views, with_light_of_camera(views))):
        state = start_fit(fewer, settings, device)
        told = None if report is None else lambda r, index=index: report((index + r.iteration / r.iterations) / 2)
        fit_gaussians(chosen_views(lit, kept), state, settings, points.bounds_radius, told, should_stop)
        if state.iteration < settings.iterations:
            return None
        errors.append(_error_of(chosen_views(lit, left_out), state, points.bounds_radius, device))
    return errors[0], errors[1]


def light_by_trial(found: LightFound, of_object: float, of_camera: float) -> LightFound:
    """What try_light_frames' errors say of a light that wanted a trial; as it was found where there was nothing to compare."""
    if of_object == 0:
        return replace(found, wants_trial=False)
    left = f"in photographs that surfels were not fitted to the camera's light leaves {of_camera / of_object:.2f} of the error that the object's leaves"
    return replace(found, frame="camera" if of_camera < BETTER * of_object else "object", why=f"{found.why}; {left}", wants_trial=False)


def _error_of(views: Views, state: FitState, radius: float, device: torch.device) -> float:
    drawn, squared, pixels = drawn_object(state, radius, 0), 0.0, 0
    for target in view_targets(views, size_factor(views.cameras, SETTINGS.most_pixels), device):
        radiance, coverage = drawn(target)
        solid = target.mask > SOLID
        difference = display_image(radiance, coverage, target.saturation, target.ceiling).clamp(0, 1) - target.saturation
        squared += float(difference[solid].square().sum())
        pixels += 3 * int(solid.sum())
    return squared / max(pixels, 1)
