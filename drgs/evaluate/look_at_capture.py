"""What can be seen of a capture before a build: the sheet of its pictures, and its cameras, points and the object's box, for a small picture in 3D.

In: a folder. Out: a picture and plain data for JSON. Bounded however large the capture is. A capture that cannot be read has findings and, where there are
pictures, a sheet; photographs that are not posed yet have no cameras.
"""

from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from drgs.evaluate.contact_sheet import contact_sheet
from drgs.evaluate.doctor.doctor import examine
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.capture.turn_up import up_of_cameras
from drgs.scene.camera import Camera, opengl_from_camera

MOST_CAMERAS = 400
"""Of more, evenly chosen ones are told."""
MOST_POINTS = 3000
DIRECTIONS = 300
"""In which the hull's outermost places are told. They are 9 degrees apart, so that a box of any world about those places misses a hundredth of the
hull's width at most."""
DIGITS = 5
"""Of coordinates, a ten-thousandth of the object or finer where its world is of the usual size."""


def look_at_capture(folder: Path, sheet: Path, name: str) -> dict[str, Any]:
    """Write the sheet, where there are pictures, and return the rest.

    Args:
        sheet: as contact_sheet's `out`; not there yet.
        name: of the capture. Sentences call it so, and its files by their places in it: where it lies on this machine is for nobody else.

    Keys: ok, summary and findings as of the doctor; has_sheet; sheet, its SheetLayout, or None; camera_count (0: not posed yet, or unreadable); cameras, as the asset's training views
    are told (docs/protocol.md); up, the mean of the cameras' own, or None; box_low and box_high, corners of the object's box [world units] or None; box_origin, masks or cameras (a guess: what all
    cameras see); outermost, three numbers for each place that tells how far the hull reaches [world units], none without masks; points and colors, three numbers for each point [world units; sRGB 0..1].
    """
    examined = examine(folder)
    report, views, points = _by_name(examined.report, folder, name), examined.views, examined.points
    layout = None
    with suppress(ValueError):  # a film, or nothing that is a picture: the findings say so
        layout = asdict(contact_sheet(folder, report, sheet))
    look: dict[str, Any] = {
        "ok": report["ok"],
        "summary": report["summary"],
        "findings": report["findings"],
        "has_sheet": sheet.is_file(),
        "sheet": layout,
        "camera_count": 0,
        "cameras": [],
        "up": None,
        "box_low": None,
        "box_high": None,
        "box_origin": None,
        "outermost": [],
        "points": [],
        "colors": [],
    }
    if views is None or points is None:
        return look
    count = len(views.cameras)
    shown = [views.cameras[number] for number in told_cameras(count)]
    up = up_of_cameras(np.stack([opengl_from_camera(camera).numpy() for camera in views.cameras])).round(DIGITS).tolist()
    return look | {"camera_count": count, "cameras": [_told_camera(camera) for camera in shown], "up": up} | _told_points(points)


def told_cameras(count: int) -> list[int]:
    """Numbers of the cameras that are told of a capture with so many."""
    return list(range(count)) if count <= MOST_CAMERAS else [number * count // MOST_CAMERAS for number in range(MOST_CAMERAS)]


def _by_name(report: dict[str, Any], folder: Path, name: str) -> dict[str, Any]:
    """The doctor's report without paths of this machine."""

    def told(sentence: str) -> str:
        return sentence.replace(f"{folder}/", "").replace(str(folder), name)

    findings = [finding | {key: told(finding[key]) for key in ("sentence", "advice")} for finding in report["findings"]]
    return report | {"folder": name, "summary": told(report["summary"]), "findings": findings}


def _told_camera(camera: Camera) -> dict[str, Any]:
    fx, fy, cx, cy = (float(camera.intrinsics[row, column]) for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
    return {
        "name": camera.name,
        "width": camera.width,
        "height": camera.height,
        "world_from_camera": opengl_from_camera(camera).numpy().round(DIGITS).tolist(),
        "left": -cx / fx,
        "right": (camera.width - cx) / fx,
        "bottom": (cy - camera.height) / fy,
        "top": cy / fy,
    }


def _told_points(points: InitialPoints) -> dict[str, Any]:
    """The box, and such points as say something: those at random do not."""
    if points.hull_vertices is not None:
        low, high, origin = points.hull_vertices.amin(0), points.hull_vertices.amax(0), "masks"
    else:
        low, high, origin = points.bounds_center - points.bounds_radius, points.bounds_center + points.bounds_radius, "cameras"
    outermost = [] if points.hull_vertices is None else _outermost(points.hull_vertices.double().numpy()).round(DIGITS).reshape(-1).tolist()
    count = 0 if points.origin == "random" else len(points.points_world)
    kept = np.random.default_rng(0).permutation(count)[:MOST_POINTS]
    return {
        "box_low": low.double().numpy().round(DIGITS).tolist(),
        "box_high": high.double().numpy().round(DIGITS).tolist(),
        "box_origin": origin,
        "outermost": outermost,
        "points": points.points_world[kept].double().numpy().round(DIGITS).reshape(-1).tolist(),
        "colors": points.colors_srgb[kept].double().numpy().round(2).reshape(-1).tolist(),
    }


def _outermost(vertices: Float[ndarray, "vertex 3"]) -> Float[ndarray, "place 3"]:
    """Those of the vertices that are farthest in some of many even directions, the axes among them: each once."""
    number = np.arange(DIRECTIONS) + 0.5
    z, angle = 1 - 2 * number / DIRECTIONS, np.pi * (1 + 5**0.5) * number  # Fibonacci's lattice on the sphere
    flat = np.sqrt(1 - z * z)
    directions = np.concatenate([np.stack([flat * np.cos(angle), flat * np.sin(angle), z], -1), np.eye(3), -np.eye(3)])
    return vertices[np.unique((vertices @ directions.T).argmax(0))]
