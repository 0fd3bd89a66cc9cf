"""Pictures of linear radiance: lat-long environments (EXR and Radiance HDR) and rendered maps (EXR).

In and out: (height, width, channel) float32 numpy arrays. Which direction a texel belongs to is scene.environment's business.
Files come from strangers, so sizes are checked before pixels are decoded.
Source: OpenEXR 3; Ward 1991, "Real Pixels" and the Radiance file format notes for RGBE and its run lengths.
"""

import contextlib
import io
import struct
import sys
import warnings
from dataclasses import dataclass
from typing import IO

import numpy as np
import OpenEXR

MAX_WIDTH = 16384
MAX_HEIGHT = 8192
MOST_TIMES_ITS_SIZE = 1100
"""That a picture's pixels may take in memory beyond FREE_BYTES: what zlib, the best packer of both formats, can do (1032) and a little."""
FREE_BYTES = 64 << 20
"""Small pictures may be packed as well as they like."""
MOST_BYTES = 2 << 30
"""Of all channels of a picture, as float32: 16384 x 8192 in three colours takes 1.5 GiB."""
_ROWS_AT_ONCE = 64
_HEAD_BYTES = 1 << 16
"""Of a Radiance file, within which its pixels begin."""
_MOST_ATTRIBUTES = 10_000
"""Of an OpenEXR header that is looked through."""
_LONGEST_NAME = 256
"""Of an attribute, with the zero behind it."""
MAX_RADIANCE = 1e12
"""Of a texel: hundreds of times the sun's disc in any unit that is in use, and with room for sums and squares of it in float32."""


@dataclass(frozen=True)
class PictureLimits:
    """What a picture's header may claim; it is compared before a pixel is decoded."""

    width: int = MAX_WIDTH
    height: int = MAX_HEIGHT
    bytes: int = MOST_BYTES
    """Of all channels as float32."""


@dataclass(frozen=True)
class PictureClaim:
    """What a picture's header says of it."""

    width: int
    height: int
    channels: int


def decode_environment(
    data: bytes, name: str = "environment", clamp_negative: bool = True, limits: PictureLimits | None = None
) -> np.ndarray:
    """(height, width = 2 height, 3) linear radiance of an EXR or Radiance HDR file.

    Args:
        clamp_negative: set negative values (a resampling filter's ringing) to 0, with a warning.
        limits: as large as is read anywhere where None.

    Raises:
        ValueError: damaged, not 2:1, too large, without R, G and B, or a value is not finite or beyond MAX_RADIANCE.
    """
    if data[:4] == b"\x76\x2f\x31\x01":
        radiance = _decode_exr_rgb(data, name, limits)
    elif data[:2] == b"#?":
        radiance = decode_hdr(data, name, limits)
    else:
        raise ValueError(f"{name}: is neither an OpenEXR nor a Radiance HDR file")
    height, width, _ = radiance.shape
    if width != 2 * height or height < 2:
        raise ValueError(f"{name}: is {width}x{height}; expected a lat-long environment twice as wide as high")
    if not np.isfinite(radiance).all():
        raise ValueError(f"{name}: holds {int((~np.isfinite(radiance)).sum())} values that are not finite")
    most = max(float(radiance.max()), -float(radiance.min()))
    if most > MAX_RADIANCE:
        beyond = int((np.abs(radiance) > MAX_RADIANCE).sum())
        raise ValueError(
            f"{name}: holds {beyond} values up to {most:.3g}; expected at most {MAX_RADIANCE:g}, "
            "so scale the picture down and raise the intensity of the edit that names it"
        )
    negative = int((radiance < 0).sum())
    if negative and clamp_negative:
        warnings.warn(f"{name}: {negative} negative values were set to 0", stacklevel=2)
        radiance = np.maximum(radiance, 0)
    return radiance


def picture_claim(stream: IO[bytes]) -> PictureClaim | None:
    """What the header of an OpenEXR or Radiance HDR file claims, as the decoders read it; None where it says nothing that they would take.

    Args:
        stream: at the file's beginning; no more than its header is read.
    """
    head = stream.read(8)
    if head[:4] == b"\x76\x2f\x31\x01":
        return _exr_claim(stream)
    try:
        height, width, _ = _hdr_size(head + stream.read(_HEAD_BYTES), "")
    except ValueError:
        return None
    return PictureClaim(width, height, 3)


