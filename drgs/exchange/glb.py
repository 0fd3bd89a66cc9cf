"""Binary glTF with one triangle mesh, and points behind it if there are any: our own files, written and read bit for bit.

In and out: float32 vertex attributes by glTF name (POSITION, NORMAL, TEXCOORD_0, and _NAME for what glTF has no word for) and faces.
glTF is y up and in metres, we are z up and in world units: a matrix on the node turns and scales, the buffers stay as they are.
Points get a scene of their own, and the mesh keeps the scene that a file opens with. In one scene, a viewer that does not know the
points' extension would draw dots over the mesh, and one that knows it the object twice, each copy hiding parts of the other.
Other programs' files, with their scenes, textures and sparse accessors, are read by convert.import_mesh.
Source: glTF 2.0 specification, Khronos.
"""

import json
import struct
from dataclasses import dataclass, field
from typing import Any

import numpy as np

_MAGIC, _JSON, _BIN = 0x46546C67, 0x4E4F534A, 0x004E4942
_FLOAT, _UINT, _BYTE = 5126, 5125, 5121
_POINTS = 0
"""Mode of a primitive."""
_SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4"}
MAX_VERTICES = 20_000_000
VARIANTS = "KHR_materials_variants"


@dataclass(frozen=True, eq=False)
class GlbMesh:
    """One mesh as the file holds it."""

    attributes: dict[str, np.ndarray]
    """glTF attribute name -> (vertex,) or (vertex, k) float32."""
    faces: np.ndarray
    """(face, 3) int32."""
    material: dict = field(default_factory=dict)
    """glTF `pbrMetallicRoughness`; texture indices count `images`."""
    textures: dict = field(default_factory=dict)
    """What else the material reads: glTF `occlusionTexture`, `normalTexture`."""
    images: tuple[bytes, ...] = ()
    """PNG files."""
    name: str = "object"
    """Of the material; with variants, of the one that a file opens with."""
    variants: tuple["GlbVariant", ...] = ()
    """Other materials of the same mesh, by KHR_materials_variants."""


@dataclass(frozen=True)
class GlbVariant:
    """Another material."""

    name: str
    material: dict
    """As GlbMesh has it."""
    textures: dict


@dataclass(frozen=True, eq=False)
class GlbPoints:
    """Points in a scene of their own."""

    name: str
    """Of the scene, the node and the mesh."""
    attributes: dict[str, np.ndarray]
    """glTF attribute name -> (point,) or (point, k) float32, or (point, 4) uint8 that stands for 0..1."""
    extensions: dict[str, dict]
    """Of the primitive. The file says that it uses them, not that a reader needs them."""


