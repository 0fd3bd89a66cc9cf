"""Pictures of a build's progress: PSNR and number of surfels, over minutes and over iterations, one curve a variant."""

import re
from pathlib import Path

from benchmarks._plot import Curve, linear_svg

POINTS = 200
"""Of a curve at most; a build reports more often."""
SHOWN = {"fit": "", "materials": " (materials)"}
"""Stages with a PSNR, and how their curves are named."""


def write_curves(folder: Path, progress: dict[str, dict[str, list[dict]]]) -> list[Path]:
    """`<scene>_<what>_<over>.svg` in the folder.

    Args:
        progress: by scene and variant, the events of build_process.read_events.
    """
    written = []
    for scene, by_variant in progress.items():
        for what, unit in (("psnr", "PSNR of the last training views [dB]"), ("surfels", "surfels")):
            for over, axis in (("minutes", "minutes"), ("iterations", "iteration of the stage")):
                curves = [curve for variant, events in by_variant.items() for curve in curves_of(variant, events, what, over)]
                if curves:
                    folder.mkdir(parents=True, exist_ok=True)
                    path = folder / f"{scene}_{what}_{over}.svg"
                    path.write_text(linear_svg(curves, scene, axis, unit))
                    written.append(path)
    return written


def curves_of(name: str, events: list[dict], what: str, over: str) -> list[Curve]:
    """One curve for each stage that tells `what` (psnr or surfels) over minutes or iterations."""
    curves = []
    for stage, note in SHOWN.items():
        points = []
        for event in (event for event in events if event["stage"] == stage):
            value = event["psnr"] if what == "psnr" else _surfels(event["message"])
            if value is not None and event["iteration"] > 0:
                points.append((event["elapsed_seconds"] / 60 if over == "minutes" else event["iteration"], float(value)))
        if len(points) > 1:
            step = -(-len(points) // POINTS)
            curves.append(Curve(name + note, [*points[::step], points[-1]]))
    return curves


def _surfels(message: str) -> int | None:
    found = re.match(r"(\d+) surfels", message)
    return int(found.group(1)) if found else None
