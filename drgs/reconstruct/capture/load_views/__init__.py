"""Read posed photographs of an object, in the six layouts people have them in, into Views.

    NeRF-synthetic   transforms_train.json, RGBA pictures
    nerfstudio       transforms.json
    COLMAP           sparse/0 or sparse (bin or txt), images/
    Metashape        *.xml of its cameras, images/ or pictures beside it
    RealityCapture   *.csv of its cameras ("Internal/External camera parameters"), images/ or pictures beside it
    NeRO             K.png, K-depth.png, K-camera.pkl

Masks come from alpha, from `mask_path` or from a masks/ folder; black is background. Pictures through a lens that bends straight lines are
undistorted, so that cameras are always pinholes. Whatever makes a capture unusable raises ValueError with one sentence. Nothing here looks at test views, true meshes or environments that may lie beside a capture.
"""

from pathlib import Path
from typing import Literal

from drgs.reconstruct.capture.load_views.capture import Capture, Pinhole, camera_of, without_masks
from drgs.reconstruct.capture.load_views.checks import check_photographs, image_size, is_file, is_folder, refuse_asset
from drgs.reconstruct.capture.load_views.colmap import find_model, read_colmap
from drgs.reconstruct.capture.load_views.metashape import find_cameras_file, read_metashape
from drgs.reconstruct.capture.load_views.nerf_synthetic import read_nerf_synthetic
from drgs.reconstruct.capture.load_views.nerfstudio import read_nerfstudio
from drgs.reconstruct.capture.load_views.nero import read_nero
from drgs.reconstruct.capture.load_views.read_pictures import read_pictures
from drgs.reconstruct.capture.load_views.realitycapture import find_cameras_table, read_realitycapture
from drgs.reconstruct.capture.load_views.transforms_json import (
    frame_camera_from_world,
    frame_names,
    frame_optics,
    read_transforms,
)
from drgs.scene.camera import Camera
from drgs.scene.views import Views

__all__ = ["find_cameras", "has_cameras", "load_cameras", "load_unmasked_views", "load_views", "read_capture"]

FALLBACK_SIZE = (400, 400)
"""Picture size when a camera file neither states one nor comes with its images."""


def load_views(folder: Path, max_side: int | None = None, split: Literal["train", "test"] = "train") -> Views:
    """Photographs, masks and cameras of a capture folder.

    Args:
        max_side: shrink pictures whose longer side exceeds this [pixels]; intrinsics follow exactly.
        split: NeRF-synthetic and NeRO captures hold test views back; other layouts have train views only.

    Raises:
        ValueError: one sentence that names the file, what was found and what was expected.
    """
    return read_pictures(read_capture(Path(folder), split), max_side)


def load_unmasked_views(folder: Path, max_side: int | None = None) -> Views:
    """The same, whatever mask files there are: pictures keep their colours outside of them, which shrinking loses otherwise."""
    return read_pictures(without_masks(read_capture(Path(folder))), max_side)


def read_capture(folder: Path, split: Literal["train", "test"] = "train") -> Capture:
    """Cameras and picture files of a capture folder, checked, before any pixel is decoded."""
    if not is_folder(folder):
        raise ValueError(f"{folder}: no such folder, expected a capture.")
    if (folder / f"transforms_{split}.json").is_file():
        capture = read_nerf_synthetic(folder, split)
    elif any(folder.glob("*-camera.pkl")):
        capture = read_nero(folder, split)
    elif split == "test":
        raise ValueError(f"{folder}: no test views, expected transforms_test.json or a NeRO folder.")
    elif (folder / "transforms.json").is_file():
        capture = read_nerfstudio(folder)
    elif find_model(folder) is not None:
        capture = read_colmap(folder)
    elif find_cameras_file(folder) is not None:
        capture = read_metashape(folder)
    elif find_cameras_table(folder) is not None:
        capture = read_realitycapture(folder)
    else:
        refuse_asset(folder)
        raise ValueError(
            f"{folder}: not a capture, expected transforms_train.json (NeRF-synthetic), transforms.json (nerfstudio), "
            "sparse/0/cameras.bin or .txt (COLMAP), *.xml (Metashape), *.csv (RealityCapture) or *-camera.pkl (NeRO)."
        )
    check_photographs(capture.photographs, folder)
    return capture


def find_cameras(folder: Path) -> Path | None:
    """The file, or COLMAP's folder, by which one of the layouts is recognised: read_capture then reads it, or says what is wrong with it."""
    patterns = ("transforms_train.json", "transforms.json", "*-camera.pkl")
    found = next((path for pattern in patterns for path in folder.glob(pattern)), None)
    return found or find_model(folder) or find_cameras_file(folder) or find_cameras_table(folder)


def has_cameras(folder: Path) -> bool:
    """Whether one of the layouts is there."""
    return find_cameras(folder) is not None


def load_cameras(path: Path, size: tuple[int, int] | None = None) -> list[Camera]:
    """Cameras of a transforms json, NeRF-synthetic or nerfstudio; the images it names need not exist.

    Of a lens that bends straight lines it is the camera of the undistorted picture, as a build has it.
    The picture size is the one the file states, else that of the first image where it exists, else 400x400.

    Args:
        size: (width, height) to render at instead; the horizontal field of view and square pixels are kept.

    Raises:
        ValueError: one sentence.
    """
    path = Path(path)
    if path.is_dir():
        raise ValueError(
            f"{path}: is a folder; expected a file of cameras, such as an asset's cameras.json or a capture's transforms_test.json"
        )
    document = read_transforms(path)
    frames = document["frames"]
    first_size = _first_image_size(path.parent, frames[0]["file_path"])
    cameras = []
    for frame, name in zip(frames, frame_names(frames), strict=True):
        where = f"{path}: frame {frame['file_path']}"
        pinhole, _ = frame_optics(document, frame, where, lambda: first_size or size or FALLBACK_SIZE)
        if size is not None:
            pinhole = _reframe(pinhole, *size)
        cameras.append(camera_of(frame_camera_from_world(frame, where), pinhole, name))
    return cameras


def _first_image_size(folder: Path, file_path: str) -> tuple[int, int] | None:
    for candidate in (folder / file_path, folder / f"{file_path}.png", folder / f"{file_path}.jpg"):
        if is_file(candidate):
            return image_size(candidate)
    return None


def _reframe(pinhole: Pinhole, width: int, height: int) -> Pinhole:
    """Another picture size: the width is scaled, the height cut or extended evenly at top and bottom."""
    scale = width / pinhole.width
    border = (height - pinhole.height * scale) / 2
    return Pinhole(pinhole.fx * scale, pinhole.fy * scale, pinhole.cx * scale, pinhole.cy * scale + border, width, height)
