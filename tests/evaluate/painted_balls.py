"""Captures of painted balls by a small ray caster, made bad in one way each; and the same pictures without cameras."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from tests.reconstruct.tiny_capture import camera_positions, look_at, save_png

VIEWS = 20
SIDE = 48
FOCAL = 68.0


@dataclass(frozen=True)
class Ball:
    center: tuple[float, float, float] = (0.1, -0.15, 0.2)
    radius: float = 0.55


@dataclass(frozen=True)
class Picture:
    name: str
    rgba: np.ndarray
    world_from_camera: np.ndarray
    """OpenCV axes."""


Paint = Callable[[np.ndarray, np.ndarray, int], np.ndarray]
"""Of normals (..., 3), mirrored directions (..., 3) and the picture's number: colours 0..1."""


def checks(normal: np.ndarray, mirrored: np.ndarray, number: int) -> np.ndarray:
    """Paint with texture."""
    cells = np.where(np.sin(7 * normal + 0.5).prod(-1, keepdims=True) > 0, 1.0, 0.5)
    return (0.5 + 0.3 * normal) * cells


def mirror(normal: np.ndarray, mirrored: np.ndarray, number: int) -> np.ndarray:
    """A ball of chrome among lamps that stand far away."""
    return np.repeat(0.5 + 0.4 * np.sin(5 * mirrored + 1).prod(-1, keepdims=True), 3, -1)


def take_picture(position: np.ndarray, balls: Sequence[Ball], paint: Paint, number: int, focal: float = FOCAL) -> Picture:
    """RGBA with a clear edge, of a camera at `position` that looks at the origin."""
    camera_from_world = look_at(position)
    rows, columns = np.mgrid[:SIDE, :SIDE] + 0.5
    rays = np.stack([(columns - SIDE / 2) / focal, (rows - SIDE / 2) / focal, np.ones((SIDE, SIDE))], -1) @ camera_from_world[:3, :3]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    nearest, normal = np.full((SIDE, SIDE), np.inf), np.zeros((SIDE, SIDE, 3))
    for ball in balls:
        offset = position - np.array(ball.center)
        b = rays @ offset
        inside = b * b - (offset @ offset - ball.radius**2)
        distance = np.where(inside > 0, -b - np.sqrt(np.maximum(inside, 0)), np.inf)
        hit = distance < nearest
        nearest[hit] = distance[hit]
        normal[hit] = (offset + distance[hit, None] * rays[hit]) / ball.radius
    mirrored = rays - 2 * (rays * normal).sum(-1, keepdims=True) * normal
    hit = np.isfinite(nearest)[..., None]
    color = np.where(hit, np.clip(paint(normal, mirrored, number), 0, 1), 0)
    rgba = np.concatenate([255 * color, 255 * hit], -1).astype(np.uint8)
    return Picture(f"r_{number:03d}", rgba, np.linalg.inv(camera_from_world))


def pictures(
    positions: np.ndarray | None = None, balls: Callable[[int], Sequence[Ball]] = lambda number: [Ball()], paint: Paint = checks
) -> list[Picture]:
    """From all around; `balls`: what stands before the camera as picture `number` is taken."""
    positions = camera_positions(VIEWS) if positions is None else positions
    return [take_picture(position, balls(number), paint, number) for number, position in enumerate(positions)]


@cache
def _good_pictures() -> Sequence[Picture]:
    """Which most captures begin with, before something is spoiled in their files."""
    return pictures()


def write_capture(folder: Path, taken: Sequence[Picture] | None = None) -> Path:
    """NeRF-synthetic."""
    (folder / "train").mkdir(parents=True)
    frames = []
    for picture in _good_pictures() if taken is None else taken:
        save_png(picture.rgba, folder / "train" / f"{picture.name}.png")
        pose = picture.world_from_camera @ np.diag([1.0, -1, -1, 1])
        frames.append({"file_path": f"./train/{picture.name}", "transform_matrix": pose.tolist()})
    document = {"camera_angle_x": 2 * np.arctan(SIDE / 2 / FOCAL), "frames": frames}
    (folder / "transforms_train.json").write_text(json.dumps(document))
    return folder


def before_grey(rgba: np.ndarray) -> np.ndarray:
    """The same without alpha, before a grey wall."""
    return np.where(rgba[..., 3:] > 0, rgba[..., :3], np.uint8(110))


def write_masks(folder: Path) -> Path:
    """Alpha taken out of the pictures of a capture and into masks/."""
    (folder / "masks").mkdir()
    for path in (folder / "train").glob("*.png"):
        rgba = np.array(Image.open(path))
        Image.fromarray(rgba[..., 3]).save(folder / "masks" / path.name)
        Image.fromarray(before_grey(rgba)).save(path)
    return folder


def write_photographs(folder: Path, count: int = VIEWS, grain: float = 40.0) -> Path:
    """Pictures without cameras or masks: brightness that changes from side to side, with `grain` on it."""
    folder.mkdir(parents=True)
    random = np.random.default_rng(0)
    for number in range(count):
        smooth = np.linspace(40, 120, 128)[None, :, None] + np.linspace(-20, 20, 96)[:, None, None] * np.sin(number) + 4 * number
        noise = np.kron(random.normal(0, grain, (24, 32)), np.ones((4, 4)))[..., None]
        Image.fromarray(np.clip(smooth + noise, 0, 255).repeat(3, 2).astype(np.uint8)).save(folder / f"p_{number:03d}.png")
    return folder
