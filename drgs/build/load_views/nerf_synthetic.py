"""NeRF-synthetic: transforms_train.json with camera_angle_x (or fl_x ...), file_path without extension, RGBA pictures.

Reads only transforms_train.json (transforms_test.json for the test split) and the pictures it names: test views, meshes and
environments that lie beside it are never looked at.
"""

from pathlib import Path

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


def read_nerf_synthetic(folder: Path, split: str) -> Capture:
    """Poses and picture files of one split.

    Args:
        split: train or test.
    """
    path = folder / f"transforms_{split}.json"
    document = read_transforms(path)
    frames = document["frames"]
    images = [find_image(folder, frame["file_path"], path) for frame in frames]
    masks = find_masks(images, folder, folder / "masks")
    photographs = []
    for frame, name, image, mask in zip(frames, frame_names(frames), images, masks, strict=True):
        where = f"{path}: frame {frame['file_path']}"
        refuse_distortion(document, frame, where, undistort_command(folder / "images", folder / "sparse" / "0", folder))
        camera_from_world = frame_camera_from_world(frame, where)
        pinhole = frame_pinhole(document, frame, where, lambda image=image: image_size(image))
        photographs.append(Photograph(name, image, mask, False, camera_from_world, pinhole))
    return Capture("nerf-synthetic", tuple(photographs), None, None)
