"""The camera file NeRF-synthetic and nerfstudio share: `frames`, each with a file_path and an OpenGL camera-to-world matrix.

Intrinsics stand once for all frames or in each frame, as fl_x, fl_y, cx, cy, w, h or as camera_angle_x; what bends straight lines as
camera_model (or instant-ngp's is_fisheye) with k1, k2, k3, k4, p1, p2.
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
    NO_PANORAMA,
    check_angle,
    check_file_name,
    check_pinhole,
    find_image,
    find_masks,
    finite_number,
    rigid_camera_from_world,
    shown,
)
from drgs.reconstruct.capture.load_views.undistort import optics_of
from drgs.scene.lens import PARAMETER_NAMES, Lens

DISTORTION_KEYS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""In OpenCV's order, which is that of COLMAP's FULL_OPENCV."""
LENS_MODELS = {
    **dict.fromkeys(("PINHOLE", "SIMPLE_PINHOLE", "PERSPECTIVE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), "OPENCV"),
    "FULL_OPENCV": "FULL_OPENCV",
    **dict.fromkeys(("OPENCV_FISHEYE", "FISHEYE"), "OPENCV_FISHEYE"),
}
"""What camera_model says, and the lens that is meant."""
USED_KEYS = {"OPENCV": ("k1", "k2", "p1", "p2", "k3"), "FULL_OPENCV": DISTORTION_KEYS, "OPENCV_FISHEYE": ("k1", "k2", "k3", "k4")}
"""By lens. With OPENCV k4 is refused: nerfstudio takes it as the factor of r^8, OpenCV as one of the divisor, and no file says which."""
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


def frame_optics(
    document: dict[str, Any], frame: dict[str, Any], where: str, picture_size: Callable[[], tuple[int, int]]
) -> tuple[Pinhole, Lens | None]:
    """Intrinsics of a frame's picture once it is undistorted, and the lens where it has to be; the frame's values win over the document's.

    Args:
        picture_size: called when the file states no size.
    """
    values = document | frame
    pinhole = _pinhole(values, where, declared_size(document, frame, where) or picture_size())
    return optics_of(_lens(values, pinhole, where), where)


def _pinhole(values: dict[str, Any], where: str, size: tuple[int, int]) -> Pinhole:
    """What the file says of the focal lengths and the principal point."""
    width, height = size

    def number(key: str) -> float | None:
        value = values.get(key)
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
    elif values.get("camera_angle_x") is not None:
        angle_x, angle_y = check_angle("camera_angle_x", values["camera_angle_x"], where), values.get("camera_angle_y")
        pinhole = pinhole_from_angle(angle_x, None if angle_y is None else check_angle("camera_angle_y", angle_y, where), width, height)
    else:
        raise ValueError(f'{where}: no intrinsics, expected "camera_angle_x" or "fl_x".')
    check_pinhole(pinhole, where)
    return pinhole


def _lens(values: dict[str, Any], pinhole: Pinhole, where: str) -> Lens:
    """The lens that the file describes, with these intrinsics."""
    named = values.get("camera_model", "OPENCV_FISHEYE" if values.get("is_fisheye") is True else "OPENCV")
    if named == "EQUIRECTANGULAR":
        raise ValueError(f"{where}: camera_model {named}, expected that of a lens; {NO_PANORAMA}.")
    model = LENS_MODELS.get(named.upper()) if isinstance(named, str) else None
    if model is None:
        raise ValueError(f"{where}: camera_model {shown(named)}, expected one of {', '.join(LENS_MODELS)}.")
    numbers = {key: finite_number(values.get(key, 0.0), f"{where}: lens distortion {key}") for key in DISTORTION_KEYS}
    unused = next((key for key, number in numbers.items() if number and key not in USED_KEYS[model]), None)
    if unused is not None:
        raise ValueError(f"{where}: lens distortion {unused} = {numbers[unused]:g}, expected 0 with camera_model {named}.")
    if model == "OPENCV" and numbers["k3"]:
        model = "FULL_OPENCV"
    coefficients = tuple(numbers[key] for key in PARAMETER_NAMES[model][4:])
    return Lens(model, (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy, *coefficients), pinhole.width, pinhole.height)
