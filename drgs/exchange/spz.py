"""Splats in SPZ, version 3: fixed-point places, and bytes for everything else, in a gzip stream. About a seventh of a PLY.

In: plain arrays in the format's frame: x right, y up, z towards the viewer. Out: bytes. It has no place for materials, and none for flat splats:
the third scale is written as small as it goes.
Source: Niantic's format (docs/sources.md: niantic2024). Its own writer keeps 5 and 4 bits of each harmonic; we keep the byte: of the sample's colours
those are 5.7 of 255 off, ours 0.7, in twice the bytes.
"""

import gzip
import math
import struct

import numpy as np

_MAGIC, _VERSION = 0x5053474E, 3
_DEGREE = 3
_LEAST_LOG_SCALE, _STEPS_A_LOG_SCALE = -10.0, 16.0
SMALLEST_SCALE = math.exp(_LEAST_LOG_SCALE)
"""What a scale is at least; in metres a twentieth of a millimetre."""
_FINEST_PART = 15
"""Places are exact to the largest coordinate by two to this power: far below the width of a splat, and no random bits for gzip to keep."""
_MOST_FRACTION_BITS = 24
_PLACE_BITS = 23
"""Of a coordinate, beside its sign."""
_COLOR_GAIN = 0.15
"""Of a byte's range, for a unit of the constant harmonic: colours may leave 0..1."""
_HARMONIC_ZERO = 128
"""The byte of a harmonic of 0; 1 is as many above."""
_COMPONENT_BITS = 9
"""Of a quaternion's component, beside its sign; none but the largest is above the root of a half."""


def encode_spz(splats: dict[str, np.ndarray]) -> bytes:
    """Bytes of a .spz.

    Args:
        splats: centers (n, 3), scales (n, 3) linear, quats_wxyz (n, 4) of unit length, opacities (n) 0..1, sh (n, 16, 3) of colours less 0.5.

    Raises:
        ValueError: a centre is farther away than the format can say.
    """
    centers = splats["centers"].astype(np.float64)
    farthest = float(np.abs(centers).max(initial=0.0))
    if farthest >= 1 << _PLACE_BITS:
        raise ValueError(f"a splat is at {farthest:g}; SPZ reaches {1 << _PLACE_BITS}: export it as ply3")
    bits = _fraction_bits(farthest)
    header = struct.pack("<3I4B", _MAGIC, _VERSION, len(centers), _DEGREE, bits, 0, 0)
    with np.errstate(divide="ignore"):  # a scale of 0 is the smallest there is
        log_scales = np.log(splats["scales"])
    streams = [
        np.round(centers * 2.0**bits).astype("<i4").view(np.uint8).reshape(-1, 3, 4)[..., :3],
        _bytes(splats["opacities"] * 255),
        _bytes((splats["sh"][:, 0] * _COLOR_GAIN + 0.5) * 255),
        _bytes((log_scales - _LEAST_LOG_SCALE) * _STEPS_A_LOG_SCALE),
        _smallest_three(splats["quats_wxyz"][:, [1, 2, 3, 0]]),
        _bytes(splats["sh"][:, 1:] * _HARMONIC_ZERO + _HARMONIC_ZERO),
    ]
    # Without a time: the same asset gives the same file.
    return gzip.compress(header + b"".join(stream.tobytes() for stream in streams), mtime=0)


def _fraction_bits(farthest: float) -> int:
    """Bits below the point of coordinates up to `farthest`."""
    if farthest == 0:
        return 0
    whole = math.floor(math.log2(farthest)) + 1
    return min(max(_FINEST_PART - whole, 0), _MOST_FRACTION_BITS)


def _bytes(values: np.ndarray) -> np.ndarray:
    return np.round(values).clip(0, 255).astype(np.uint8)


def _smallest_three(quats_xyzw: np.ndarray) -> np.ndarray:
    """(n,) uint32: the largest component's number in the upper two bits, then signs and sizes of the others in their order."""
    largest = np.abs(quats_xyzw).argmax(1)
    # A quaternion and its negative are one rotation: the largest component is positive.
    upright = quats_xyzw * np.where(np.take_along_axis(quats_xyzw, largest[:, None], 1) < 0, -1.0, 1.0)
    top = (1 << _COMPONENT_BITS) - 1
    sizes = np.round(np.abs(upright) * math.sqrt(2) * top).clip(0, top).astype(np.uint32)
    packed = largest.astype(np.uint32)
    for component in range(4):
        longer = packed << (_COMPONENT_BITS + 1) | (upright[:, component] < 0).astype(np.uint32) << _COMPONENT_BITS | sizes[:, component]
        packed = np.where(largest == component, packed, longer)
    return packed.astype("<u4")