def _exr_claim(stream: IO[bytes]) -> PictureClaim | None:
    """By the attributes of the first header one by one: what looks like one may be a part of another, and comments may be of any length."""

    def text() -> bytes:
        found = bytearray()
        while (byte := stream.read(1)) not in (b"", b"\0") and len(found) < _LONGEST_NAME:
            found += byte
        return bytes(found)

    sizes: list[tuple[int, int]] = []
    channels = 0
    for _ in range(_MOST_ATTRIBUTES):
        name = text()
        if not name:
            break
        kind, length = text(), stream.read(4)
        if len(length) < 4 or (size := struct.unpack("<i", length)[0]) < 0:
            return None
        if name == b"dataWindow" and size == 16 and len(window := stream.read(16)) == 16:
            left, top, right, bottom = struct.unpack("<4i", window)
            sizes.append((right - left + 1, bottom - top + 1))
        elif kind == b"chlist":
            end = stream.tell() + size
            while stream.tell() < end and text():
                stream.seek(16, 1)
                channels += 1
            stream.seek(end)
        else:
            stream.seek(size, 1)
    if len(sizes) != 1 or min(sizes[0]) < 1:
        return None
    return PictureClaim(*sizes[0], channels)


def encode_environment(radiance: np.ndarray) -> bytes:
    """Bytes of a ZIP-compressed float32 EXR of (height, width, 3)."""
    return encode_exr({channel: radiance[..., k] for k, channel in enumerate("RGB")})


