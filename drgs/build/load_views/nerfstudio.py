"""nerfstudio: transforms.json with intrinsics for all frames or in each, optional mask_path and ply_file_path.

Poses and the point file share one world; applied_transform, which led there from COLMAP's, is not undone.
"""

from pathlib import Path

import numpy as np
import trimesh

from drgs.build.load_views.capture import Capture, Photograph
from drgs.build.load_views.checks import find_image, find_masks, image_size
from drgs.build.load_views.colmap import undistort_command
from drgs.build.load_views.transforms_json import (
    frame_camera_from_world,
    frame_names,
    frame_pinhole,
    read_transforms,
    refuse_distortion,
)


def read_nerfstudio(folder: Path) -> Capture:
    """Poses, picture files, masks and points of a folder with transforms.json."""
    path = folder / "transforms.json"
    document = read_transforms(path)
    frames = document["frames"]
    undistort = undistort_command(folder / "images", folder / "colmap" / "sparse" / "0", folder)
    images = [find_image(folder, frame["file_path"], path) for frame in frames]
    masks_of_folder = find_masks(images, folder / "images", folder / "masks")
    photographs = []
    for frame, name, image, mask in zip(frames, frame_names(frames), images, masks_of_folder, strict=True):
        where = f"{path}: frame {frame['file_path']}"
        refuse_distortion(document, frame, where, undistort)
        camera_from_world = frame_camera_from_world(frame, where)
        pinhole = frame_pinhole(document, frame, where, lambda image=image: image_size(image))
        mask_path = frame.get("mask_path")
        own_mask = find_image(folder, mask_path, path) if isinstance(mask_path, str) else mask
        photographs.append(Photograph(name, image, own_mask, False, camera_from_world, pinhole))
    points_world, point_colors_srgb = _read_points(folder, document.get("ply_file_path"), path)
    return Capture("nerfstudio", tuple(photographs), points_world, point_colors_srgb)


def _read_points(folder: Path, ply_file_path: object, named_in: Path) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Points (n, 3) and colours (n, 3) 0..1 of the sparse point file, grey where it has none."""
    if not isinstance(ply_file_path, str):
        return None, None
    path = folder / ply_file_path
    if Path(ply_file_path).is_absolute() or ".." in Path(ply_file_path).parts:
        raise ValueError(f"{named_in}: ply_file_path {ply_file_path!r} leads outside the capture folder.")
    if not path.is_file():
        raise ValueError(f"{path}: no such point file, but {named_in.name} names it as ply_file_path.")
    try:
        cloud = trimesh.load(path, file_type="ply", process=False)
        points = np.asarray(cloud.vertices, dtype=np.float32)
    except (ValueError, KeyError, IndexError, AttributeError) as error:
        raise ValueError(f"{path}: not a readable PLY point file ({error}).") from error
    colors = getattr(cloud, "colors", None)
    if colors is None or len(colors) != len(points):
        return points, np.full_like(points, 0.5)
    return points, np.asarray(colors, dtype=np.float32)[:, :3] / 255
