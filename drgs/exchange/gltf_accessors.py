"""A glTF 2.0 file opened: its JSON, its buffers, and any of its accessors as a plain array.

In: a .glb, or a .gltf with its buffers beside it or inside it as base64. Out: arrays with sparse values filled in, strides undone and
normalised integers turned to fractions. It does not know what the arrays mean. Everything is checked before it is used: the file may come
from anybody. Why not a library: those that are well kept (pygltflib) hand out the JSON and the raw buffers, so that everything below would
be written all the same; trimesh decodes accessors but keeps neither skins nor animations. Source: glTF 2.0 specification, Khronos.
"""

import base64
import binascii
import json
import struct
from collections.abc import Collection
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np

_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_DTYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
_BASE64 = ";base64,"
MAX_BYTES = 1 << 30
"""Of a file, and of all its buffers together."""
MAX_VALUES = 64_000_000
"""Numbers that all accessors of a file may unpack to: without it, a small file could ask for all memory."""
UNDERSTOOD = ("KHR_mesh_quantization", "KHR_gaussian_splatting")
HARMLESS = ("KHR_materials_", "KHR_texture_", "KHR_lights_", "EXT_texture_", "MSFT_texture_", "KHR_xmp")
"""Extensions that a file may require: those above change accessors' types and what points mean, these nothing that moves."""