def encode_exr(channels: dict[str, np.ndarray]) -> bytes:
    """Bytes of a ZIP-compressed float32 EXR of (height, width) channels."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    stream = io.BytesIO()
    OpenEXR.File(header, {key: np.ascontiguousarray(values, np.float32) for key, values in channels.items()}).write(stream)
    return stream.getvalue()


def encode_maps(
    radiance: np.ndarray,
    coverage: np.ndarray,
    albedo: np.ndarray,
    normal_world: np.ndarray,
    depth: np.ndarray,
    roughness: np.ndarray,
    metallic: np.ndarray,
    visibility: np.ndarray,
) -> bytes:
    """Bytes of the EXR that `drgs render --aov` writes: channels R G B A albedo.* normal.* depth.Z roughness.Y metallic.Y visibility.Y.

    Colours are (height, width, 3), the rest (height, width). Where coverage is 0 the other maps mean nothing and are written as 0,
    depth as +inf.
    """
    nothing = coverage <= 0
    channels = {key: radiance[..., k] for k, key in enumerate("RGB")} | {"A": coverage}
    channels |= {f"albedo.{key}": albedo[..., k] for k, key in enumerate("RGB")}
    channels |= {f"normal.{key}": normal_world[..., k] for k, key in enumerate("XYZ")}
    channels |= {"depth.Z": depth, "roughness.Y": roughness, "metallic.Y": metallic, "visibility.Y": visibility}
    empty = dict.fromkeys(channels, 0.0) | {"depth.Z": np.inf}
    return encode_exr({key: np.where(nothing, np.float32(empty[key]), values) for key, values in channels.items()})


def decode_exr(data: bytes, name: str = "EXR", limits: PictureLimits | None = None) -> dict[str, np.ndarray]:
    """Channel name -> (height, width) float32.

    Args:
        limits: as large as is read anywhere where None.

    Raises:
        ValueError: damaged, too large, deep, of several parts, or with subsampled channels.
    """
    limits = limits or PictureLimits()
    try:
        with OpenEXR.File(io.BytesIO(data), separate_channels=True, header_only=True) as head:
            parts, window = len(head.parts), head.header()["dataWindow"]
            kind, channels = head.header()["type"], head.header()["channels"]
        width, height = (int(window[1][k]) - int(window[0][k]) + 1 for k in (0, 1))
        _check_claim(PictureClaim(width, height, len(channels)), len(data), limits, name)
        if (
            parts != 1
            or kind not in (OpenEXR.scanlineimage, OpenEXR.tiledimage)
            or any(c.xSampling != 1 or c.ySampling != 1 for c in channels)
        ):
            raise ValueError(f"{name}: has {parts} parts, deep data or subsampled channels; expected one flat picture")
        # The binding prints its troubles on stdout, which belongs to --json.
        with contextlib.redirect_stdout(sys.stderr), OpenEXR.File(io.BytesIO(data), separate_channels=True) as file:
            pixels = {key: np.asarray(channel.pixels).astype(np.float32) for key, channel in file.channels().items()}
    except (RuntimeError, OverflowError) as error:
        raise ValueError(f"{name}: is not a readable OpenEXR file ({error})") from error
    except ValueError as error:
        raise error if str(error).startswith(name) else ValueError(f"{name}: is a damaged OpenEXR file ({error})") from error
    if any(values.shape != (height, width) for values in pixels.values()):
        raise ValueError(f"{name}: is a damaged OpenEXR file (channels of unequal size)")
    return pixels


def _decode_exr_rgb(data: bytes, name: str, limits: PictureLimits | None) -> np.ndarray:
    channels = decode_exr(data, name, limits)
    if not {"R", "G", "B"} <= set(channels):
        raise ValueError(f"{name}: has the channels {', '.join(sorted(channels))}; expected R, G, B")
    return np.stack([channels[key] for key in "RGB"], -1)


def _hdr_size(data: bytes, name: str) -> tuple[int, int, int]:
    """Height, width, and where the pixels begin.

    Raises:
        ValueError: no header, XYZE, or another orientation.
    """
    end = data.find(b"\n\n", 0, _HEAD_BYTES)
    line_end = data.find(b"\n", end + 2, end + 200)
    if not data.startswith((b"#?RADIANCE", b"#?RGBE")) or end < 0 or line_end < 0:
        raise ValueError(f"{name}: is not a Radiance HDR file (no header)")
    lines = data[:end].decode("ascii", "replace").splitlines()
    if any(line.startswith("FORMAT=") and line.strip() != "FORMAT=32-bit_rle_rgbe" for line in lines):
        raise ValueError(f"{name}: holds XYZE values; expected FORMAT=32-bit_rle_rgbe")
    resolution = data[end + 2 : line_end].decode("ascii", "replace").split()
    match resolution:
        case ["-Y", rows, "+X", columns] if rows.isdigit() and columns.isdigit():
            return int(rows), int(columns), line_end + 1
        case _:
            raise ValueError(f"{name}: has the resolution line {' '.join(resolution)!r}; expected '-Y height +X width'")


def decode_hdr(data: bytes, name: str = "HDR", limits: PictureLimits | None = None) -> np.ndarray:
    """(height, width, 3) linear values of a Radiance RGBE picture stored top to bottom, left to right.

    Args:
        limits: as large as is read anywhere where None.

    Raises:
        ValueError: damaged, XYZE, another orientation, or too large.
    """
    height, width, position = _hdr_size(data, name)
    _check_claim(PictureClaim(width, height, 3), len(data), limits or PictureLimits(), name)
    radiance = np.empty((height, width, 3), np.float32)
    for first in range(0, height, _ROWS_AT_ONCE):  # never all of them as bytes, exponents and floats at a time
        rgbe = np.empty((min(_ROWS_AT_ONCE, height - first), width, 4), np.uint8)
        for row in range(len(rgbe)):
            try:
                position = _decode_hdr_row(data, position, rgbe[row])
            except (IndexError, ValueError) as error:
                raise ValueError(f"{name}: is a damaged Radiance HDR file (row {first + row} of {height})") from error
        scale = np.ldexp(np.float32(1), rgbe[..., 3].astype(np.int32) - 136)
        radiance[first : first + len(rgbe)] = np.where(
            rgbe[..., 3:] > 0, rgbe[..., :3].astype(np.float32) * scale[..., None], np.float32(0)
        )
    return radiance


def _check_claim(claim: PictureClaim, file_bytes: int, limits: PictureLimits, name: str) -> None:
    """
    Raises:
        ValueError: the picture would be larger than is read, or than a file of this size can hold.
    """
    size = f"{claim.width}x{claim.height}"
    if not (0 < claim.width <= limits.width and 0 < claim.height <= limits.height):
        raise ValueError(f"{name}: is {size}; the limit is {limits.width}x{limits.height}: make it smaller")
    what, claimed = f"{name}: {size}", claim.width * claim.height * claim.channels * 4
    if claim.channels > 3:
        what += f" with {claim.channels} channels"
    if claimed > limits.bytes:
        raise ValueError(f"{what} take {claimed} bytes in memory; the limit is {limits.bytes}")
    if claimed > FREE_BYTES and claimed > MOST_TIMES_ITS_SIZE * file_bytes:
        raise ValueError(
            f"{what} take {claimed} bytes in memory, more than {MOST_TIMES_ITS_SIZE} times the file's {file_bytes}; it is damaged"
        )


def _decode_hdr_row(data: bytes, position: int, row: np.ndarray) -> int:
    """Fill one (width, 4) row from `position`; returns where the next row starts."""
    width = len(row)
    if data[position] == 2 and data[position + 1] == 2 and data[position + 2] < 128:
        if (data[position + 2] << 8 | data[position + 3]) != width:
            raise ValueError("row length")
        position += 4
        for component in range(4):
            filled = 0
            while filled < width:
                count = data[position]
                run = count > 128
                count = count - 128 if run else count
                if count == 0 or filled + count > width:
                    raise ValueError("run length")
                values = data[position + 1] if run else np.frombuffer(data, np.uint8, count, position + 1)
                row[filled : filled + count, component] = values
                position += 2 if run else 1 + count
                filled += count
        return position
    # Flat or old run lengths: a pixel (1, 1, 1, n) repeats the last one n << 8k times, k counting repeats in a row.
    filled = shift = 0
    while filled < width:
        pixel = np.frombuffer(data, np.uint8, 4, position)
        position += 4
        if pixel[0] == pixel[1] == pixel[2] == 1:
            count = int(pixel[3]) << shift
            if filled == 0 or filled + count > width or shift > 24:
                raise ValueError("run length")
            row[filled : filled + count] = row[filled - 1]
            filled, shift = filled + count, shift + 8
        else:
            row[filled] = pixel
            filled, shift = filled + 1, 0
    return position
