"""nerfstudio: transforms.json with intrinsics for all frames or in each, optional mask_path and ply_file_path.

Poses and the point file share one world; applied_transform, which led there from COLMAP's, is not undone.
"""

from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from drgs.reconstruct.capture.load_views.capture import Capture, Photograph
from drgs.reconstruct.capture.load_views.checks import check_file_name, find_image, image_size, is_file
from drgs.reconstruct.capture.load_views.transforms_json import (
    frame_camera_from_world,
    frame_masks,
    frame_names,
    frame_optics,
    read_transforms,
)


def read_nerfstudio(folder: Path) -> Capture:
    """Poses, picture files, masks and points of a folder with transforms.json."""
    path = folder / "transforms.json"
    document = read_transforms(path)
    frames = document["frames"]
    images = [find_image(folder, frame["file_path"], path) for frame in frames]
    masks = frame_masks(folder, images, folder / "images", frames, path)
    photographs = []
    for frame, name, image, mask in zip(frames, frame_names(frames), images, masks, strict=True):
        where = f"{path}: frame {frame['file_path']}"
        camera_from_world = frame_camera_from_world(frame, where)
        pinhole, lens = frame_optics(document, frame, where, partial(image_size, image))
        photographs.append(Photograph(name, image, mask, False, camera_from_world, pinhole, lens))
    points_world, point_colors_srgb = _read_points(folder, document.get("ply_file_path"), path)
    return Capture("nerfstudio", tuple(photographs), points_world, point_colors_srgb)


def _read_points(
    folder: Path, ply_file_path: object, named_in: Path
) -> tuple[Float[ndarray, "point 3"] | None, Float[ndarray, "point 3"] | None]:
    """Points (n, 3) and colours (n, 3) 0..1 of the sparse point file, grey where it has none."""
    if not isinstance(ply_file_path, str):
        return None, None
    check_file_name(ply_file_path, f"{named_in}: ply_file_path")
    path = folder / ply_file_path
    if Path(ply_file_path).is_absolute() or ".." in Path(ply_file_path).parts:
        raise ValueError(f"{named_in}: ply_file_path {ply_file_path!r} leads outside the capture folder.")
    if not is_file(path):
        raise ValueError(f"{path}: no such point file, but {named_in.name} names it as ply_file_path.")
    import trimesh  # here, since few captures name such a file, and every look at one would load it

    try:
        cloud: Any = trimesh.load(path, file_type="ply", process=False)  # a mesh or a point cloud; what has no vertices is refused
        points = np.asarray(cloud.vertices, dtype=np.float32)
    except (ValueError, KeyError, IndexError, AttributeError) as error:
        raise ValueError(f"{path}: not a readable PLY point file ({error}).") from error
    colors = getattr(cloud, "colors", None)
    if colors is None or len(colors) != len(points):
        return points, np.full_like(points, 0.5)
    return points, np.asarray(colors, dtype=np.float32)[:, :3] / 255
