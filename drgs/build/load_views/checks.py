"""What makes a capture unusable, each told in one sentence: the file, what was found, what was expected.

Every function returns quietly or raises ValueError.
"""

import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image, UnidentifiedImageError

from drgs.build.load_views.capture import Photograph, Pinhole

FEWEST_VIEWS = 3
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG", ".WEBP")
MOST_PIXELS = 100_000_000
"""Larger pictures are taken for damaged files or decompression bombs."""
LEAST_FOCAL, MOST_FOCAL = 0.1, 100.0
"""Focal length as a share of the longer side: fields of view from 0.6 to 157 degrees."""
ORTHONORMAL_TOLERANCE = 1e-2


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header, without decoding."""
    if not path.is_file():
        raise ValueError(f"{path}: no such image, but the capture names it.")
    try:
        with Image.open(path, formats=("PNG", "JPEG", "WEBP")) as image:
            size = image.size
    except (UnidentifiedImageError, OSError, Image.DecompressionBombError) as error:
        raise ValueError(f"{path}: not a readable PNG, JPEG or WebP image ({error}).") from error
    if size[0] * size[1] > MOST_PIXELS:
        raise ValueError(f"{path}: {size[0]}x{size[1]} pixels, expected at most {MOST_PIXELS // 10**6} megapixels.")
    return size


def find_image(folder: Path, file_path: str, named_in: Path) -> Path:
    """The image a capture file names, relative to its folder, with or without extension.

    Names that lead out of the folder are refused: an uploaded capture must not read other files of the machine.
    """
    relative = Path(os.path.normpath(file_path.replace("\\", "/")))
    if relative.is_absolute() or ".." in relative.parts:
        raise ValueError(f"{named_in}: file_path {file_path!r} leads outside the capture folder, expected a path below {folder}.")
    candidates = [folder / relative, *(folder / f"{relative}{suffix}" for suffix in IMAGE_SUFFIXES)]
    for candidate in candidates:
        if candidate.is_file():
            return candidate
    expected = f"{folder / relative}" if relative.suffix in IMAGE_SUFFIXES else f"{folder / relative}.png (or .jpg, .webp)"
    raise ValueError(f"{expected}: no such image, but {named_in.name} names it.")


def rigid_camera_from_world(camera_from_world: np.ndarray, where: str) -> np.ndarray:
    """The pose (4, 4) with its rotation made exactly orthonormal, when it was nearly so."""
    if not np.isfinite(camera_from_world).all():
        raise ValueError(f"{where}: its pose contains NaN or infinity, expected 16 finite numbers.")
    rotation = camera_from_world[:3, :3]
    determinant = float(np.linalg.det(rotation))
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if determinant < 0 or error > ORTHONORMAL_TOLERANCE:
        raise ValueError(
            f"{where}: its pose is not rigid (determinant {determinant:.4g}, off orthonormal by {error:.2g}), "
            "expected a rotation without scale or mirroring."
        )
    u, _, vt = np.linalg.svd(rotation)
    rigid = np.eye(4)
    rigid[:3, :3] = u @ vt
    rigid[:3, 3] = camera_from_world[:3, 3]
    return rigid


def check_pinhole(pinhole: Pinhole, where: str) -> None:
    """Focal lengths and principal point a real camera can have."""
    numbers = (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy)
    if not np.isfinite(numbers).all():
        raise ValueError(f"{where}: intrinsics fx, fy, cx, cy = {numbers} are not finite.")
    longer = max(pinhole.width, pinhole.height)
    for label, focal in (("fx", pinhole.fx), ("fy", pinhole.fy)):
        if not LEAST_FOCAL * longer <= focal <= MOST_FOCAL * longer:
            raise ValueError(
                f"{where}: focal length {label} = {focal:.6g} pixels for a {pinhole.width}x{pinhole.height} image, "
                f"expected {LEAST_FOCAL * longer:.0f} to {MOST_FOCAL * longer:.0f}."
            )
    if not (-pinhole.width <= pinhole.cx <= 2 * pinhole.width and -pinhole.height <= pinhole.cy <= 2 * pinhole.height):
        raise ValueError(
            f"{where}: principal point ({pinhole.cx:.6g}, {pinhole.cy:.6g}) lies far outside the {pinhole.width}x{pinhole.height} image."
        )


def check_angle(name: str, value: object, where: str) -> float:
    """A field of view [rad]."""
    if not isinstance(value, int | float) or not 0 < value < np.pi:
        hint = " (degrees?)" if isinstance(value, int | float) and value >= np.pi else ""
        raise ValueError(f"{where}: {name} = {value!r}{hint}, expected radians between 0 and pi.")
    return float(value)


def check_photographs(photographs: Sequence[Photograph], where: Path) -> None:
    """Enough views, of one size, with files as large as their cameras say."""
    if len(photographs) < FEWEST_VIEWS:
        raise ValueError(f"{where}: {len(photographs)} views, expected at least {FEWEST_VIEWS}.")
    for photograph in photographs:
        size, camera_size = image_size(photograph.image), (photograph.pinhole.width, photograph.pinhole.height)
        if size != camera_size:
            raise ValueError(
                f"{photograph.image}: the image is {size[0]}x{size[1]}, but its camera is for {camera_size[0]}x{camera_size[1]} pixels."
            )
    first = photographs[0]
    for photograph in photographs:
        if (photograph.pinhole.width, photograph.pinhole.height) != (first.pinhole.width, first.pinhole.height):
            raise ValueError(
                f"{photograph.image}: the image is {photograph.pinhole.width}x{photograph.pinhole.height}, but {first.image.name} is "
                f"{first.pinhole.width}x{first.pinhole.height}, expected one size for all views of a capture."
            )
    for photograph in photographs:
        check_pinhole(photograph.pinhole, f"{where}: camera of {photograph.image.name}")


def find_masks(images: Sequence[Path], images_root: Path, masks_folder: Path) -> list[Path | None]:
    """The mask of each image: masks/NAME.png or, as COLMAP has it, masks/NAME.jpg.png; all of them or none."""
    if not masks_folder.is_dir():
        return [None] * len(images)
    masks: list[Path | None] = []
    for image in images:
        relative = image.relative_to(images_root) if image.is_relative_to(images_root) else Path(image.name)
        candidates = [masks_folder / f"{relative}.png", *(masks_folder / relative.with_suffix(suffix) for suffix in IMAGE_SUFFIXES)]
        masks.append(next((candidate for candidate in candidates if candidate.is_file()), None))
    missing = [image for image, mask in zip(images, masks, strict=True) if mask is None]
    if missing and len(missing) < len(images):
        raise ValueError(
            f"{masks_folder / missing[0].stem}.png: no such mask ({len(missing)} of {len(images)} images have none), expected a mask for every image."
        )
    return masks
