"""Photographs without test views become a scene with some: every eighth is held out of the build and scored.

In: a folder in nerfstudio's layout with one transforms*.json and masks. Out: a folder that a build reads (transforms.json without the frames
held out; pictures are linked, not copied) and that `drgs eval` scores (transforms_test.json, test/ with the object cut out, scene.json).
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from drgs.reconstruct.capture.load_views import read_capture
from drgs.reconstruct.capture.load_views.read_pictures import read_pictures
from drgs.scene.camera import opengl_from_camera
from drgs.scene.views import Views

EVERY = 8
"""One photograph in so many is held out, from the first on (the literature's rule)."""


def scene_folder(given: Path, split: Path, side: int) -> Path:
    """A scene with test views: the given one, or `split`, made of a capture without any."""
    return given if (given / "transforms_test.json").is_file() else split_capture(given, split, side)


def split_capture(source: Path, out: Path, side: int) -> Path:
    """The scene folder in `out`; made anew unless it is there already, of this source and side.

    Args:
        side: the photographs held out are shrunk to at most this [pixels].

    Raises:
        ValueError: the folder has not exactly one transforms*.json, or no masks.
    """
    found = sorted(source.glob("transforms*.json"))
    if len(found) != 1:
        raise ValueError(f"{source}: has {len(found)} transforms*.json; expected test views beside it, or exactly one to split")
    facts: dict = {
        "name": source.name,
        "train_env": None,
        "relight": [],
        "deform": {},
        "held_out": EVERY,
        "side": side,
        "source": str(found[0]),
    }
    facts_path = out / "scene.json"
    if facts_path.is_file() and json.loads(facts_path.read_text()) == facts:
        return out
    if out.exists():
        shutil.rmtree(out)
    (out / "test").mkdir(parents=True)
    for entry in source.iterdir():
        if entry.name not in (found[0].name, "test", "scene.json"):
            (out / entry.name).symlink_to(entry.resolve())
    document = json.loads(found[0].read_text())
    (out / "transforms.json").write_text(json.dumps(document))
    capture = read_capture(out)
    held = capture.photographs[::EVERY]
    views = read_pictures(replace(capture, photographs=held), side)
    if not views.has_masks:
        raise ValueError(f"{source}: has no masks; without them nothing tells the object from its surroundings in the pictures held out")
    write_test_views(views, out)
    kept = [frame for index, frame in enumerate(document["frames"]) if index % EVERY]
    (out / "transforms.json").write_text(json.dumps(document | {"frames": kept}))
    facts_path.write_text(json.dumps(facts))  # last: it says that the rest is complete
    return out


def write_test_views(views: Views, folder: Path) -> None:
    """test/<name>.png, the object cut out, and transforms_test.json."""
    frames = []
    for camera, image, coverage in zip(views.cameras, views.images_srgb, views.coverage, strict=True):
        rgba = torch.cat([image, coverage[..., None]], -1).numpy()
        Image.fromarray(np.ascontiguousarray(rgba)).save(folder / "test" / f"{camera.name}.png")
        k = camera.intrinsics
        frames.append({
            "file_path": f"./test/{camera.name}", "transform_matrix": opengl_from_camera(camera).tolist(),
            "fl_x": float(k[0, 0]), "fl_y": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2]), "w": camera.width, "h": camera.height,
        })  # fmt: skip
    (folder / "transforms_test.json").write_text(json.dumps({"frames": frames}))
