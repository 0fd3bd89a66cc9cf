"""Photographs of an egg on the ground, both with noise on them, by a small ray caster: what poses can be found from and compared with."""

from pathlib import Path

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates

SIZE = 300
"""Of pictures [pixels]: most of the time that poses take goes with their number. Before a plain backdrop fewer than 240 are too few."""
PLAIN_SIZE = 240
"""Enough where the ground is in the picture."""
FOCAL = 1.2 * SIZE
DISTORTION = -0.06
"""COLMAP's k of SIMPLE_RADIAL."""
RADII = np.array([1.2, 1.0, 1.3])
"""Of the egg; it stands on the plane z = -RADII[2]."""
CELLS = (0.5, 0.22, 0.1, 0.05)
"""Of the noise, summed up [world units]."""
GRIDS = np.random.default_rng(7).random((len(CELLS), 32, 32, 32))


def orbit(count: int, height: float = 1.6, distance: float = 4.5) -> np.ndarray:
    """(count, 4, 4) world-from-camera with OpenCV axes, around the z axis."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for pose, angle in zip(poses, np.arange(count) * 2 * np.pi / count, strict=True):
        position = np.array([distance * np.cos(angle), distance * np.sin(angle), height])
        forward = -position / np.linalg.norm(position)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        pose[:3, :3] = np.stack([right, np.cross(forward, right), forward], 1)
        pose[:3, 3] = position
    return poses


def picture(
    world_from_camera: np.ndarray, focal: float = FOCAL, distortion: float = 0.0, size: int = SIZE, egg_alone: bool = False
) -> tuple[np.ndarray, np.ndarray]:
    """8-bit colour (size, size, 3), and whether the pixel shows the egg. With `egg_alone` all else is white."""
    columns, rows = np.meshgrid(np.arange(size) + 0.5, np.arange(size) + 0.5)
    seen = np.stack([(columns - size / 2) / focal, (rows - size / 2) / focal], -1)
    straight = seen.copy()
    for _ in range(6):
        straight = seen / (1 + distortion * (straight**2).sum(-1, keepdims=True))
    directions = np.concatenate([straight, np.ones((size, size, 1))], -1) @ world_from_camera[:3, :3].T
    origin = world_from_camera[:3, 3]
    # |(origin + t direction) / radii| = 1
    scaled, start = directions / RADII, origin / RADII
    a, b, c = (scaled**2).sum(-1), (scaled * start).sum(-1), (start**2).sum() - 1
    on_egg = b * b > a * c
    enter = (-b - np.sqrt(np.maximum(b * b - a * c, 0))) / a
    with np.errstate(divide="ignore"):
        ground = (-RADII[2] - origin[2]) / directions[..., 2]
    ground = np.where((ground > 0) & (ground < 60), ground, 60)
    depth = np.where(on_egg, enter, ground)
    textured = on_egg if egg_alone else depth < 12
    color = np.full((size, size, 3), 1.0 if egg_alone else 0.8)
    # There only: nearly all of a picture's time is noise.
    color[textured] = 0.2 + 0.6 * noise(origin + depth[textured, None] * directions[textured]) * np.array([1.0, 0.9, 0.8])
    return (255 * np.clip(color, 0, 1)).astype(np.uint8), on_egg


def noise(points: np.ndarray) -> np.ndarray:
    """(..., 1) 0..1 of points (..., 3), the same from wherever they are seen."""
    total = np.zeros(points.shape[:-1])
    for cell, grid in zip(CELLS, GRIDS, strict=True):
        total += map_coordinates(grid, np.moveaxis(points / cell + 0.37, -1, 0), order=1, mode="grid-wrap")
    return np.clip((total / len(CELLS) - 0.5) * 2.5 + 0.5, 0, 1)[..., None]


def write_photographs(folder: Path, poses: np.ndarray, masks: bool = False, size: int = SIZE) -> Path:
    """Distorted pictures 00.png, 01.png, ... of the same angle, however large (with masks/, everything but the egg is white)."""
    folder.mkdir(parents=True)
    if masks:
        (folder / "masks").mkdir()
    for number, pose in enumerate(poses):
        color, on_egg = picture(pose, FOCAL / SIZE * size, DISTORTION, size, egg_alone=masks)
        if masks:
            Image.fromarray((255 * on_egg).astype(np.uint8)).save(folder / "masks" / f"{number:02d}.png")
        Image.fromarray(color).save(folder / f"{number:02d}.png")
    return folder
