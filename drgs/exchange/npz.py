"""One float array out of an NPZ file, checked before it is unpacked: no pickle, no shape but the expected one."""

import io
import zipfile
import zlib
from pathlib import Path

import numpy as np


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
        version = np.lib.format.read_magic(stream)
        header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        found, fortran, dtype = header(stream)
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
