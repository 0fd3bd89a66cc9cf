"""The function that turns a capture into an asset, found by name so that jobs and tests can name another.

A builder is called as `builder(request, progress, should_stop)` and gives the name of each of its STAGES as it is finished, its result on
disk: checkpoints in `OUT.build/`, so that a second call goes on behind the last one, and in the end the asset at `request.out`
(atomically). It raises BuildStopped soon after `should_stop()` turns true.
"""

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields
from importlib import import_module
from pathlib import Path

from worker.capture_report import CaptureReport, examine_capture

DEFAULT_BUILDER = "worker.builders:build_with_drgs"
BUILDER_VARIABLE = "DRGS_BUILDER"
"""Environment variable `module:function`."""
STAGES = {
    "particles": ("read", "fit", "mesh", "materials", "pack"),
    "mesh": ("read", "fit", "mesh", "bind", "materials", "pack"),
}
"""Of either binding: those of drgs.build.build_asset.STAGE_SHARES and MESH_STAGE_SHARES."""


class BuildStopped(Exception):
    """should_stop() was true; the checkpoint is on disk."""


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


@dataclass(frozen=True)
class BuildProgress:
    """How far a build is; the fields of drgs.build.build_asset.Progress, and what was found before it began."""

    stage: str
    iteration: int
    iterations: int
    fraction: float
    """Of the whole build, 0..1."""
    psnr: float | None = None
    message: str = ""
    eta_seconds: float | None = None
    preview_jpeg: bytes | None = None
    capture: CaptureReport | None = None
    """What the doctor found; told once, before the capture is read for the build."""


Builder = Callable[[BuildRequest, Callable[[BuildProgress], None], Callable[[], bool]], Iterator[str]]


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


def build_with_drgs(request: BuildRequest, progress: Callable[[BuildProgress], None], should_stop: Callable[[], bool]) -> Iterator[str]:
    """drgs.build.doctor's report, then drgs.build.build_asset.build_stages, resumed from its checkpoints where there are some."""
    from drgs.build import build_asset as build

    settings = build.BuildSettings(request.preset, request.binding, request.device, request.seed, resume=True, materials=request.materials)

    def report(made: build.Progress) -> None:
        progress(BuildProgress(**{entry.name: getattr(made, entry.name) for entry in fields(made)}))

    if request.materials is None:  # else another build did, whose geometry this one is on
        progress(BuildProgress("read", 0, 0, 0.0, message="checking the capture"))
        capture = examine_capture(request.dataset, Path(f"{request.out}.build") / "capture.json")
        progress(BuildProgress("read", 0, 0, 0.0, capture=capture))
    try:
        for stage, _ in build.build_stages(request.dataset, request.out, settings, progress=report, should_stop=should_stop):
            yield stage
    except build.BuildStopped as stopped:
        raise BuildStopped from stopped
