"""Reads SPZ, versions 2 and 3, by the words of Niantic's description and not by our writer: the other half of round trips."""

import gzip
import struct
from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class SpzFile:
    """What a file says, decoded."""

    version: int
    degree: int
    fraction_bits: int
    flags: int
    centers: np.ndarray
    opacities: np.ndarray
    sh: np.ndarray
    """(n, 16, 3)"""
    log_scales: np.ndarray
    quats_xyzw: np.ndarray


def read_spz(data: bytes) -> SpzFile:
    plain = gzip.decompress(data)
    assert plain[:4] == b"NGSP"
    version, count, degree, fraction_bits, flags, reserved = struct.unpack("<II4B", plain[4:16])
    assert reserved == 0 and version == 3 and degree == 3
    at = 16

    def stream(width: int) -> np.ndarray:
        nonlocal at
        at += width * count
        return np.frombuffer(plain[at - width * count : at], np.uint8).reshape(count, width)

    numbers = stream(9).reshape(count, 3, 3).astype(int) @ [1, 256, 65536]
    centers = np.where(numbers >= 1 << 23, numbers - (1 << 24), numbers) / (1 << fraction_bits)
    opacities = stream(1)[:, 0] / 255
    constant = (stream(3) / 255 - 0.5) / 0.15
    log_scales = stream(3) / 16 - 10
    quats = np.array([smallest_three(word) for word in stream(4).copy().view("<u4")[:, 0].tolist()]).reshape(count, 4)
    rest = (stream(45).reshape(count, 15, 3) - 128.0) / 128
    assert at == len(plain), "nothing more"
    return SpzFile(
        version, degree, fraction_bits, flags, centers, opacities, np.concatenate([constant[:, None], rest], 1), log_scales, quats
    )


def smallest_three(word: int) -> list[float]:
    """x y z w: the upper two bits name the largest; below, from the last to the first of the others, ten bits each, the highest a sign."""
    largest = word >> 30
    quat = [0.0] * 4
    for component in (3, 2, 1, 0):
        if component != largest:
            size = (word & 511) / 511 * 0.5**0.5
            quat[component] = -size if word & 512 else size
            word >>= 10
    quat[largest] = max(1 - sum(x * x for x in quat), 0.0) ** 0.5
    return quat
