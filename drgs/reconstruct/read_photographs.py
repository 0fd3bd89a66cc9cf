"""The first stage of a build: a capture becomes posed, masked views, and points where surfels begin.

Each step is a function of its own file; here they meet, as in build_asset.py: poses where pictures have none, masks where they have none, what the light stood
still with, hollows.

In: a capture, settings. Out: what was read, as the fits see it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from drgs.reconstruct.build_settings import BuildSettings
from drgs.reconstruct.capture.cut_to_box import views_of
from drgs.reconstruct.capture.exposures import with_gains_of_points
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.capture.load_views.capture import Capture
from drgs.reconstruct.capture.masks_by_strokes import masks_by_strokes
from drgs.reconstruct.capture.open_capture import open_capture
from drgs.reconstruct.capture.turning_light import LightFound, light_found, with_light_of_camera
from drgs.reconstruct.fit.surfels.try_light_frames import light_by_trial
from drgs.reconstruct.pose.pose_photographs import PoseSettings
from drgs.reconstruct.pose.posed_dataset import needs_poses, pose_source, provenance_of
from drgs.reconstruct.presets import Preset
from drgs.reconstruct.progress import POSED, BuildStopped, Progress
from drgs.reconstruct.report_progress import BuildReporter
from drgs.reconstruct.stages import (
    Workplace,
    capture_digest,
    forget_checkpoints,
    ground_again_stage,
    ground_stage,
    hollows_stage,
    light_stage,
    masks_stage,
    points_of_found_masks,
    points_on_ground,
)
from drgs.scene.strokes import Stroke
from drgs.scene.views import Views

POSING_SHARE = 0.7
"""Of the stage `read`, where pictures are posed in it."""


@dataclass(frozen=True, eq=False)
class PhotographsRead:
    """What the stages after reading go on from."""

    place: Workplace
    capture: Capture
    photographs: Views
    """As they were opened: what an asset keeps for comparing."""
    views: Views
    """As the fits see them."""
    points: InitialPoints
    preset: Preset
    """The settings' own, or what light that turns with the camera makes of it."""
    light: LightFound
    facts: dict[str, Any]
    """Of how poses and masks were found, for the asset's provenance; empty where the capture has both."""


def read_photographs(
    dataset: Path,
    out: Path,
    settings: BuildSettings,
    preset: Preset,
    device: torch.device,
    reporter: BuildReporter,
    should_stop: Callable[[], bool] | None,
) -> PhotographsRead:
    """Read a capture, find what it does not say, and where its surface may lie.

    Args:
        dataset, out, settings, should_stop: as build_asset takes them. preset: of the settings.

    Raises:
        ValueError: the capture or a checkpoint is wrong, in one sentence.
        BuildStopped: as asked.
    """
    reporter.report("read", 0.0, "reading the capture")
    folder, facts = _posed(dataset, out, settings, reporter, should_stop)
    stop = should_stop or (lambda: False)
    capture, views, points = _opened(folder, settings, preset, reporter, stop)
    photographs, gains_of_files = views, views.gains is not None
    views = with_gains_of_points(views, points)
    identity: dict[str, Any] = {"preset": settings.preset, "seed": settings.seed, "capture": capture_digest(views, settings.box)}
    place = Workplace(Path(f"{out}.build"), identity, settings.resume, reporter, stop)
    if not settings.resume:
        forget_checkpoints(place)
    masked = views
    if not views.has_masks:
        views, masked, points = _with_found_masks(place, views, points, device, settings, preset)
        facts |= {"object_found_by": "surroundings" if views.ground is None else "ground"}
    light = _light(settings, preset, capture, masked, points)
    # Masks that a build had to find are of whole pictures, whose room mostly stands still with the object.
    if light.wants_trial and views.has_masks:
        light = light_by_trial(light, *light_stage(place, masked, points, settings.seed, device))
    if light.frame == "camera":
        views, masked, place = with_light_of_camera(views), with_light_of_camera(masked), place.of(light="camera")
        preset = preset.under_turning_light()
    points = hollows_stage(place, masked, points, preset, settings.seed, device, settings.box)
    if light.frame == "camera" and not gains_of_files:
        # with_gains_of_points took for exposures what the light's turns do. It helps to look for hollows as if light stood still; a fit has the light.
        views = replace(views, gains=None)
    return PhotographsRead(place, capture, photographs, views, points, preset, light, facts)


def _posed(
    dataset: Path, out: Path, settings: BuildSettings, reporter: BuildReporter, should_stop: Callable[[], bool] | None
) -> tuple[Path, dict[str, Any]]:
    """The capture with cameras, and what the asset tells of how they were found; the very dataset where it has them."""
    if not needs_poses(dataset):
        return dataset, {}
    place = Path(f"{out}.build") / POSED
    place.parent.mkdir(parents=True, exist_ok=True)
    pose_settings = PoseSettings(seed=settings.seed, resume=settings.resume)

    def report(at: Progress) -> None:
        reporter.report("read", POSING_SHARE * at.fraction, at.message)

    found = pose_source(dataset, place, pose_settings, progress=report, should_stop=should_stop)
    reporter.begun["read"] = POSING_SHARE
    return place, {"poses": provenance_of(found)}


def _opened(
    capture: Path, settings: BuildSettings, preset: Preset, reporter: BuildReporter, should_stop: Callable[[], bool]
) -> tuple[Capture, Views, InitialPoints]:
    """open_capture, as the settings say."""
    masked_by = _by_strokes(settings.strokes, reporter, should_stop) if settings.strokes else None
    given = (settings.seed, settings.up, settings.box, masked_by, preset.hull)
    return open_capture(capture, preset.image_side, preset.points, *given, sharpen=settings.masks == "auto", nearer=True)


def _by_strokes(strokes: tuple[Stroke, ...], reporter: BuildReporter, should_stop: Callable[[], bool]) -> Callable[[Views], Views]:
    """masks_by_strokes, as open_capture takes it."""

    def masked(views: Views) -> Views:
        def report(share: float) -> None:
            reporter.report("read", share, "finding masks by strokes")

        found = masks_by_strokes(views, strokes, report=report, should_stop=should_stop)
        if found is None:
            raise BuildStopped
        return found

    return masked


def _with_found_masks(
    place: Workplace,
    views: Views,
    points: InitialPoints,
    device: torch.device,
    settings: BuildSettings,
    preset: Preset,
) -> tuple[Views, Views, InitialPoints]:
    """Views without masks, but with the ground where there is one; the same with masks, for what looks at the object; points on those."""
    fit_settings = replace(preset.fit, seed=settings.seed)
    views = ground_stage(place, views, settings.seed)
    points = points_on_ground(views, points, preset.points, settings.seed, settings.box, preset.hull)
    masked = masks_stage(place, views, points, fit_settings, device, settings.box)
    views = views_of(views, masked)  # without those in which the box's content is hidden
    if views.ground is not None:
        views, masked = ground_again_stage(place, views, masked, settings.seed)
    return views, masked, points_of_found_masks(masked, points, preset.points, settings.seed, settings.box, preset.hull)


def _light(settings: BuildSettings, preset: Preset, capture: Capture, views: Views, points: InitialPoints) -> LightFound:
    """What the light stood still with: as it was said, else as the pictures say."""
    if settings.light != "auto":
        return LightFound(settings.light, "it was said so")
    if preset.materials_on == "surfels":
        return LightFound("object", "materials are fitted on surfels")
    return light_found(capture, views, points)
