"""PLY files: elements of named columns, read from ASCII or binary, written as binary little endian.

In: the bytes of a file. Out: a `Ply` of plain numpy arrays, and the reverse. It does not know what the columns mean
(see gaussian_ply for that). Sizes are bounded, because files come from strangers.
Source: Turk 1994, "The PLY Polygon File Format".
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

MAX_ROWS = 20_000_000
MAX_PROPERTIES = 256
MAX_ELEMENTS = 32
MAX_HEADER_BYTES = 1 << 20
MAX_ASCII_BYTES = 1 << 28

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2", "uint16": "u2",
    "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {"i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float", "f8": "double"}


@dataclass(frozen=True, eq=False)
class PlyList:
    """A list property: row i owns the next `counts[i]` of `values`."""

    counts: np.ndarray
    """(row,) int64."""
    values: np.ndarray
    """(sum of counts,)."""


@dataclass(frozen=True, eq=False)
class PlyElement:
    """The rows of one element, by column."""

    rows: int
    scalars: dict[str, np.ndarray]
    """Name -> (row,)."""
    lists: dict[str, PlyList]


@dataclass(frozen=True, eq=False)
class Ply:
    """A whole file."""

    elements: dict[str, PlyElement]
    comments: tuple[str, ...]


@dataclass
class _Property:
    name: str
    dtype: str
    count_dtype: str | None


@dataclass
class _Header:
    encoding: str
    elements: list[tuple[str, int, list[_Property]]] = field(default_factory=list)
    comments: list[str] = field(default_factory=list)
    end: int = 0


def parse_ply(data: bytes, name: str = "PLY") -> Ply:
    """Read a file's bytes; `name` is what error messages call it.

    Raises:
        ValueError: not a PLY file, truncated, larger than the limits above, or an integer column out of its range.
    """
    header = _parse_header(data, name)
    if header.encoding == "ascii":
        if len(data) > MAX_ASCII_BYTES:
            raise ValueError(f"{name}: an ASCII PLY of {len(data)} bytes is too large; the limit is {MAX_ASCII_BYTES}, save it as binary")
        read: _AsciiBody | _BinaryBody = _AsciiBody(data[header.end :], name)
    else:
        read = _BinaryBody(data, header.end, "<" if header.encoding == "binary_little_endian" else ">", name)
    elements = {element: read.element(element, rows, properties) for element, rows, properties in header.elements}
    return Ply(elements, tuple(header.comments))


def encode_ply(columns: Mapping[str, Mapping[str, np.ndarray]], faces: np.ndarray | None = None, comments: Sequence[str] = ()) -> bytes:
    """Bytes of a binary little-endian file.

    Args:
        columns: element -> column name -> (row,) array; written in this order and with these types.
        faces: (face, corner) vertex indices, written as a last element `face` with the list `vertex_indices`.
    """
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {comment}" for comment in comments)]
    bodies = []
    for element, scalars in columns.items():
        arrays = {column: np.asarray(values) for column, values in scalars.items()}
        rows = len(next(iter(arrays.values())))
        lines.append(f"element {element} {rows}")
        lines += [f"property {_NAMES[values.dtype.str[1:]]} {column}" for column, values in arrays.items()]
        table = np.empty(rows, [(column, "<" + values.dtype.str[1:]) for column, values in arrays.items()])
        for column, values in arrays.items():
            table[column] = values
        bodies.append(table.tobytes())
    if faces is not None:
        corners = faces.shape[1]
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        table = np.empty(len(faces), [("count", "u1"), ("index", "<i4", (corners,))])
        table["count"], table["index"] = corners, faces
        bodies.append(table.tobytes())
    return "\n".join([*lines, "end_header\n"]).encode("ascii") + b"".join(bodies)


def triangles_from_faces(ply: Ply, vertex_count: int, name: str = "PLY") -> np.ndarray:
    """(face, 3) int32 triangles of the element `face`; polygons become fans.

    Raises:
        ValueError: there are no faces, or one names a vertex that does not exist.
    """
    element = ply.elements.get("face")
    polygons = next((element.lists[key] for key in ("vertex_indices", "vertex_index") if key in element.lists), None) if element else None
    if polygons is None or len(polygons.counts) == 0:
        raise ValueError(f"{name}: has no faces; expected a triangle mesh")
    counts, values = polygons.counts, polygons.values.astype(np.int64)
    if values.size and (values.min() < 0 or values.max() >= vertex_count):
        raise ValueError(f"{name}: a face names vertex {int(values.max())}, but there are {vertex_count} vertices")
    first = np.cumsum(counts) - counts
    fans = []
    for corner in range(1, int(counts.max()) - 1):
        start = first[counts > corner + 1]
        fans.append(np.stack([values[start], values[start + corner], values[start + corner + 1]], -1))
    if not fans:
        raise ValueError(f"{name}: no face has three corners; expected a triangle mesh")
    return np.concatenate(fans).astype(np.int32)


def _parse_header(data: bytes, name: str) -> _Header:
    if data[:4] not in (b"ply\n", b"ply\r"):
        raise ValueError(f"{name}: is not a PLY file (it does not begin with 'ply')")
    head = data[:MAX_HEADER_BYTES]
    found = head.find(b"end_header")
    newline = head.find(b"\n", found)
    if found < 0 or newline < 0:
        raise ValueError(f"{name}: the PLY header has no end_header in its first {MAX_HEADER_BYTES} bytes")
    header = _Header("", end=newline + 1)
    for line in head[:found].decode("ascii", "replace").splitlines()[1:]:
        match line.split():
            case ["format", ("ascii" | "binary_little_endian" | "binary_big_endian") as encoding, _]:
                header.encoding = encoding
            case ["comment", *_]:
                header.comments.append(line[len("comment") :].strip())
            case ["obj_info", *_] | []:
                continue
            case ["element", element, rows] if rows.isdigit():
                if int(rows) > MAX_ROWS or len(header.elements) == MAX_ELEMENTS:
                    raise ValueError(
                        f"{name}: element '{element}' with {rows} rows is beyond the limit of {MAX_ROWS} rows or {MAX_ELEMENTS} elements"
                    )
                header.elements.append((element, int(rows), []))
            case ["property", "list", count_type, value_type, column] if count_type in _TYPES and value_type in _TYPES and header.elements:
                header.elements[-1][2].append(_Property(column, _TYPES[value_type], _TYPES[count_type]))
            case ["property", value_type, column] if value_type in _TYPES and header.elements:
                header.elements[-1][2].append(_Property(column, _TYPES[value_type], None))
            case _:
                raise ValueError(f"{name}: PLY header line {line[:80]!r} is not understood")
    if not header.encoding:
        raise ValueError(f"{name}: the PLY header has no format line")
    for element, _, properties in header.elements:
        if len(properties) > MAX_PROPERTIES or len({p.name for p in properties}) < len(properties):
            raise ValueError(f"{name}: element '{element}' repeats a property or has more than {MAX_PROPERTIES}")
    return header


def _list_sizes(counts: np.ndarray, element: str, name: str) -> np.ndarray:
    if counts.size and (counts.min() < 0 or counts.astype(np.int64).sum() > 8 * MAX_ROWS):
        raise ValueError(f"{name}: a list in element '{element}' is negative in length or the lists are too long")
    return counts.astype(np.int64)


class _BinaryBody:
    """Reads elements one after the other from binary data."""

    def __init__(self, data: bytes, start: int, order: str, name: str):
        self.data, self.position, self.order, self.name = data, start, order, name

    def element(self, element: str, rows: int, properties: list[_Property]) -> PlyElement:
        if rows and any(p.count_dtype for p in properties):
            fixed = self._equal_lists(element, rows, properties)
            return fixed or self._ragged_lists(element, rows, properties)
        table = self._table(element, rows, [(p.name, self.order + p.dtype) for p in properties])
        return _element_from_table(table, properties)

    def _table(self, element: str, rows: int, dtype: list) -> np.ndarray:
        kind = np.dtype(dtype)
        needed, left = rows * kind.itemsize, len(self.data) - self.position
        if needed > left:
            raise ValueError(f"{self.name}: is truncated: element '{element}' needs {needed} bytes, {left} are left")
        table = np.frombuffer(self.data, kind, rows, self.position)
        self.position += needed
        return table

    def _equal_lists(self, element: str, rows: int, properties: list[_Property]) -> PlyElement | None:
        """All rows have lists as long as the first row's (a triangle mesh): one structured read. None if they do not."""
        start = self.position
        dtype: list[tuple] = []
        for p in properties:
            if p.count_dtype:
                first = self._table(element, 1, [*dtype, ("count of " + p.name, self.order + p.count_dtype)])
                self.position = start
                length = int(_list_sizes(first["count of " + p.name], element, self.name)[0])
                dtype += [("count of " + p.name, self.order + p.count_dtype), (p.name, self.order + p.dtype, (length,))]
            else:
                dtype.append((p.name, self.order + p.dtype))
        if rows * np.dtype(dtype).itemsize > len(self.data) - start:
            return None
        table = self._table(element, rows, dtype)
        if any((table["count of " + p.name] != table[p.name].shape[1]).any() for p in properties if p.count_dtype):
            self.position = start
            return None
        return _element_from_table(table, properties)

    def _ragged_lists(self, element: str, rows: int, properties: list[_Property]) -> PlyElement:
        scalars: dict[str, list] = {p.name: [] for p in properties if not p.count_dtype}
        lists: dict[str, list] = {p.name: [] for p in properties if p.count_dtype}
        for _ in range(rows):
            for p in properties:
                if p.count_dtype:
                    count = _list_sizes(self._table(element, 1, [("n", self.order + p.count_dtype)])["n"], element, self.name)[0]
                    lists[p.name].append(self._table(element, int(count), [("v", self.order + p.dtype)])["v"])
                else:
                    scalars[p.name].append(self._table(element, 1, [("v", self.order + p.dtype)])["v"][0])
        types = {p.name: p.dtype for p in properties}
        return PlyElement(
            rows,
            {key: np.asarray(values, types[key]) for key, values in scalars.items()},
            {key: PlyList(np.array([len(v) for v in values]), np.concatenate(values).astype(types[key])) for key, values in lists.items()},
        )


