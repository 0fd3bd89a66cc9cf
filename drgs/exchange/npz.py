"""A float array out of an NPZ file, checked before it is unpacked: no pickle, no shape but the expected one."""

import io
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import IO

import numpy as np

MAX_FRAMES = 100_000


def read_npz_frames(path: Path, name: str, shape: tuple[int, ...], choose: Callable[[int], Sequence[int]]) -> list[np.ndarray]:
    """float32 frames of this shape out of array `name`, which holds one (shape) or a sequence (frame, *shape).

    Only the chosen frames are unpacked, so that a long sequence can be played.

    Args:
        choose: told the number of frames, says which are wanted.

    Raises:
        ValueError: as read_npz_array.
    """
    try:
        with zipfile.ZipFile(path) as archive, archive.open(f"{name}.npy") as stream:
            found, fortran, dtype = _read_header(stream)
            sequence = len(found) == len(shape) + 1 and found[1:] == shape and 0 < found[0] <= MAX_FRAMES
            if not sequence:
                return [read_npz_array(path, name, shape) for _ in choose(1)]
            if dtype.kind != "f" or dtype.hasobject or fortran:
                raise ValueError(f"its {name!r} has type {dtype}; expected floats, row by row")
            start, size = stream.tell(), dtype.itemsize * int(np.prod(shape))
            frames = []
            for index in choose(found[0]):
                stream.seek(start + index * size)
                data = stream.read(size)
                if len(data) < size:
                    raise ValueError(f"its {name!r} ends within frame {index}")
                frames.append(np.frombuffer(data, dtype).reshape(shape).astype(np.float32))
    except KeyError as error:
        raise ValueError(f"{path}: holds no array {name!r}") from error
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"{path}: is not a readable NPZ file ({error})") from error
    except ValueError as error:
        raise error if str(error).startswith(f"{path}: ") else ValueError(f"{path}: {error}") from error
    bad = sum(int((~np.isfinite(frame)).sum()) for frame in frames)
    if bad:
        raise ValueError(f"{path}: {name!r} holds {bad} values that are not finite")
    return frames


def _read_header(stream: IO[bytes]) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Shape, whether column by column, and type."""
    version = np.lib.format.read_magic(stream)
    header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    return header(stream)


def read_npz_array(path: Path, name: str, shape: tuple[int, ...]) -> np.ndarray:
    """float32 array `name` of this shape.

    Raises:
        ValueError: one sentence: missing, damaged, another shape or type, or a value that is not finite.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            entry = archive.getinfo(f"{name}.npy")
            if entry.file_size > 4096 + 8 * int(np.prod(shape)):
                raise ValueError(f"its {name!r} unpacks to {entry.file_size} bytes, more than an array of shape {shape}")
            stream = io.BytesIO(archive.read(entry))
        found, fortran, dtype = _read_header(stream)
        if found != shape or dtype.kind != "f" or dtype.hasobject:
            raise ValueError(f"its {name!r} has shape {found} and type {dtype}; expected {shape} floats")
        values = np.frombuffer(stream.read(), dtype)
        array = values.reshape(shape, order="F" if fortran else "C").astype(np.float32, order="C")
    except KeyError as error:
        raise ValueError(f"{path}: holds no array {name!r}") from error
    except (OSError, zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError) as error:
        raise ValueError(f"{path}: is not a readable NPZ file ({error})") from error
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from error
    if not np.isfinite(array).all():
        raise ValueError(f"{path}: {name!r} holds {int((~np.isfinite(array)).sum())} values that are not finite")
    return array
