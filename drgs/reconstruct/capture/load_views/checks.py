"""What makes a capture unusable, each told in one sentence: the file, what was found, what was expected.

Every function returns quietly or raises ValueError; a CaptureFault where what to do about it is known, too.
"""

import math
import os
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray
from PIL import Image, UnidentifiedImageError

from drgs.exchange.package import MANIFEST
from drgs.reconstruct.capture.load_views.capture import Photograph, Pinhole

FEWEST_VIEWS = 3
LEAST_SIDE = 16
"""Of a picture [pixels]: a smaller one is the icon of something, or an empty place."""
IMAGE_SUFFIXES = (".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG", ".WEBP")
HEIC_SUFFIXES = (".heic", ".heif")
"""Read where pillow-heif is installed, of plain photographs."""
MOST_PIXELS = 100_000_000
"""Larger pictures are taken for damaged files or decompression bombs."""
LEAST_FOCAL, MOST_FOCAL = 0.1, 100.0
"""Focal length as a share of the longer side: fields of view from 0.6 to 157 degrees."""
FOREIGN_SIGNS: dict[str, tuple[tuple[int, bytes], ...]] = {
    "HEIC": ((4, b"ftypheic"), (4, b"ftypheix"), (4, b"ftypmif1")),
    "a TIFF or RAW file": ((0, b"II*\0"), (0, b"MM\0*")),
    "GIF": ((0, b"GIF8"),),
    "a Windows bitmap": ((0, b"BM"),),
    "a film": ((4, b"ftyp"), (8, b"AVI ")),
    "a text": ((0, b"<"), (0, b"{")),
}
"""What strangers' files begin with, the first that fits: kind, and (place, bytes)."""
ORTHONORMAL_TOLERANCE = 1e-2
MOST_DISTANCE = 1e9
"""Of a camera from the origin [world units]: farther ones leave no digits of float32 for the object."""
NO_PANORAMA = "a panorama cannot be undistorted: cut pinhole pictures out of it and reconstruct from those"
"""What to do about COLMAP's and nerfstudio's camera model EQUIRECTANGULAR."""
MOST_NAME = 1000
MOST_SHOWN = 60
"""Characters of a wrong value in a sentence."""


class CaptureFault(ValueError):
    """Something is wrong with a capture; its text says what in one sentence.

    Args:
        advice: what to do about it. pictures: names of those it is about, without suffix; none: the capture as a whole.
        mark: the same in a word or two, for a small picture's label.
    """

    def __init__(self, sentence: str, advice: str = "", pictures: Sequence[str] = (), mark: str = "") -> None:
        super().__init__(sentence)
        self.advice, self.pictures, self.mark = advice, tuple(pictures), mark


COPY_AGAIN = "Copy it from the camera once more, or leave it out, in the camera file too."


def damaged(path: Path, why: str) -> CaptureFault:
    """A picture that cannot be read."""
    return CaptureFault(f"{path}: {why}", COPY_AGAIN, [path.stem], "cannot be read")


def is_file(path: Path) -> bool:
    """False also for what the system takes for no path at all, such as a name too long."""
    try:
        return path.is_file()
    except OSError:
        return False


def is_folder(path: Path) -> bool:
    """As is_file."""
    try:
        return path.is_dir()
    except OSError:
        return False


def refuse_asset(folder: Path) -> None:
    """
    Raises:
        ValueError: the folder, in which neither cameras nor enough photographs were found, is what a build writes.
    """
    if (folder / MANIFEST).is_file():
        raise ValueError(f"{folder}: is an asset, which a build wrote; expected photographs or a capture. To look at it: drgs serve.")


def shown(value: object) -> str:
    """What a file holds, short enough for a sentence."""
    text = repr(value)
    return text if len(text) <= MOST_SHOWN else f"{text[:MOST_SHOWN]}..."