class GltfFile:
    """An opened file. Reading raises ValueError with what is wrong; the caller puts the file's name before it."""

    def __init__(self, document: dict, buffers: list[bytes]) -> None:
        self.document = document
        self._buffers = buffers
        self._left = MAX_VALUES

    def items(self, kind: str) -> list:
        """A top-level list of objects; empty where there is none."""
        found = self.document.get(kind, [])
        if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
            raise ValueError(f"its {kind} are not a list of objects")
        return found

    def item(self, kind: str, index: Any) -> dict:
        """One of them."""
        found = self.items(kind)
        return found[whole(index, len(found) - 1, f"an index into its {len(found)} {kind}")]

    def accessor(self, index: Any, kinds: tuple[str, ...], what: str) -> np.ndarray:
        """(count,) or (count, k) values of an accessor: integers as they are, or float32 if floats or normalised.

        Args:
            kinds: the types that `what` may have, such as VEC3.
        """
        accessor = self.item("accessors", index)
        if accessor.get("type") not in kinds:
            raise ValueError(f"its {what} have the type {str(accessor.get('type'))[:20]!r}; expected {' or '.join(kinds)}")
        return self._decode(accessor, what)

    def written_out(self, chosen: Collection[int]) -> tuple[dict, bytes]:
        """The same file with one buffer, in which the chosen accessors are plain arrays: not sparse, and floats where they were normalised.

        For readers that know neither. Returns the JSON, and the content of that buffer.
        """
        accessors, views = [dict(item) for item in self.items("accessors")], [dict(item) for item in self.items("bufferViews")]
        chunks: list[bytes] = []
        starts = []
        for content in self._buffers:
            starts.append(sum(map(len, chunks)))
            chunks.append(content + b"\0" * (-len(content) % 4))
        end = sum(map(len, chunks))
        for view in views:
            start = starts[whole(view.get("buffer"), len(starts) - 1, "a buffer view's buffer")]
            view |= {"buffer": 0, "byteOffset": start + whole(view.get("byteOffset", 0), end, "a buffer view's offset")}
        for index in sorted(chosen):
            found = self.item("accessors", index)
            if found.get("type") not in _WIDTHS:
                raise ValueError(f"its accessor {index} has the type {str(found.get('type'))[:20]!r}; expected one of {', '.join(_WIDTHS)}")
            values = self._decode(found, f"accessor {index}")
            code = next(code for code, name in _DTYPES.items() if np.dtype(name) == values.dtype)
            data = values.tobytes()
            views.append({"buffer": 0, "byteOffset": end, "byteLength": len(data)})
            accessors[index] = {"type": found["type"], "count": len(values), "componentType": code, "bufferView": len(views) - 1}
            chunks.append(data + b"\0" * (-len(data) % 4))
            end += len(chunks[-1])
        buffers = [{"byteLength": end}]
        return self.document | {"accessors": accessors, "bufferViews": views, "buffers": buffers}, b"".join(chunks)

    def charge(self, count: int) -> None:
        """Count numbers that are about to be unpacked; ValueError where all together are more than MAX_VALUES."""
        self._left -= count
        if self._left < 0:
            raise ValueError(f"its arrays unpack to more than {MAX_VALUES:,} numbers")

    def _decode(self, accessor: dict, what: str) -> np.ndarray:
        width = _WIDTHS[accessor["type"]]
        dtype = _component(accessor.get("componentType"), what)
        count = whole(accessor.get("count"), MAX_VALUES, f"the count of its {what}")
        self.charge(count * width)
        if "bufferView" in accessor:
            values = self._view(accessor["bufferView"], accessor.get("byteOffset", 0), count, width, dtype, what)
        else:
            values = np.zeros((count, width), dtype)
        if "sparse" in accessor:
            values = self._filled_in(values, accessor["sparse"], dtype, what)
        if values.dtype.kind != "f" and accessor.get("normalized", False) is True:
            values = np.maximum(values.astype(np.float32) / np.iinfo(values.dtype).max, -1.0).astype(np.float32)
        if values.dtype.kind == "f" and not np.isfinite(values).all():
            raise ValueError(f"its {what} hold {int((~np.isfinite(values)).sum())} values that are not finite")
        return values[:, 0] if width == 1 else values

    def _filled_in(self, values: np.ndarray, sparse: dict, dtype: np.dtype, what: str) -> np.ndarray:
        count = whole(sparse["count"], len(values), f"the count of sparse values of its {what}")
        places, given = sparse["indices"], sparse["values"]
        kind = _component(places.get("componentType"), what)
        if kind.kind != "u":
            raise ValueError(f"the sparse indices of its {what} are not unsigned integers")
        index = self._view(places["bufferView"], places.get("byteOffset", 0), count, 1, kind, what)[:, 0].astype(np.int64)
        if count and (index.max() >= len(values) or (np.diff(index) <= 0).any()):
            raise ValueError(f"the sparse indices of its {what} do not rise below {len(values)}")
        filled = values.copy()
        filled[index] = self._view(given["bufferView"], given.get("byteOffset", 0), count, values.shape[1], dtype, what)
        return filled

    def _view(self, index: Any, offset: Any, count: int, width: int, dtype: np.dtype, what: str) -> np.ndarray:
        """(count, width) values in a buffer view."""
        view = self.item("bufferViews", index)
        buffer = self._buffers[whole(view.get("buffer"), len(self._buffers) - 1, "a buffer view's buffer")]
        start = whole(view.get("byteOffset", 0), len(buffer), "a buffer view's offset")
        length = whole(view.get("byteLength"), len(buffer) - start, "a buffer view's length")
        offset = whole(offset, length, f"the offset of its {what}")
        element = width * dtype.itemsize
        stride = whole(view.get("byteStride", element), 252, f"the stride of its {what}")
        if stride < element or (count and offset + stride * (count - 1) + element > length):
            raise ValueError(f"its {what} reach beyond their buffer view: {count} of {element} bytes every {stride}, in {length - offset}")
        return np.ndarray((count, width), dtype, buffer, start + offset, (stride, dtype.itemsize)).copy()


