"""What a reader finds in a capture folder before any pixel is decoded: which picture was taken from where.

Readers (nerf_synthetic, nerfstudio, colmap, metashape, realitycapture, nero) write these records; read_pictures turns them into Views.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Float64
from numpy import ndarray

from drgs.scene.camera import Camera
from drgs.scene.lens import Lens


@dataclass(frozen=True)
class Pinhole:
    """Intrinsics of one picture [pixels]; the centre of the top-left pixel is (0.5, 0.5)."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class Photograph:
    """One posed picture on disc."""

    name: str
    """Stem of the image file, unique within the capture."""
    image: Path
    mask: Path | None
    """Picture whose black means background; None when there is none."""
    mask_is_depth: bool
    """NeRO: `mask` holds 16-bit depth, 65535 = 15 units, background beyond 14.5."""
    camera_from_world: Float64[ndarray, "4 4"]
    """OpenCV axes."""
    pinhole: Pinhole
    """Of the undistorted picture."""
    lens: Lens | None = None
    """Through which the picture on disc was taken; None where it is a pinhole's already."""

    @property
    def size_on_disc(self) -> tuple[int, int]:
        """(width, height) that the picture's file must have."""
        picture = self.pinhole if self.lens is None else self.lens
        return picture.width, picture.height


@dataclass(frozen=True, eq=False)
class Capture:
    """A readable capture folder."""

    source: str
    """nerf-synthetic, nerfstudio, colmap, metashape, realitycapture or nero."""
    photographs: tuple[Photograph, ...]
    points_world: Float[ndarray, "point 3"] | None
    point_colors_srgb: Float[ndarray, "point 3"] | None
    """0..1."""


def without_masks(capture: Capture) -> Capture:
    """Whose mask files do not count, as for strokes. What is transparent in a picture stays so: nobody knows its colour."""
    return replace(capture, photographs=tuple(replace(photograph, mask=None) for photograph in capture.photographs))


def pinhole_from_angle(angle_x: float, angle_y: float | None, width: int, height: int) -> Pinhole:
    """Intrinsics from fields of view [rad], principal point in the middle; square pixels unless `angle_y` is given."""
    fx = 0.5 * width / np.tan(0.5 * angle_x)
    fy = fx if angle_y is None else 0.5 * height / np.tan(0.5 * angle_y)
    return Pinhole(float(fx), float(fy), width / 2, height / 2, width, height)


def resize_pinhole(pinhole: Pinhole, width: int, height: int) -> Pinhole:
    """Intrinsics of the same picture resampled to another size. Exact: with pixel centres at +0.5 all four numbers scale."""
    sx, sy = width / pinhole.width, height / pinhole.height
    return Pinhole(pinhole.fx * sx, pinhole.fy * sy, pinhole.cx * sx, pinhole.cy * sy, width, height)


def camera_of(camera_from_world: Float64[ndarray, "4 4"], pinhole: Pinhole, name: str) -> Camera:
    """The record the renderer takes, in float32."""
    intrinsics = np.array([[pinhole.fx, 0, pinhole.cx], [0, pinhole.fy, pinhole.cy], [0, 0, 1]])
    return Camera(
        torch.tensor(camera_from_world, dtype=torch.float32),
        torch.tensor(intrinsics, dtype=torch.float32),
        pinhole.width,
        pinhole.height,
        name,
    )
