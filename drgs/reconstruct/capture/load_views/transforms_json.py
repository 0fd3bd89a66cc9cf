"""The camera file NeRF-synthetic and nerfstudio share: `frames`, each with a file_path and an OpenGL camera-to-world matrix.

Intrinsics stand once for all frames or in each frame, as fl_x, fl_y, cx, cy, w, h or as camera_angle_x.
Source: service reference, input conventions; the nerfstudio data conventions page.
"""

import json
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from drgs.reconstruct.capture.load_views.capture import Pinhole, pinhole_from_angle
from drgs.reconstruct.capture.load_views.checks import (
    IMAGE_SUFFIXES,
    MOST_SHOWN,
    check_angle,
    check_file_name,
    check_pinhole,
    find_image,
    find_masks,
    finite_number,
    rigid_camera_from_world,
    shown,
)

DISTORTION_KEYS = ("k1", "k2", "k3", "k4", "p1", "p2")
PINHOLE_MODELS = ("PINHOLE", "SIMPLE_PINHOLE", "OPENCV", "PERSPECTIVE")
"""nerfstudio's camera_model values that are a pinhole once the distortion is zero."""
MOST_SIDE = 65536
"""Of a picture [pixels]."""
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def read_transforms(path: Path) -> dict[str, Any]:
    """The document, with `frames` known to be a non-empty list of objects."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error.strerror}).") from error
    except ValueError as error:  # also what is no UTF-8, and numbers of more digits than Python reads
        raise ValueError(f"{path}: not valid JSON ({error}).") from error
    except RecursionError as error:
        raise ValueError(f"{path}: not valid JSON (brackets within brackets without end).") from error
    frames = document.get("frames") if isinstance(document, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise ValueError(f'{path}: expected an object with a non-empty list "frames".')
    for index, frame in enumerate(frames):
        if not isinstance(frame.get("file_path"), str):
            raise ValueError(f'{path}: frame {index} has no "file_path".')
        check_file_name(frame["file_path"], f"{path}: frame {index}: file_path")
    return document


def frame_name(file_path: str) -> str:
    """Stem of a file_path, which may come without extension: './train/r_0.5' is 'r_0.5'."""
    name = Path(file_path.replace("\\", "/")).name
    return name[: -len(Path(name).suffix)] if Path(name).suffix in IMAGE_SUFFIXES else name


def frame_names(frames: list[dict[str, Any]]) -> list[str]:
    """One name a frame; where stems repeat (left/000, right/000) the folders are joined in front."""
    names = [frame_name(frame["file_path"]) for frame in frames]
    repeated = {name for name, count in Counter(names).items() if count > 1}
    unique = []
    for name, frame in zip(names, frames, strict=True):
        folders = [part for part in Path(frame["file_path"].replace("\\", "/")).parts[:-1] if part not in (".", "..", "/")]
        unique.append("_".join([*folders, name]) if name in repeated else name)
    return unique


def frame_camera_from_world(frame: dict[str, Any], where: str) -> Float[ndarray, "4 4"]:
    """(4, 4) OpenCV pose of a frame."""
    try:
        matrix = np.array(frame["transform_matrix"], dtype=np.float64)
    except KeyError as error:
        raise ValueError(f'{where}: no "transform_matrix".') from error
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{where}: transform_matrix is not a table of numbers ({error}).") from error
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"{where}: transform_matrix has shape {matrix.shape}, expected 4x4 (or 3x4).")
    world_from_opengl = np.eye(4)
    world_from_opengl[: matrix.shape[0]] = matrix
    if matrix.shape[0] == 4 and np.isfinite(matrix).all() and not np.allclose(matrix[3], [0, 0, 0, 1], atol=1e-6):
        raise ValueError(f"{where}: last row of transform_matrix is {matrix[3].tolist()}, expected [0, 0, 0, 1].")
    # Checked before the inverse, so that the sentence speaks of the numbers in the file.
    rigid = rigid_camera_from_world(world_from_opengl, where)
    return np.linalg.inv(rigid @ OPENCV_FROM_OPENGL)


def frame_masks(folder: Path, images: list[Path], images_root: Path, frames: list[dict[str, Any]], path: Path) -> list[Path | None]:
    """The mask of each frame: its own mask_path, else that of the folder masks/ (see find_masks).

    Args:
        path: of the camera file, which the sentences name.
    """
    own = [frame.get("mask_path") for frame in frames]
    wrong = next((name for name in own if name is not None and not isinstance(name, str)), None)
    if wrong is not None:
        raise ValueError(f"{path}: mask_path = {shown(wrong)}, expected a file name.")
    others = iter(find_masks([image for image, name in zip(images, own, strict=True) if name is None], images_root, folder / "masks"))
    return [next(others) if name is None else find_image(folder, name, path) for name in own]


def refuse_distortion(document: dict[str, Any], frame: dict[str, Any], where: str, undistort: str) -> None:
    """Only pinhole pictures are accepted; `undistort` is the command that makes them."""
    model = frame.get("camera_model", document.get("camera_model", "PINHOLE"))
    if model not in PINHOLE_MODELS:
        raise ValueError(f"{where}: camera_model {str(model)[:MOST_SHOWN]} is not a pinhole; undistort first: {undistort}")
    for key in DISTORTION_KEYS:
        value = frame.get(key, document.get(key, 0.0))
        if not isinstance(value, int | float) or not abs(value) < 1e-12:
            raise ValueError(f"{where}: lens distortion {key} = {shown(value)}, expected 0; undistort first: {undistort}")


def declared_size(document: dict[str, Any], frame: dict[str, Any], where: str) -> tuple[int, int] | None:
    """(w, h) as the file states it, or None."""
    width, height = frame.get("w", document.get("w")), frame.get("h", document.get("h"))
    if width is None and height is None:
        return None

    def whole(key: str, value: object) -> int:
        number = finite_number(value, f"{where}: {key}")
        if not number.is_integer() or not 1 <= number <= MOST_SIDE:
            raise ValueError(f"{where}: {key} = {shown(value)}, expected a whole number of pixels.")
        return int(number)

    return whole("w", width), whole("h", height)


def frame_pinhole(document: dict[str, Any], frame: dict[str, Any], where: str, picture_size: Callable[[], tuple[int, int]]) -> Pinhole:
    """Intrinsics of a frame; the frame's own values win over the document's.

    Args:
        picture_size: called when the file states no size.
    """
    width, height = declared_size(document, frame, where) or picture_size()

    def number(key: str) -> float | None:
        value = frame.get(key, document.get(key))
        return None if value is None else finite_number(value, f"{where}: {key}")

    focal_x, focal_y = number("fl_x"), number("fl_y")
    if focal_x is not None:
        center_x, center_y = number("cx"), number("cy")
        pinhole = Pinhole(
            focal_x,
            focal_x if focal_y is None else focal_y,
            width / 2 if center_x is None else center_x,
            height / 2 if center_y is None else center_y,
            width,
            height,
        )
    elif frame.get("camera_angle_x", document.get("camera_angle_x")) is not None:
        angle_x = check_angle("camera_angle_x", frame.get("camera_angle_x", document.get("camera_angle_x")), where)
        angle_y = frame.get("camera_angle_y", document.get("camera_angle_y"))
        pinhole = pinhole_from_angle(angle_x, None if angle_y is None else check_angle("camera_angle_y", angle_y, where), width, height)
    else:
        raise ValueError(f'{where}: no intrinsics, expected "camera_angle_x" or "fl_x".')
    check_pinhole(pinhole, where)
    return pinhole