def encode_glb(mesh: GlbMesh, meters_per_unit: float = 1.0, points: GlbPoints | None = None) -> bytes:
    """Bytes of a .glb; an array that stands under two names is stored once."""
    views: list[dict] = []
    accessors: list[dict] = []
    chunks: list[bytes] = []
    stored: dict[int, int] = {}

    def add_view(data: bytes, **keys: int) -> int:
        views.append({"buffer": 0, "byteOffset": sum(map(len, chunks)), "byteLength": len(data), **keys})
        chunks.append(data + b"\0" * (-len(data) % 4))
        return len(views) - 1

    def add_attribute(name: str, values: np.ndarray) -> int:
        if id(values) not in stored:
            stored[id(values)] = len(accessors)
            fractions = values.dtype == np.uint8
            array = np.ascontiguousarray(values, np.uint8 if fractions else np.float32)
            shape = _SHAPES[1 if array.ndim == 1 else array.shape[1]]
            accessor: dict[str, Any] = {
                "bufferView": add_view(array.tobytes(), target=34962),
                "componentType": _BYTE if fractions else _FLOAT,
            }
            accessor |= {"count": len(array), "type": shape}
            if fractions:
                accessor["normalized"] = True
            if name == "POSITION":
                accessor |= {"min": array.min(0).tolist(), "max": array.max(0).tolist()}
            accessors.append(accessor)
        return stored[id(values)]

    attributes = {name: add_attribute(name, values) for name, values in mesh.attributes.items()}
    index_view = add_view(np.ascontiguousarray(mesh.faces, "<u4").tobytes(), target=34963)
    accessors.append({"bufferView": index_view, "componentType": _UINT, "count": int(mesh.faces.size), "type": "SCALAR"})
    s = meters_per_unit
    # Columns of (x, y, z) -> s (x, z, -y): z up to y up, world units to metres.
    matrix = [s, 0, 0, 0, 0, 0, -s, 0, 0, s, 0, 0, 0, 0, 0, 1]
    worn = (GlbVariant(mesh.name, mesh.material, mesh.textures), *mesh.variants)
    document: dict[str, Any] = {
        "asset": {"version": "2.0", "generator": "drgs"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"name": "object", "mesh": 0, "matrix": matrix}],
        "meshes": [{"primitives": [{"attributes": attributes, "indices": len(accessors) - 1, "material": 0}]}],
        "materials": [{"name": one.name, "pbrMetallicRoughness": one.material, **one.textures, "doubleSided": False} for one in worn],
        "accessors": accessors,
    }
    if mesh.variants:
        names = [{"name": one.name} for one in worn]
        document |= {"extensionsUsed": [VARIANTS], "extensions": {VARIANTS: {"variants": names}}}
        mappings = [{"material": k, "variants": [k]} for k in range(len(names))]
        document["meshes"][0]["primitives"][0]["extensions"] = {VARIANTS: {"mappings": mappings}}
    if points is not None:
        named = {key: add_attribute(key, values) for key, values in points.attributes.items()}
        document["extensionsUsed"] = sorted({*document.get("extensionsUsed", ()), *points.extensions})
        document["scenes"] = [{"name": "mesh", "nodes": [0]}, {"name": points.name, "nodes": [1]}]
        document["nodes"].append({"name": points.name, "mesh": 1, "matrix": matrix})
        primitive = {"mode": _POINTS, "attributes": named, "extensions": points.extensions}
        document["meshes"].append({"name": points.name, "primitives": [primitive]})
    if mesh.images:
        document["images"] = [{"bufferView": add_view(image), "mimeType": "image/png"} for image in mesh.images]
        document["samplers"] = [{"magFilter": 9729, "minFilter": 9987, "wrapS": 33071, "wrapT": 33071}]
        document["textures"] = [{"source": k, "sampler": 0} for k in range(len(mesh.images))]
    binary = b"".join(chunks)
    document |= {"bufferViews": views, "buffers": [{"byteLength": len(binary)}]}
    text = json.dumps(document, allow_nan=False, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 4)
    total = 12 + 8 + len(text) + 8 + len(binary)
    return b"".join([struct.pack("<5I", _MAGIC, 2, total, len(text), _JSON), text, struct.pack("<2I", len(binary), _BIN), binary])


def decode_glb(data: bytes, name: str = "GLB") -> GlbMesh:
    """The mesh of a file that `encode_glb` wrote (neither images, points nor variants are read back).

    Raises:
        ValueError: not such a file, or damaged.
    """
    try:
        magic, version, total, text_length, text_kind = struct.unpack_from("<5I", data)
        if magic != _MAGIC or version != 2 or text_kind != _JSON or total != len(data):
            raise ValueError("wrong magic, version or length")
        document = json.loads(data[20 : 20 + text_length])
        binary_length, binary_kind = struct.unpack_from("<2I", data, 20 + text_length)
        binary = memoryview(data)[28 + text_length : 28 + text_length + binary_length]
        if binary_kind != _BIN or len(binary) != binary_length:
            raise ValueError("no binary chunk")
        (primitive,) = document["meshes"][0]["primitives"]
        read = {key: _accessor(document, binary, index) for key, index in primitive["attributes"].items()}
        indices = _accessor(document, binary, primitive["indices"])
        material = document["materials"][primitive["material"]]["pbrMetallicRoughness"]
        if indices.dtype != np.uint32 or indices.ndim != 1 or indices.size % 3:
            raise ValueError("indices are not triangles")
    except (KeyError, IndexError, TypeError, ValueError, OverflowError, RecursionError, struct.error) as error:
        raise ValueError(f"{name}: is not a mesh that drgs wrote, or is damaged ({error})") from error
    return GlbMesh(read, indices.astype(np.int32).reshape(-1, 3), material)


def _accessor(document: dict, binary: memoryview, index: int) -> np.ndarray:
    accessor = document["accessors"][index]
    view = document["bufferViews"][accessor["bufferView"]]
    width = {shape: k for k, shape in _SHAPES.items()}[accessor["type"]]
    dtype = {_FLOAT: np.float32, _UINT: np.uint32}[accessor["componentType"]]
    count, start, length = int(accessor["count"]), int(view.get("byteOffset", 0)), int(view["byteLength"])
    if not 0 <= count <= 3 * MAX_VERTICES or start < 0 or count * width * 4 > length or start + length > len(binary):
        raise ValueError("an accessor reaches beyond the file")
    values = np.frombuffer(binary, dtype, count * width, start).copy()
    return values if width == 1 else values.reshape(count, width)
