"""NeRF-synthetic: transforms_train.json with camera_angle_x (or fl_x ...), file_path without extension, RGBA pictures.

Reads only transforms_train.json (transforms_test.json for the test split) and the pictures it names: test views, meshes and
environments that lie beside it are never looked at.
"""

from functools import partial
from pathlib import Path

from drgs.reconstruct.capture.load_views.capture import Capture, Photograph
from drgs.reconstruct.capture.load_views.checks import find_image, find_masks, image_size
from drgs.reconstruct.capture.load_views.transforms_json import (
    frame_camera_from_world,
    frame_masks,
    frame_names,
    frame_optics,
    read_transforms,
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
    if split == "train":
        masks = frame_masks(folder, images, folder, frames, path)
    else:  # test views often have the plain names of the training views, whose masks are none for them
        masks = find_masks(images, folder / split, folder / "masks" / split)
    photographs = []
    for frame, name, image, mask in zip(frames, frame_names(frames), images, masks, strict=True):
        where = f"{path}: frame {frame['file_path']}"
        camera_from_world = frame_camera_from_world(frame, where)
        pinhole, lens = frame_optics(document, frame, where, partial(image_size, image))
        photographs.append(Photograph(name, image, mask, False, camera_from_world, pinhole, lens))
    return Capture("nerf-synthetic", tuple(photographs), None, None)
