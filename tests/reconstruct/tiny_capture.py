"""A sphere ray-cast with numpy, written in each of the layouts that captures come in.

Pictures are wider than high and the principal point is off centre, so that swapped axes and assumed centres show.
"""

import io
import json
import pickle
import struct
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
from PIL import Image

from drgs.scene.lens import PARAMETER_NAMES, Lens, pixels_from_plane

WIDTH, HEIGHT = 72, 56
FX, FY, CX, CY = 90.0, 84.0, 38.5, 26.0
SPHERE_CENTER = np.array([0.1, -0.15, 0.2])
SPHERE_RADIUS = 0.55
VIEWS = 24
FEW_VIEWS = 10
"""Enough for builds of which only is asked that they go through, stop and resume: their time is that of their views."""


@dataclass(frozen=True)
class TinyView:
    name: str
    rgba: np.ndarray
    camera_from_world: np.ndarray
    """OpenCV."""

    @property
    def world_from_opengl(self) -> np.ndarray:
        return np.linalg.inv(self.camera_from_world) @ np.diag([1.0, -1, -1, 1])


def look_at(position: np.ndarray) -> np.ndarray:
    """(4, 4) OpenCV camera_from_world at `position`, looking at the origin, image down against world z."""
    forward = -position / np.linalg.norm(position)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = rotation, -rotation @ position
    return matrix


def camera_positions(count: int, distance: float = 3.0) -> np.ndarray:
    k = np.arange(count) + 0.5
    z = 0.9 - 1.7 * k / count
    azimuth = np.pi * (1 + 5**0.5) * k
    radius = np.sqrt(1 - z * z)
    return distance * np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), z], -1)


def hits_sphere(origin: np.ndarray, directions: np.ndarray) -> np.ndarray:
    """Distance along unit rays to the sphere, NaN where missed."""
    offset = origin - SPHERE_CENTER
    b = directions @ offset
    discriminant = b * b - (offset @ offset - SPHERE_RADIUS**2)
    return np.where(discriminant > 0, -b - np.sqrt(np.maximum(discriminant, 0)), np.nan)


def color_of_normal(normal: np.ndarray) -> np.ndarray:
    """8-bit sRGB of the painted sphere."""
    return np.round((0.5 + 0.4 * normal) * 255).astype(np.uint8)


def plane_from_pixels(lens: Lens, pixels: np.ndarray) -> np.ndarray:
    """Directions (x, y, 1) that a lens shows there, by Newton's method with differences for derivatives, for lenses that bend moderately."""
    start = (pixels - lens.principal_point) / lens.focal_lengths
    plane = start.reshape(-1, 2).T.copy()
    wanted, going = pixels.reshape(-1, 2).T, np.arange(plane.shape[1])
    apart = 1e-6

    def off(places: np.ndarray) -> np.ndarray:
        return pixels_from_plane(lens, places.T).T - wanted[:, going]

    for _ in range(50):
        at = plane[:, going]
        miss = off(at)
        across, down = ((off(at + step[:, None]) - miss) / apart for step in apart * np.eye(2))
        area = across[0] * down[1] - down[0] * across[1]
        step = np.stack([miss[0] * down[1] - down[0] * miss[1], across[0] * miss[1] - miss[0] * across[1]]) / area
        plane[:, going] = at - step
        going = going[np.abs(step).max(0) > 1e-9]
        if len(going) == 0:
            break
    return plane.T.reshape(start.shape)


def sphere_views(count: int = VIEWS, square: bool = False, lens: Lens | None = None) -> list[TinyView]:
    """Views of the sphere. With `square`, intrinsics are FX, FX and the picture's middle, as camera_angle_x says."""
    return [*_sphere_views(count, square, lens)]


