"""Check a capture before time is spent on it: what was found, what will hurt the result, what to do about it.

In: a folder. Out: plain JSON data, and to those who show it also the cameras and points that it is about. A folder that cannot be read is a finding, not
an exception.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drgs.evaluate.doctor.cameras import directions, intrinsics, looking_away, scale
from drgs.evaluate.doctor.findings import Finding, Section, told
from drgs.evaluate.doctor.light import exposure, light
from drgs.evaluate.doctor.masks import first_points, masks
from drgs.evaluate.doctor.photographs import photographs
from drgs.evaluate.doctor.picture_looks import files_of_capture, picture_looks
from drgs.evaluate.doctor.pictures import files, looks, sizes
from drgs.evaluate.doctor.places import places
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.capture.load_views.checks import CaptureFault
from drgs.reconstruct.capture.open_capture import open_capture
from drgs.reconstruct.pose.posed_dataset import needs_poses
from drgs.scene.views import Views

EXAMINED_SIDE = 400
"""Pictures are examined at this size [pixels]; what it hides does not matter here."""
EXAMINED_POINTS = 20_000
WHAT_IS_READ = (
    "Mend that first. A capture is a folder with transforms_train.json (NeRF-synthetic), transforms.json (nerfstudio), "
    "sparse/ and images/ (COLMAP), Metashape's *.xml, RealityCapture's *.csv or NeRO's cameras, and with all pictures that these name."
)
WHAT_TO_TAKE = (
    "Take 40 to 100 sharp pictures from all around and at two or three heights, each overlapping the next by two thirds, the object and what stands "
    "around it at rest."
)


@dataclass(frozen=True, eq=False)
class Examined:
    """A capture and what is said of it."""

    report: dict[str, Any]
    """As `doctor` gives it."""
    views: Views | None = None
    """Shrunken to EXAMINED_SIDE; None where there are no cameras yet, or the capture cannot be read."""
    points: InitialPoints | None = None
    """At most EXAMINED_POINTS; None where there are no views."""


def doctor(folder: Path) -> dict[str, Any]:
    """Report on a capture; `ok` says whether a build can start. Keys: see docs of `drgs doctor`."""
    return examine(folder).report


def examine(folder: Path) -> Examined:
    """The same, with what was read of the capture."""
    folder = Path(folder)
    if needs_poses(folder):
        try:
            report, of_photographs = photographs(folder, WHAT_TO_TAKE)
        except (ValueError, OSError) as error:
            return Examined(_refusal(folder, error, WHAT_TO_TAKE))
        ok = not any(finding.level == "error" for finding in of_photographs)
        return Examined({"ok": ok, "folder": str(folder), **report, **told(of_photographs)})
    try:
        capture, views, points = open_capture(folder, EXAMINED_SIDE, EXAMINED_POINTS, seed=0)
    except (ValueError, OSError) as error:
        return Examined(_refusal(folder, error, WHAT_IS_READ))

    report = {"ok": True, "folder": str(folder), "source": capture.source, "views": len(capture.photographs)}
    findings: list[Finding] = []
    mistaken: list[str] = []
    """Pictures that something is said of: what follows from that is not said again."""

    def add(section: str, examined: Section) -> None:
        report[section] = examined[0]
        findings.extend(examined[1])
        mistaken.extend(name for finding in examined[1] for name in finding.pictures)

    add("pictures", sizes(capture))
    add("files", files(folder, capture))
    add("intrinsics", intrinsics(capture, looking_away(views, points)))
    # All can be read: they were.
    add("looks", looks([look for look in picture_looks(files_of_capture(capture)) if not isinstance(look, str)]))
    add("masks", masks(capture, views, points, mistaken))
    add("scale", scale(views, points))
    add("directions", directions(views, points))
    add("places", places(views, points, mistaken))
    add("exposure", exposure(views, points, mistaken))
    add("initial_points", first_points(views, points))
    add("light", light(capture, views, points))
    report |= report.pop("pictures")
    return Examined({**report, "summary": _summary(report), **told(findings)}, views, points)


def _refusal(folder: Path, error: ValueError | OSError, advice: str) -> dict[str, Any]:
    sentence = f"{error.filename}: {error.strerror}." if isinstance(error, OSError) and error.filename else str(error)
    finding = Finding("error", sentence, advice)
    if isinstance(error, CaptureFault):
        finding = Finding("error", sentence, error.advice, error.pictures, error.mark)
    return {"ok": False, "folder": str(folder), "summary": "", **told([finding])}


def _summary(report: dict[str, Any]) -> str:
    width, height = report["size"]
    masks = report["masks"]
    about = f"with masks; the object fills {100 * masks['mean_coverage']:.0f} % of them" if masks["present"] else "without masks"
    others = f" and {len(report['sizes']) - 1} other sizes" if len(report["sizes"]) > 1 else ""
    return f"{report['views']} pictures of {width}x{height}{others} {about}."
