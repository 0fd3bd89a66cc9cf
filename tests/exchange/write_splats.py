"""GLB files with splats, right and wrong, for tests."""

import json
import struct
from collections.abc import Callable

import numpy as np

from drgs.exchange.glb import GlbMesh, encode_glb
from drgs.exchange.gltf_splats import ColorSpace, GltfSplats, points_from_splats

CORNERS = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3]], np.float32)
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


def flat_splats(count: int = 5, color_space: ColorSpace = "srgb_rec709_display", seed: int = 0) -> GltfSplats:
    """Anywhere within a metre, turned anyhow, with every harmonic."""
    random = np.random.default_rng(seed)
    quats = random.normal(size=(count, 4))
    scales = np.concatenate([random.uniform(0.01, 0.1, (count, 2)), np.full((count, 1), 1e-6)], -1)
    arrays = [random.uniform(-1, 1, (count, 3)), quats / np.linalg.norm(quats, axis=1, keepdims=True), scales]
    arrays += [random.uniform(0.05, 0.95, count), 0.1 * random.normal(size=(count, 16, 3))]
    materials = {"_ALBEDO": random.random((count, 3)), "_ROUGHNESS": random.random(count), "_METALLIC": random.random(count)}
    in_float32 = [np.ascontiguousarray(values, np.float32) for values in arrays]
    return GltfSplats(*in_float32, color_space, {name: values.astype(np.float32) for name, values in materials.items()})


def glb_with_splats(splats: GltfSplats | None = None, meters_per_unit: float = 1.0) -> bytes:
    """A tetrahedron with splats behind it."""
    return encode_glb(GlbMesh({"POSITION": CORNERS}, FACES), meters_per_unit, points_from_splats(splats or flat_splats()))


def document_of(data: bytes) -> dict:
    return json.loads(data[20 : 20 + struct.unpack_from("<I", data, 12)[0]])


def with_document(data: bytes, change: Callable[[dict], object]) -> bytes:
    """The same file after `change` has worked on its JSON."""
    document, rest = document_of(data), data[20 + struct.unpack_from("<I", data, 12)[0] :]
    change(document)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    return struct.pack("<5I", 0x46546C67, 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A) + text + rest


def splats_of(document: dict) -> dict:
    """The primitive that holds them."""
    return document["meshes"][-1]["primitives"][0]