@cache  # some two hundred tests begin with the same few captures
def _sphere_views(count: int, square: bool, lens: Lens | None) -> tuple[TinyView, ...]:
    fx, fy, cx, cy = (FX, FX, WIDTH / 2, HEIGHT / 2) if square else (FX, FY, CX, CY)
    lens = lens or Lens("PINHOLE", (fx, fy, cx, cy), WIDTH, HEIGHT)
    plane = plane_from_pixels(lens, np.stack(np.meshgrid(np.arange(lens.width) + 0.5, np.arange(lens.height) + 0.5), -1))
    rays = np.concatenate([plane, np.ones_like(plane[..., :1])], -1)
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    views = []
    for index, position in enumerate(camera_positions(count)):
        pose = look_at(position)
        directions = rays @ pose[:3, :3]
        distance = hits_sphere(position, directions)
        normal = (position + np.nan_to_num(distance)[..., None] * directions - SPHERE_CENTER) / SPHERE_RADIUS
        hit = ~np.isnan(distance)
        rgba = np.concatenate([np.where(hit[..., None], color_of_normal(np.clip(normal, -1, 1)), 0), 255 * hit[..., None]], -1)
        views.append(TinyView(f"r_{index:03d}", rgba.astype(np.uint8), pose))
    for view in views:
        view.rgba.setflags(write=False)
        view.camera_from_world.setflags(write=False)
    return tuple(views)


def save_png(pixels: np.ndarray, path: Path) -> None:
    """Pixels (height, width) or (height, width, 3 or 4), uint8."""
    path.write_bytes(_png(pixels.shape, pixels.tobytes()))


@cache
def _png(shape: tuple[int, ...], pixels: bytes) -> bytes:
    packed = io.BytesIO()
    Image.fromarray(np.frombuffer(pixels, np.uint8).reshape(shape)).save(packed, "PNG")
    return packed.getvalue()


def at_scale(views: list[TinyView], scale: float) -> list[TinyView]:
    """The same pictures, of a world `scale` times as large."""
    poses = [view.camera_from_world * np.array([[1, 1, 1, scale]] * 3 + [[1, 1, 1, 1]]) for view in views]
    return [replace(view, camera_from_world=pose) for view, pose in zip(views, poses, strict=True)]


def write_nerf_synthetic(folder: Path, views: list[TinyView] | None = None, **document: object) -> Path:
    """transforms_train.json with camera_angle_x and RGBA pictures; `document` overrides or adds keys."""
    views = views or sphere_views(square=True)
    (folder / "train").mkdir(parents=True, exist_ok=True)
    frames = []
    for view in views:
        save_png(view.rgba, folder / "train" / f"{view.name}.png")
        frames.append({"file_path": f"./train/{view.name}", "transform_matrix": view.world_from_opengl.tolist()})
    angle = 2 * np.arctan(0.5 * WIDTH / FX)
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": angle, "frames": frames, **document}))
    return folder


def write_nerfstudio(folder: Path, views: list[TinyView] | None = None, **document: object) -> Path:
    """transforms.json, RGB pictures and a mask_path for each frame; half the frames carry their own intrinsics."""
    views = views or sphere_views()
    (folder / "images").mkdir(parents=True, exist_ok=True)
    (folder / "my_masks").mkdir(exist_ok=True)
    frames = []
    for index, view in enumerate(views):
        save_png(view.rgba[..., :3], folder / "images" / f"{view.name}.png")
        save_png(view.rgba[..., 3], folder / "my_masks" / f"{view.name}.png")
        own = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY} if index % 2 else {}
        frames.append({
            "file_path": f"images/{view.name}.png", "mask_path": f"my_masks/{view.name}.png",
            "transform_matrix": view.world_from_opengl.tolist(), **own,
        })  # fmt: skip
    shared = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT, "k1": 0.0, "p1": 0.0, "camera_model": "OPENCV"}
    (folder / "transforms.json").write_text(json.dumps({**shared, "frames": frames, **document}))
    return folder