def open_gltf(path: Path) -> GltfFile:
    """Open a .glb or .gltf file and load its buffers.

    Raises:
        ValueError: what is wrong, without the file's name: not glTF 2.0, damaged, a required extension that changes geometry, or a buffer
            that is missing or lies outside the file's folder.
    """
    if not path.is_file():
        raise ValueError("does not exist")
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"has {path.stat().st_size} bytes; at most {MAX_BYTES} are read")
    data = path.read_bytes()
    text, binary = _chunks(data) if data[:4] == struct.pack("<I", _MAGIC) else (data, None)
    try:
        document = json.loads(text, parse_constant=_refuse)
    except (ValueError, RecursionError) as error:
        raise ValueError(f"holds no readable JSON ({str(error)[:80]})") from error
    if not isinstance(document, dict) or not isinstance(document.get("asset"), dict):
        raise ValueError("is no glTF file: its JSON has no asset")
    version = str(document["asset"].get("version"))[:20]
    if not version.startswith("2."):
        raise ValueError(f"is glTF {version}; this program reads glTF 2")
    required = document.get("extensionsRequired", [])
    unknown = [str(name)[:60] for name in required if name not in UNDERSTOOD and not str(name).startswith(HARMLESS)]
    if unknown:
        hint = "; export it without compression" if any("compression" in name for name in unknown) else ""
        raise ValueError(f"needs the extension {unknown[0]}, which this program does not read{hint}")
    file = GltfFile(document, [])
    total = 0
    for index, buffer in enumerate(file.items("buffers")):
        content = _buffer(buffer, binary if index == 0 else None, path.parent, MAX_BYTES - total)
        size = whole(buffer.get("byteLength"), len(content), f"the length of buffer {index}, of which there are {len(content)} bytes,")
        total += size
        file._buffers.append(content[:size])
    return file


def whole(value: Any, highest: int, what: str) -> int:
    """A whole number from 0 to `highest` out of a file, else ValueError."""
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value <= highest:
        shown = str(value)[:40]
        raise ValueError(f"{what} is {shown}; expected a whole number from 0 to {highest}" if highest >= 0 else f"{what}: there is none")
    return value


def numbers(value: Any, count: int, what: str) -> np.ndarray:
    """(count,) float64 out of a list of numbers in a file, else ValueError."""
    good = isinstance(value, list) and len(value) == count and all(isinstance(v, int | float) and abs(v) < 1e30 for v in value)
    if not good:
        raise ValueError(f"{what} is {str(value)[:60]}; expected {count} numbers")
    return np.array(value, np.float64)


def _component(code: Any, what: str) -> np.dtype:
    if code not in _DTYPES:
        raise ValueError(f"its {what} have the component type {str(code)[:20]}; expected one of {sorted(_DTYPES)}")
    return np.dtype(_DTYPES[code])


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """JSON and binary chunk of a .glb; chunks of other kinds are passed over."""
    if len(data) < 20:
        raise ValueError("ends within its header")
    _, version, total, length, kind = struct.unpack_from("<5I", data)
    if version != 2:
        raise ValueError(f"is a GLB of version {version}; this program reads version 2")
    if total > len(data) or kind != _JSON or 20 + length > total:
        raise ValueError(f"is damaged: it has {len(data)} bytes, its header speaks of {max(total, 20 + length)}")
    position = 20 + length
    while position + 8 <= total:
        size, kind = struct.unpack_from("<2I", data, position)
        if position + 8 + size > total:
            raise ValueError("is damaged: a chunk reaches beyond its end")
        if kind == _BIN:
            return data[20 : 20 + length], data[position + 8 : position + 8 + size]
        position += 8 + size
    return data[20 : 20 + length], None


def _buffer(buffer: dict, binary: bytes | None, folder: Path, room: int) -> bytes:
    uri = buffer.get("uri")
    if uri is None:
        # A buffer without content belongs to compressed data that we do not read; what needs it will say so.
        return binary or b""
    if not isinstance(uri, str):
        raise ValueError("a buffer's address is not a string")
    if uri.startswith("data:"):
        place = uri.find(_BASE64, 0, 200)
        if place < 0:
            raise ValueError("holds a buffer whose data is not base64")
        try:
            return base64.b64decode(uri[place + len(_BASE64) :], validate=True)
        except binascii.Error as error:
            raise ValueError(f"holds a buffer whose base64 is damaged ({error})") from error
    name = unquote(uri)
    if "\0" in name or "://" in name:
        raise ValueError(f"names the buffer {name[:60]!r}, which is no file beside it")
    path = (folder / name).resolve()
    if not path.is_relative_to(folder.resolve()):
        raise ValueError(f"names the buffer {name[:60]!r}, which lies outside its folder")
    if not path.is_file():
        raise ValueError(f"names the buffer {name[:60]!r}, which does not exist")
    if path.stat().st_size > room:
        raise ValueError(f"has buffers of more than {MAX_BYTES} bytes")
    return path.read_bytes()


def _refuse(constant: str) -> float:
    raise ValueError(f"{constant} is not a number of JSON")