class _AsciiBody:
    """Reads elements one after the other from text."""

    def __init__(self, data: bytes, name: str):
        self.words, self.position, self.name = data.split(), 0, name

    def element(self, element: str, rows: int, properties: list[_Property]) -> PlyElement:
        if not any(p.count_dtype for p in properties):
            words = np.array(self._take(rows * len(properties), element)).reshape(rows, len(properties))
            return PlyElement(rows, {p.name: self._numbers(words[:, k], p.dtype, element) for k, p in enumerate(properties)}, {})
        scalars: dict[str, list] = {p.name: [] for p in properties if not p.count_dtype}
        counts: dict[str, list] = {p.name: [] for p in properties if p.count_dtype}
        values: dict[str, list] = {p.name: [] for p in properties if p.count_dtype}
        for _ in range(rows):
            for p in properties:
                word = self._take(1, element)
                if p.count_dtype:
                    if not word[0].isdigit():
                        raise ValueError(f"{self.name}: {word[0][:20]!r} is not the length of a list in element '{element}'")
                    counts[p.name].append(int(word[0]))
                    values[p.name] += self._take(int(word[0]), element)
                else:
                    scalars[p.name] += word
        types = {p.name: p.dtype for p in properties}
        lists = {key: PlyList(np.array(counts[key], np.int64), self._numbers(values[key], types[key], element)) for key in counts}
        return PlyElement(rows, {key: self._numbers(words, types[key], element) for key, words in scalars.items()}, lists)

    def _take(self, count: int, element: str) -> list[bytes]:
        if self.position + count > len(self.words):
            raise ValueError(
                f"{self.name}: is truncated: element '{element}' ends after {len(self.words) - self.position} of {count} numbers"
            )
        taken = self.words[self.position : self.position + count]
        self.position += count
        return taken

    def _numbers(self, words: "np.ndarray | list[bytes]", dtype: str, element: str) -> np.ndarray:
        try:
            return np.asarray(words, dtype="S").astype("f8" if dtype.startswith("f") else "i8").astype(dtype)
        except ValueError as error:
            raise ValueError(f"{self.name}: element '{element}' holds something that is no number ({error})") from error


def _element_from_table(table: np.ndarray, properties: list[_Property]) -> PlyElement:
    """Columns in native byte order; each its own contiguous copy."""
    scalars = {p.name: table[p.name].astype(p.dtype) for p in properties if not p.count_dtype}
    lists = {
        p.name: PlyList(table["count of " + p.name].astype(np.int64), table[p.name].astype(p.dtype).reshape(-1))
        for p in properties
        if p.count_dtype
    }
    return PlyElement(len(table), scalars, lists)
