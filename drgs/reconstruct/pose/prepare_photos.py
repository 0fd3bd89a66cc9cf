"""Decode the photographs once: turn them as EXIF says, write what COLMAP is to see, and measure how sharp each is.

In: the list of photographs. Out: upright pictures and masks in the work folder, and a record of each. Alpha becomes a mask. A picture that cannot be
decoded, or is there twice, is left out with a reason; whether enough are left is for others to say.
"""

import hashlib
import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import UInt8
from numpy import ndarray
from PIL import Image

from drgs.exchange.pictures import as_eight_bits, exif_number, orientation_of, read_exif, upright
from drgs.reconstruct.capture.camera_files import is_header_readable, opened_photograph
from drgs.reconstruct.capture.laplacian_variance import laplacian_variance
from drgs.reconstruct.capture.load_views.checks import check_least_side, image_size
from drgs.reconstruct.pose.list_photos import Photo
from drgs.reconstruct.progress import BuildStopped

DECODE_THREADS = 2
DIAGONAL_OF_35MM = 43.2666
"""Of the frame that equivalent focal lengths refer to [mm]."""
EXAMINED_SIDE = 1000
"""Sharpness is measured at this size [pixels]."""
JPEG_QUALITY = 98
BACKDROP_SIDE = 1000
"""Backdrops are looked for at this size [pixels]."""
BACKDROP_SHARE = 0.9
"""Of pictures without masks that must have a plain backdrop, for it to be taken for one."""
OPAQUE = 128
"""Of a mask: from this shade on a pixel is the object's."""
EXIF_FOLDER, EXIF_FOCAL_35MM = 0x8769, 0xA405


@dataclass(frozen=True)
class PreparedPhoto:
    """An upright picture in the work folder."""

    name: str
    file: str
    """Below images/ of the work folder; its mask, where there is one, is masks/FILE.png."""
    has_mask: bool
    width: int
    height: int
    focal_pixels: float | None
    """By EXIF."""
    sharpness: float
    """Variance of the Laplacian on the object, of 8-bit luma at EXAMINED_SIDE."""
    digest: str
    """Of the picture's file and its mask's."""


def prepare_photos(
    photos: list[Photo], work: Path, advance: Callable[[int], None], should_stop: Callable[[], bool]
) -> tuple[list[PreparedPhoto], dict[str, str]]:
    """Upright pictures below `work`, and the reason for each photograph, by name, that is left out.

    Raises:
        BuildStopped: as asked.
    """
    for part in ("images", "masks"):
        shutil.rmtree(work / part, ignore_errors=True)
        (work / part).mkdir(parents=True)
    prepared: list[PreparedPhoto] = []
    left_out: dict[str, str] = {}
    first_of: dict[str, str] = {}
    with ThreadPoolExecutor(DECODE_THREADS) as pool:
        try:
            for done, (photo, result) in enumerate(zip(photos, pool.map(lambda photo: _prepare(photo, work), photos), strict=True), 1):
                if should_stop():
                    raise BuildStopped
                if isinstance(result, str):
                    left_out[photo.name] = result
                elif result.digest in first_of:
                    left_out[photo.name] = f"the same file as {first_of[result.digest]}"
                else:
                    first_of[result.digest] = photo.name
                    prepared.append(result)
                advance(done)
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    return prepared, left_out


def with_backdrop_masks(
    prepared: list[PreparedPhoto], work: Path, should_stop: Callable[[], bool]
) -> tuple[list[PreparedPhoto], dict[str, str]]:
    """The pictures with masks where nearly all of them have a plain backdrop, and the reason for each, by name, that has none; else the same.

    Raises:
        BuildStopped: as asked.
    """
    from drgs.reconstruct.pose.backdrop_masks import backdrop_mask  # here: who only looks at photographs needs none of it

    masked, others = [], {}

    def mask_of(photo: PreparedPhoto) -> UInt8[ndarray, "height width"] | None:
        if should_stop():
            raise BuildStopped
        with Image.open(work / "images" / photo.file) as image:
            scale = min(1.0, BACKDROP_SIDE / max(image.size))
            small = image.convert("RGB").resize((round(image.width * scale), round(image.height * scale)), Image.Resampling.BOX)
        mask = backdrop_mask(np.asarray(small))
        if mask is None:
            return None
        return np.asarray(Image.fromarray(mask).resize((photo.width, photo.height), Image.Resampling.BILINEAR))

    with ThreadPoolExecutor(DECODE_THREADS) as pool:
        for photo, mask in zip(prepared, pool.map(mask_of, prepared), strict=True):
            if mask is None:
                others[photo.name] = "its backdrop is not plain, as that of the others is"
                if len(others) > (1 - BACKDROP_SHARE) * len(prepared):
                    pool.shutdown(cancel_futures=True)
                    return prepared, {}
            else:
                Image.fromarray(mask).save(work / "masks" / f"{photo.file}.png")
                masked.append(replace(photo, has_mask=True))
    return masked, others


