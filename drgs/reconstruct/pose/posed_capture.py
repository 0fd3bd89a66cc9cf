"""What was found, and its way onto disc: a capture of the nerfstudio layout, with poses.json beside it for who wants to know how.

    transforms.json   OpenGL camera-to-world, z up, pinhole
    images/ masks/    undistorted
    sparse.ply        points with colours
    poses.json        PosedCapture

transforms.json, which makes a folder a capture, goes away first and comes last, so that nothing half written is taken for a capture.
"""

import json
import os
import shutil
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64, UInt8
from numpy import ndarray

from drgs.exchange.ply import encode_ply

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
PARTS = ("images", "masks", "sparse.ply", "poses.json", "transforms.json")
"""In the order in which they are put in place."""


@dataclass(frozen=True)
class PosedCapture:
    """The poses that were found, as poses.json has them."""

    folder: str
    photographs: str
    """Folder of the pictures they were found for."""
    identity: str
    """Digest of those pictures and the settings."""
    given: int
    """Pictures in that folder."""
    placed: tuple[str, ...]
    """Names of those with a pose."""
    left_out: dict[str, str]
    """Name: why it has none."""
    blurred: tuple[str, ...]
    """Names of pictures much less sharp than the others, placed or not."""
    masked: bool
    masks_from: str
    """files (alpha or masks/), backdrop (a plain one, backdrop_masks.py) or none."""
    reprojection_error: float
    """Mean [pixels of the original pictures]."""
    points: int
    up_from: str
    """What told which way is up (upright_world.py)."""
    cameras: dict[str, dict[str, Any]]
    """Calibration of the original pictures: COLMAP's model, size, parameters and their names."""
    camera_of: dict[str, str]
    """Of each placed picture."""
    models: dict[str, int]
    """Pictures in each of the models that COLMAP made."""
    model: str
    """The one that was taken."""
    matching: str
    seed: int
    seconds: dict[str, float]
    """Of each step."""


@dataclass(frozen=True, eq=False)
class PosedPictures:
    """What transforms.json and sparse.ply are written from."""

    files: tuple[str, ...]
    world_from_camera: Float64[ndarray, "camera 4 4"]
    """OpenCV axes."""
    pinholes: tuple[dict[str, Any], ...]
    """Of the undistorted pictures: width, height and parameters fx, fy, cx, cy."""
    masked: bool
    points_world: Float64[ndarray, "point 3"]
    point_colors_srgb: UInt8[ndarray, "point 3"]


def write_posed_capture(pictures: PosedPictures, undistorted: Path, found: PosedCapture, out: Path) -> None:
    """Put a capture in place of what an earlier run wrote to `out`; `undistorted`, on the same file system, is used up.

    Args:
        undistorted: has images/ with `pictures.files`, and masks/.
    """
    frames = [
        _frame(file, pose, pinhole, pictures.masked)
        for file, pose, pinhole in zip(pictures.files, pictures.world_from_camera, pictures.pinholes, strict=True)
    ]
    transforms = {"camera_model": "OPENCV", "ply_file_path": "sparse.ply", "frames": frames}
    if not pictures.masked:
        shutil.rmtree(undistorted / "masks", ignore_errors=True)
    points, colors = pictures.points_world.astype(np.float32), pictures.point_colors_srgb
    columns = {name: points[:, k] for k, name in enumerate("xyz")} | {name: colors[:, k] for k, name in enumerate(("red", "green", "blue"))}
    (undistorted / "sparse.ply").write_bytes(encode_ply({"vertex": columns}))
    (undistorted / "poses.json").write_text(json.dumps(asdict(found), indent=1), encoding="utf-8")
    (undistorted / "transforms.json").write_text(json.dumps(transforms, indent=1), encoding="utf-8")
    forget_posed_capture(out)
    for part in PARTS:
        if (undistorted / part).exists():
            os.replace(undistorted / part, out / part)


def summary_lines(found: PosedCapture) -> list[str]:
    """What a user wants to know, a line each."""
    lines = [
        f"{len(found.placed)} of {found.given} pictures placed, {found.reprojection_error:.2f} pixels off, {found.points} points, "
        f"{sum(found.seconds.values()):.0f} seconds",
        *(["masked by their plain backdrop: look at masks/"] if found.masks_from == "backdrop" else []),
        *(f"left out {name}: {reason}" for name, reason in found.left_out.items()),
    ]
    if soft := [name for name in found.blurred if name in found.placed]:
        lines.append(f"blurred: {', '.join(soft)}")
    return [*lines, f"Capture written to {found.folder}. Next: drgs doctor {found.folder}"]


def forget_posed_capture(out: Path) -> None:
    """Remove what write_posed_capture wrote."""
    for part in reversed(PARTS):
        if (out / part).is_dir():
            shutil.rmtree(out / part)
        else:
            (out / part).unlink(missing_ok=True)


def read_posed_capture(out: Path) -> PosedCapture | None:
    """What an earlier run wrote; None where none has finished.

    Raises:
        ValueError: poses.json is not ours.
    """
    path = out / "poses.json"
    if not path.is_file() or not (out / "transforms.json").is_file():
        return None
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        return PosedCapture(**document | {name: tuple(document[name]) for name in ("placed", "blurred")})
    except (ValueError, TypeError, KeyError) as error:
        raise ValueError(f"{path}: not written by this version ({error}); give another folder, or remove this one.") from error


def _frame(file: str, world_from_camera: Float64[ndarray, "4 4"], pinhole: dict[str, Any], masked: bool) -> dict[str, Any]:
    fx, fy, cx, cy = pinhole["parameters"]
    frame: dict[str, Any] = {"file_path": f"images/{file}"}
    if masked:
        frame["mask_path"] = f"masks/{Path(file).stem}.png"
    frame |= {"w": pinhole["width"], "h": pinhole["height"], "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}
    return frame | {"transform_matrix": (world_from_camera @ OPENCV_FROM_OPENGL).tolist()}
