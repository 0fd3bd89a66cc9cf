"""The cameras that an asset was built from, and what they saw, out of its folder without loading it (no torch here)."""

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from drgs.exchange.photographs import PHOTOGRAPHS


@dataclass(frozen=True)
class ViewOfCapture:
    """A training camera. Edges are those of its picture on the plane at distance 1 before it, x to the right and y up."""

    name: str
    width: int
    """Pixels of the photograph as the build saw it."""
    height: int
    world_from_camera: list[list[float]]
    """OpenGL camera-to-world, rows [world units]."""
    left: float
    right: float
    bottom: float
    top: float


def training_views(folder: Path) -> list[ViewOfCapture]:
    """From cameras.json, in its order; none where an asset has no such file.

    Raises:
        ValueError: the file is damaged.
    """
    path = folder / "cameras.json"
    if not path.is_file():
        return []
    try:
        return [_view(frame) for frame in json.loads(path.read_text())["frames"]]
    except (ValueError, KeyError, TypeError, ArithmeticError, RecursionError) as error:
        raise ValueError(f"cameras.json of this asset is damaged ({error!r})") from error


def _view(frame: dict[str, Any]) -> ViewOfCapture:
    width, height = int(frame["w"]), int(frame["h"])
    fx, fy, cx, cy = (float(frame[key]) for key in ("fl_x", "fl_y", "cx", "cy"))
    rows = [[float(value) for value in row] for row in frame["transform_matrix"]]
    if [len(row) for row in rows] != [4, 4, 4, 4]:
        raise ValueError("a transform_matrix is no 4 x 4 matrix")
    # Rows of the picture count downwards.
    edges = (-cx / fx, (width - cx) / fx, (cy - height) / fy, cy / fy)
    if not all(map(math.isfinite, (*edges, *(value for row in rows for value in row)))):
        raise ValueError("a camera holds numbers that are not finite")
    return ViewOfCapture(str(frame["file_path"]), width, height, rows, *edges)


def has_photographs(folder: Path) -> bool:
    return (folder / PHOTOGRAPHS).is_file()
