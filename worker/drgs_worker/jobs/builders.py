"""The function that turns a capture into an asset, found by name so that jobs and tests can name another.

A builder is called as `builder(request, tell, should_stop)` and yields the name of each of its stages (STAGE_SHARES) when its result is on disk:
checkpoints in `OUT.build/`, from which a second call goes on, and in the end the asset at `request.out` (atomically). It raises
JobStopped soon after `should_stop()` turns true.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path

from drgs.reconstruct.progress import Progress
from drgs.scene.strokes import Stroke
from drgs_worker.jobs.capture_report import examine_capture
from drgs_worker.jobs.progress import JobStopped, Tell
from drgs_worker.jobs.requests import CameraName, LightName, MaskName

Corner = tuple[float, float, float]

DEFAULT_BUILDER = "drgs_worker.jobs.builders:build_with_drgs"
BUILDER_VARIABLE = "DRGS_BUILDER"
"""Environment variable `module:function`."""


@dataclass(frozen=True)
class BuildRequest:
    """One build, in plain values."""

    dataset: Path
    out: Path
    preset: str
    seed: int
    device: str
    """auto, cpu or cuda."""
    materials: str | None = None
    """Preset of the stage `materials`; None: `preset`."""
    binding: str = "particles"
    """particles or mesh."""
    light: LightName = "auto"
    up: tuple[float, float, float] = (0.0, 0.0, 1.0)
    """Of the capture's world."""
    box: tuple[Corner, Corner] | None = None
    """Low and high corner in the asset's world; None: all of the object is built."""
    strokes: tuple[Stroke, ...] = ()
    """None: the capture's own masks count."""
    masks: MaskName = "auto"
    cameras: CameraName = "auto"


Builder = Callable[[BuildRequest, Tell, Callable[[], bool]], Iterator[str]]


def find_builder() -> Builder:
    """The builder that the environment names, or the real one.

    Raises:
        ValueError: the name is not `module:function` of something that can be imported.
    """
    name = os.environ.get(BUILDER_VARIABLE, DEFAULT_BUILDER)
    module, _, function = name.partition(":")
    try:
        return getattr(import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(f"{BUILDER_VARIABLE}={name}: expected module:function of a builder; {error}") from error


def build_with_drgs(request: BuildRequest, tell: Tell, should_stop: Callable[[], bool]) -> Iterator[str]:
    """drgs.evaluate.doctor's report, then drgs.reconstruct.build_asset.build_stages, resumed from its checkpoints where there are some."""
    from drgs.reconstruct import build_asset as build
    from drgs.reconstruct.capture.build_box import BuildBox

    settings = build.BuildSettings(
        request.preset,
        request.binding,
        request.device,
        request.seed,
        resume=True,
        light=request.light,
        up=request.up,
        box=None if request.box is None else BuildBox(*request.box),
        strokes=request.strokes,
        materials=request.materials,
        masks=request.masks,
        cameras=request.cameras,
    )

    if request.materials is None:  # else the capture was examined by the build whose geometry this one takes
        tell(Progress("read", 0, 0, 0.0, message="checking the capture"))
        tell(examine_capture(request.dataset, Path(f"{request.out}.build") / "capture.json"))
    try:
        for stage, _ in build.build_stages(request.dataset, request.out, settings, progress=tell, should_stop=should_stop):
            yield stage
    except build.BuildStopped as stopped:
        raise JobStopped from stopped