def finite_number(value: object, what: str) -> float:
    """A number of a JSON file as a float.

    Raises:
        ValueError: `what` is none, or is more than a float holds.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"{what} = {shown(value)}, expected a number.")
    try:
        number = float(value)
    except OverflowError:
        number = math.inf
    if not math.isfinite(number):
        raise ValueError(f"{what} = {shown(value)}, expected a finite number.")
    return number


def check_file_name(name: str, where: str) -> None:
    """A name out of a file that a path can be made of."""
    try:
        name.encode()
    except UnicodeEncodeError as error:
        raise ValueError(f"{where} {shown(name)} holds half a character, expected a file name.") from error
    if not name or "\0" in name or len(name) > MOST_NAME:
        raise ValueError(f"{where} {shown(name)} has {len(name)} characters, expected a file name of 1 to {MOST_NAME}.")


def image_size(path: Path) -> tuple[int, int]:
    """(width, height) from the header, without decoding."""
    if not is_file(path):
        raise ValueError(f"{path}: no such image, but the capture names it.")
    try:
        with Image.open(path, formats=("PNG", "JPEG", "WEBP")) as image:
            size = image.size
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        raise damaged(path, f"not a readable PNG, JPEG or WebP image ({_why_unreadable(path, error)}).") from error
    if size[0] * size[1] > MOST_PIXELS:
        raise ValueError(f"{path}: {size[0]}x{size[1]} pixels, expected at most {MOST_PIXELS // 10**6} megapixels.")
    return size


def _why_unreadable(path: Path, error: Exception) -> str:
    """What a file is that Pillow does not take for a picture, where that is easily seen."""
    try:
        with path.open("rb") as stream:
            begin = stream.read(16)
    except OSError:
        return str(error)
    if not begin:
        return "the file is empty"
    for kind, signs in FOREIGN_SIGNS.items():
        if any(begin[at:].startswith(sign) for at, sign in signs):
            return f"it is {kind} whatever its name says"
    return str(error)


def check_least_side(size: tuple[int, int], path: Path) -> None:
    """A picture large enough to show something."""
    if min(size) < LEAST_SIDE:
        raise CaptureFault(
            f"{path}: the image is {size[0]}x{size[1]} pixels, expected at least {LEAST_SIDE} a side.",
            "Put the photograph itself in its place, or leave it out, in the camera file too.",
            [path.stem],
            f"{size[0]}x{size[1]} pixels",
        )


def find_image(folder: Path, file_path: str, named_in: Path) -> Path:
    """The image a capture file names, relative to its folder, with or without extension.

    Names that lead out of the folder are refused: an uploaded capture must not read other files of the machine.
    """
    check_file_name(file_path, f"{named_in}: the file name")
    relative = Path(os.path.normpath(file_path.replace("\\", "/")))
    if relative.is_absolute() or ".." in relative.parts:
        raise ValueError(f"{named_in}: file_path {file_path!r} leads outside the capture folder, expected a path below {folder}.")
    candidates = [folder / relative, *(folder / f"{relative}{suffix}" for suffix in IMAGE_SUFFIXES)]
    for candidate in candidates:
        if is_file(candidate):
            return candidate
    expected = f"{folder / relative}" if relative.suffix in IMAGE_SUFFIXES else f"{folder / relative}.png (or .jpg, .webp)"
    raise ValueError(f"{expected}: no such image, but {named_in.name} names it.")


def rigid_camera_from_world(camera_from_world: Float[ndarray, "rows 4"], where: str) -> Float[ndarray, "4 4"]:
    """The pose (4, 4) with its rotation made exactly orthonormal, when it was nearly so."""
    if not np.isfinite(camera_from_world).all():
        raise ValueError(f"{where}: its pose contains NaN or infinity, expected 16 finite numbers.")
    rotation = camera_from_world[:3, :3]
    with np.errstate(all="ignore"):  # of numbers near the largest
        determinant = float(np.linalg.det(rotation))
        error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if not (determinant > 0 and error <= ORTHONORMAL_TOLERANCE):
        raise ValueError(
            f"{where}: its pose is not rigid (determinant {determinant:.4g}, off orthonormal by {error:.2g}), "
            "expected a rotation without scale or mirroring."
        )
    distance = float(np.abs(camera_from_world[:3, 3]).max())
    if distance > MOST_DISTANCE:
        raise ValueError(f"{where}: its camera is {distance:.3g} units away from the origin, expected at most {MOST_DISTANCE:g}.")
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
    angle = finite_number(value, f"{where}: {name}")
    if not 0 < angle < np.pi:
        hint = " (degrees?)" if angle >= np.pi else ""
        raise ValueError(f"{where}: {name} = {shown(value)}{hint}, expected radians between 0 and pi.")
    return angle


def check_photographs(photographs: Sequence[Photograph], where: Path) -> None:
    """Enough views, with files as large as their cameras say."""
    if len(photographs) < FEWEST_VIEWS:
        raise ValueError(f"{where}: {len(photographs)} views, expected at least {FEWEST_VIEWS}.")
    for photograph in photographs:
        size, camera_size = image_size(photograph.image), photograph.size_on_disc
        if size != camera_size:
            raise ValueError(
                f"{photograph.image}: the image is {size[0]}x{size[1]}, but its camera is for {camera_size[0]}x{camera_size[1]} pixels."
            )
        check_least_side(size, photograph.image)
    for photograph in photographs:
        check_pinhole(photograph.pinhole, f"{where}: camera of {photograph.image.name}")


def find_masks(images: Sequence[Path], images_root: Path, masks_folder: Path) -> list[Path | None]:
    """The mask of each image: masks/NAME.png or, as COLMAP has it, masks/NAME.jpg.png; all of them or none.

    NAME is the image's path below `images_root`, or its plain name where no two images share one: masks/r_000.png is that of train/r_000.png.

    Raises:
        ValueError: an image has no mask though others have one, or the folder holds pictures of which none is the mask of an image.
    """
    if not is_folder(masks_folder) or not images:
        return [None] * len(images)
    below_root = [image.relative_to(images_root) if image.is_relative_to(images_root) else Path(image.name) for image in images]
    masks = [_find_mask(masks_folder, name) for name in below_root]
    if not any(masks) and len({image.stem for image in images}) == len(images):
        masks = [_find_mask(masks_folder, Path(image.name)) for image in images]
    missing = [image for image, mask in zip(images, masks, strict=True) if mask is None]
    if missing and len(missing) < len(images):
        raise ValueError(
            f"{masks_folder / missing[0].stem}.png: no such mask ({len(missing)} of {len(images)} images have none), expected a mask for every image."
        )
    unused = pictures_in(masks_folder)
    if missing and unused:
        raise ValueError(
            f"{masks_folder}: none of its {len(unused)} pictures (such as {unused[0].name}) is named like an image, "
            f"expected {masks_folder / below_root[0].with_suffix('.png')} for {images[0].name}."
        )
    return masks


def _find_mask(masks_folder: Path, name: Path) -> Path | None:
    candidates = [masks_folder / f"{name}.png", *(masks_folder / name.with_suffix(suffix) for suffix in IMAGE_SUFFIXES)]
    return next((candidate for candidate in candidates if is_file(candidate)), None)


def pictures_in(folder: Path) -> list[Path]:
    """All picture files below a folder, sorted."""
    return sorted(path for path in folder.rglob("*") if path.suffix in IMAGE_SUFFIXES and is_file(path))
