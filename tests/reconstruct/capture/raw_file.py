"""A RAW file as small as one can be: a DNG with a Bayer mosaic of 16 bits, whose colours are those of linear sRGB."""

import struct
from pathlib import Path

import numpy as np

TIFF_TYPES = {1: "B", 2: "c", 3: "H", 4: "I", 5: "II", 10: "ii"}
WHITE = 65535


def write_dng(path: Path, linear: np.ndarray, orientation: int = 1) -> None:
    """
    Args:
        linear: (height, width, 3) linear sRGB 0..1, even sides. orientation: EXIF's.
    """
    height, width, _ = linear.shape
    mosaic = np.empty((height, width))
    for (row, column), channel in {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}.items():
        mosaic[row::2, column::2] = linear[row::2, column::2, channel]
    pixels = (mosaic * WHITE).round().astype("<u2").tobytes()
    srgb_from_xyz = (
        32405,
        10000,
        -15371,
        10000,
        -4985,
        10000,
        -9693,
        10000,
        18760,
        10000,
        416,
        10000,
        556,
        10000,
        -2040,
        10000,
        10572,
        10000,
    )
    entries = [
        (254, 4, [0]), (256, 4, [width]), (257, 4, [height]), (258, 3, [16]), (259, 3, [1]), (262, 3, [32803]), (271, 2, b"Test\0"),
        (272, 2, b"Test\0"), (273, 4, [0]), (274, 3, [orientation]), (277, 3, [1]), (278, 4, [height]), (279, 4, [len(pixels)]), (284, 3, [1]),
        (33421, 3, [2, 2]), (33422, 1, [0, 1, 1, 2]), (50706, 1, [1, 4, 0, 0]), (50708, 2, b"Test\0"), (50714, 4, [0]), (50717, 4, [WHITE]),
        (50721, 10, srgb_from_xyz), (50728, 5, [1, 1, 1, 1, 1, 1]), (50778, 3, [21]),
    ]  # fmt: skip
    start = 8 + 2 + 12 * len(entries) + 4
    directory, beyond = b"", b""
    for tag, kind, values in entries:
        data = values if isinstance(values, bytes) else struct.pack("<" + TIFF_TYPES[kind][0] * len(values), *values)
        count = len(values) // len(TIFF_TYPES[kind])
        if tag == 273:
            data = b"OFFS"  # known when all else is
        if len(data) <= 4:
            directory += struct.pack("<HHI", tag, kind, count) + data.ljust(4, b"\0")
        else:
            directory += struct.pack("<HHII", tag, kind, count, start + len(beyond))
            beyond += data + b"\0" * (len(data) % 2)
    directory = directory.replace(b"OFFS", struct.pack("<I", start + len(beyond)))
    path.write_bytes(b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", len(entries)) + directory + struct.pack("<I", 0) + beyond + pixels)