def _prepare(photo: Photo, work: Path) -> PreparedPhoto | str:
    """The record, or why there is none."""
    try:
        if is_header_readable(photo.path):
            image_size(photo.path)  # which refuses what is too large, too
        with opened_photograph(photo.path) as image:
            image.load()
            focal_35mm = exif_number(read_exif(image, EXIF_FOLDER), EXIF_FOCAL_35MM)
            usable_as_it_is = image.format in ("JPEG", "PNG") and image.mode in ("RGB", "L") and orientation_of(image) == 1
            usable_as_it_is &= "transparency" not in image.info
            is_photographic = image.format != "PNG"
            turned = as_eight_bits(upright(image))
        check_least_side(turned.size, photo.path)
        alpha = np.asarray(turned.convert("RGBA"))[..., 3] if "A" in turned.getbands() or "transparency" in turned.info else None
        mask = _mask(photo, alpha, turned.size)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        return " ".join(str(error).split()).rstrip(".")
    file = f"{photo.name}{'.jpg' if is_photographic and alpha is None else '.png'}"
    if usable_as_it_is:
        _link(photo.path, work / "images" / file)
    else:
        turned.convert("RGB").save(work / "images" / file, quality=JPEG_QUALITY, subsampling=0)
    if mask is not None:
        Image.fromarray(mask).save(work / "masks" / f"{file}.png")
    digest = hashlib.sha256(photo.path.read_bytes() + (b"" if photo.mask is None else photo.mask.read_bytes())).hexdigest()
    focal = focal_35mm / DIAGONAL_OF_35MM * float(np.hypot(*turned.size)) if focal_35mm else None
    return PreparedPhoto(photo.name, file, mask is not None, *turned.size, focal, _sharpness(turned, mask), digest)


def _mask(photo: Photo, alpha: UInt8[ndarray, "height width"] | None, size: tuple[int, int]) -> UInt8[ndarray, "height width"] | None:
    """0..255 from the file's alpha and its mask; None where neither says anything."""
    if alpha is not None and (alpha >= OPAQUE).all():
        alpha = None
    if photo.mask is None:
        return alpha
    with Image.open(photo.mask) as image:
        picture = as_eight_bits(image)
        rgba = np.asarray(picture.convert("RGBA"))
        mask = rgba[..., 3] if (rgba[..., 3] < 255).any() else np.asarray(picture.convert("L"))
    width, height = size
    if mask.shape != (height, width):
        raise ValueError(f"its mask {photo.mask.name} is {mask.shape[1]}x{mask.shape[0]}, the upright picture {width}x{height} pixels")
    return mask if alpha is None else np.minimum(mask, alpha)


def _sharpness(picture: Image.Image, mask: UInt8[ndarray, "height width"] | None) -> float:
    """Variance of the Laplacian [squared shades] where the mask, if any, says object."""
    scale = min(1.0, EXAMINED_SIDE / max(picture.size))
    size = (max(3, round(picture.width * scale)), max(3, round(picture.height * scale)))
    luma = np.asarray(picture.convert("L").resize(size, Image.Resampling.BOX), dtype=np.float32)
    inside = None if mask is None else np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.BOX)) == 255
    return laplacian_variance(luma, inside)


def _link(source: Path, target: Path) -> None:
    """The same file under another name, copied where the file system cannot."""
    try:
        os.link(source.resolve(), target)
    except OSError:
        shutil.copyfile(source, target)
