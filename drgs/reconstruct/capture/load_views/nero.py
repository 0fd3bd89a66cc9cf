"""NeRO GlossySynthetic: K.png, K-depth.png (16 bit, the mask) and K-camera.pkl = [world-to-camera 3x4 (OpenCV), K 3x3].

The pickles are opened by a process of its own (unpickle_cameras.py). eval_pts.ply is ground truth and never read.
Split as in the published comparisons: every eighth view is for testing.
"""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np

from drgs.reconstruct.capture.load_views.capture import Capture, Photograph, Pinhole
from drgs.reconstruct.capture.load_views.checks import find_image, image_size, rigid_camera_from_world

TEST_EVERY = 8
TIMEOUT = 120.0
"""[s] for reading all cameras."""


def read_nero(folder: Path, split: str) -> Capture:
    """Poses, picture files and masks of one split.

    Args:
        split: train or test.
    """
    photographs = []
    cameras = _read_cameras(folder)
    for index, key in enumerate(sorted(cameras, key=lambda key: (not key.isdigit(), int(key) if key.isdigit() else 0, key))):
        number = int(key) if key.isdigit() else index
        if (number % TEST_EVERY == 0) != (split == "test"):
            continue
        pickle_path = folder / f"{key}-camera.pkl"
        pose, intrinsics = (np.array(table, dtype=np.float64) for table in cameras[key])
        if pose.shape != (3, 4) or intrinsics.shape != (3, 3):
            raise ValueError(f"{pickle_path}: tables of shape {pose.shape} and {intrinsics.shape}, expected a 3x4 pose and a 3x3 K.")
        if not np.isfinite(intrinsics).all() or abs(intrinsics[0, 1]) > 1e-6 * abs(intrinsics[0, 0]):
            raise ValueError(f"{pickle_path}: K = {intrinsics.tolist()}, expected finite numbers and no skew.")
        image = find_image(folder, key, pickle_path)
        camera_from_world = rigid_camera_from_world(np.vstack([pose, [0, 0, 0, 1]]), str(pickle_path))
        pinhole = Pinhole(intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2], *image_size(image))
        depth = folder / f"{key}-depth.png"
        photographs.append(Photograph(key, image, depth if depth.is_file() else None, True, camera_from_world, pinhole))
    return Capture("nero", tuple(photographs), None, None)


def _read_cameras(folder: Path) -> dict[str, list[list[list[float]]]]:
    program = Path(__file__).with_name("unpickle_cameras.py")
    try:
        done = subprocess.run(
            [sys.executable, "-I", str(program), str(folder)], capture_output=True, text=True, timeout=TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise ValueError(f"{folder}: reading its *-camera.pkl took more than {TIMEOUT:.0f} s.") from error
    if done.returncode != 0:
        raise ValueError(done.stderr.strip().splitlines()[-1] if done.stderr.strip() else f"{folder}: its *-camera.pkl cannot be read.")
    return json.loads(done.stdout)