def sphere_points(count: int = 400, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Points on the sphere and their 8-bit colours."""
    normal = np.random.default_rng(seed).normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    return SPHERE_CENTER + SPHERE_RADIUS * normal, color_of_normal(normal)


def _quat_wxyz(rotation: np.ndarray) -> np.ndarray:
    """Of the eigenvector of the largest eigenvalue (Bar-Itzhack 2000): another way than the code under test."""
    m = rotation
    k = np.array([
        [m[0, 0] - m[1, 1] - m[2, 2], m[1, 0] + m[0, 1], m[2, 0] + m[0, 2], m[2, 1] - m[1, 2]],
        [0, m[1, 1] - m[0, 0] - m[2, 2], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
        [0, 0, m[2, 2] - m[0, 0] - m[1, 1], m[1, 0] - m[0, 1]],
        [0, 0, 0, np.trace(m)],
    ])  # fmt: skip
    vector = np.linalg.eigh(k, UPLO="U")[1][:, -1]
    return vector[[3, 0, 1, 2]]


def write_colmap(folder: Path, binary: bool, model: str = "PINHOLE", masks: str = "{name}.jpg.png", lens: Lens | None = None) -> Path:
    """sparse/0 with one camera, JPEG-named PNG pictures... as .png, masks beside them, points on the sphere."""
    views = sphere_views(lens=lens)
    sparse = folder / "sparse" / "0"
    for part in (sparse, folder / "images", folder / "masks"):
        part.mkdir(parents=True)
    lens = lens or Lens(model, {"PINHOLE": (FX, FY, CX, CY), "SIMPLE_PINHOLE": (FX, CX, CY)}[model], WIDTH, HEIGHT)
    parameters, number = lens.parameters, list(PARAMETER_NAMES).index(lens.model)
    points, colors = sphere_points()
    images_txt, images_bin = ["# comment"], struct.pack("<Q", len(views))
    for index, view in enumerate(views):
        save_png(view.rgba[..., :3], folder / "images" / f"{view.name}.png")
        save_png(view.rgba[..., 3], folder / "masks" / masks.replace("jpg", "png").format(name=view.name))
        quat, t = _quat_wxyz(view.camera_from_world[:3, :3]), view.camera_from_world[:3, 3]
        # Every second image has no 2D points: its second line is empty.
        observations = 2 * (index % 2)
        images_txt += [
            f"{index + 1} {' '.join(map(repr, map(float, (*quat, *t))))} 7 {view.name}.png",
            "1.0 2.0 -1 3.5 4.5 8" if observations else "",
        ]
        images_bin += struct.pack("<i7di", index + 1, *quat, *t, 7) + f"{view.name}.png".encode() + b"\0"
        images_bin += struct.pack("<Q", observations) + struct.pack("<ddq", 1.0, 2.0, -1) * observations
    if binary:
        (sparse / "cameras.bin").write_bytes(
            struct.pack("<QiiQQ", 1, 7, number, lens.width, lens.height) + struct.pack(f"<{len(parameters)}d", *parameters)
        )
        (sparse / "images.bin").write_bytes(images_bin)
        rows = [
            struct.pack("<Q3d3BdQ", i, *p, *map(int, c), 0.5, i % 3) + b"\0" * (8 * (i % 3))
            for i, (p, c) in enumerate(zip(points, colors, strict=True))
        ]
        (sparse / "points3D.bin").write_bytes(struct.pack("<Q", len(rows)) + b"".join(rows))
    else:
        words = " ".join(map(str, parameters))
        (sparse / "cameras.txt").write_text(f"# Camera list\n7 {lens.model} {lens.width} {lens.height} {words}\n")
        (sparse / "images.txt").write_text("\n".join(images_txt) + "\n")
        lines = [f"{i} {p[0]} {p[1]} {p[2]} {c[0]} {c[1]} {c[2]} 0.5 1 2" for i, (p, c) in enumerate(zip(points, colors, strict=True))]
        (sparse / "points3D.txt").write_text("# points\n" + "\n".join(lines) + "\n")
    return folder


def write_nero(folder: Path) -> Path:
    """K.png, K-depth.png, K-camera.pkl as GlossySynthetic has them."""
    folder.mkdir(parents=True, exist_ok=True)
    intrinsics = np.array([[FX, 0, CX], [0, FY, CY], [0, 0, 1]])
    for index, view in enumerate(sphere_views()):
        save_png(view.rgba[..., :3], folder / f"{index}.png")
        depth = np.where(view.rgba[..., 3] > 0, 3.0, 15.0) / 15 * 65535
        Image.fromarray(depth.astype(np.uint16)).save(folder / f"{index}-depth.png")
        (folder / f"{index}-camera.pkl").write_bytes(pickle.dumps([view.camera_from_world[:3].astype(np.float32), intrinsics]))
    return folder
