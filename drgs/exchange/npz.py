"""A float array out of an NPZ file, checked before it is unpacked: no pickle, no shape but the expected one.

The header of an array is read here and not by numpy, which evaluates it as Python. Source: NumPy's NPY format, versions 1 to 3.
"""

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO

import numpy as np

from drgs.exchange.zip_entries import open_entry, open_zip

MAX_FRAMES = 100_000
_MAX_HEADER_BYTES = 10_000
_TYPE = re.compile(r"'descr':\s*'([^']{1,20})'")
_ORDER = re.compile(r"'fortran_order':\s*(True|False)")
_SHAPE = re.compile(r"'shape':\s*\(([\d,\s]{0,200})\)")
_FLOATS = re.compile(r"[<>=|]?f[248]")


def read_npz_frames(path: Path, name: str, shape: tuple[int, ...], choose: Callable[[int], Sequence[int]]) -> list[np.ndarray]:
    """float32 frames of this shape out of array `name`, which holds one (shape) or a sequence (frame, *shape).

    Only the chosen frames are unpacked, so that a long sequence can be played.

    Args:
        choose: told the number of frames, says which are wanted.

    Raises:
        ValueError: one sentence: missing, damaged, another shape or type, or a value that is not finite.
    """
    try:
        with open_zip(path, f"{path}:") as archive:
            if f"{name}.npy" not in archive.namelist():
                raise ValueError(f"{path}: holds no array {name!r}")
            with open_entry(archive, archive.getinfo(f"{name}.npy"), f"{path}: its {name!r}") as stream:
                frames = _read_frames(stream, shape, choose, f"{path}: its {name!r}")
    except OSError as error:
        raise ValueError(f"{path}: cannot be read ({error})") from error
    bad = sum(int((~np.isfinite(frame)).sum()) for frame in frames)
    if bad:
        raise ValueError(f"{path}: {name!r} holds {bad} values that are not finite")
    return frames


def _read_frames(stream: IO[bytes], shape: tuple[int, ...], choose: Callable[[int], Sequence[int]], what: str) -> list[np.ndarray]:
    found, fortran, type_name = _read_header(stream, what)
    single = found == shape
    sequence = len(found) == len(shape) + 1 and found[1:] == shape and 0 < found[0] <= MAX_FRAMES
    if not (single or sequence) or not _FLOATS.fullmatch(type_name):
        raise ValueError(f"{what} has shape {found} and type {type_name}; expected {shape} floats, or a sequence of such")
    if sequence and fortran:
        raise ValueError(f"{what} lies column by column; expected row by row")
    dtype = np.dtype(type_name)
    start, size = stream.tell(), dtype.itemsize * int(np.prod(shape))
    frames = []
    for index in choose(found[0] if sequence else 1):
        stream.seek(start + index * size)
        data = stream.read(size)
        if len(data) < size:
            raise ValueError(f"{what} ends within frame {index}")
        frames.append(np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C").astype(np.float32, order="C"))
    return frames


def _read_header(stream: IO[bytes], what: str) -> tuple[tuple[int, ...], bool, str]:
    """Shape, whether column by column, and type."""
    magic = stream.read(8)
    length = int.from_bytes(stream.read(2 if magic[6:7] == b"\x01" else 4), "little")
    if magic[:6] != b"\x93NUMPY" or length > _MAX_HEADER_BYTES:
        raise ValueError(f"{what} is no NPY array")
    text = stream.read(length).decode("latin-1")
    type_name, order, shape = (pattern.findall(text) for pattern in (_TYPE, _ORDER, _SHAPE))
    if [len(type_name), len(order), len(shape)] != [1, 1, 1]:
        raise ValueError(f"{what} has a header that is not understood: {text.strip()[:100]!r}")
    return tuple(int(size) for size in shape[0].split(",") if size.strip()), order[0] == "True", type_name[0]
