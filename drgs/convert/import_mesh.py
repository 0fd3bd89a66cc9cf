"""A mesh of another program becomes an asset, without training: GLB, OBJ, or PLY with float vertex properties.

PLY: albedo_r/g/b (linear), roughness, metallic, else red/green/blue (8-bit sRGB); GLB: metallic-roughness factors and textures,
sampled at the vertices, or our own _ALBEDO, _ROUGHNESS, _METALLIC; OBJ: diffuse colour and map of its MTL, in UTF-8 or Latin-1.
What a file does not say is albedo 0.5, roughness 0.5, metallic 0. Normals come from the file where it has them. GLB is y up by
definition and is turned to z up; PLY and OBJ coordinates are taken as they are. Textures are read only from inside the GLB or beside
the OBJ. Splats of a GLB become Gaussians that are bound to the mesh (import_splats).
"""

import io
import json
import re
import struct
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Float, Int, Shaped
from numpy import ndarray
from PIL import Image
from torch import Tensor
from trimesh.visual.material import PBRMaterial, SimpleMaterial

from drgs.convert.gltf_reflectance import BASE_COLOR_MARK, albedo_from_gltf
from drgs.convert.import_splats import import_splats
from drgs.convert.sample_textures import Textures
from drgs.exchange.gltf_accessors import open_gltf
from drgs.exchange.ply import parse_ply, triangles_from_faces
from drgs.maths.color import linear_from_srgb
from drgs.maths.unique_rows import unique_rows
from drgs.reconstruct.geometry.bind_gaussians import bind_gaussians
from drgs.scene.asset import Asset
from drgs.scene.environment import Environment
from drgs.scene.materials import DEFAULT_ALBEDO, DEFAULT_METALLIC, DEFAULT_ROUGHNESS
from drgs.scene.mesh import TriangleMesh, refuse_unusable, vertex_normals

MAX_BYTES = 2 << 30
MAX_VERTICES = 20_000_000
ENVIRONMENT_HEIGHT = 16
"""Of the constant light an imported mesh gets; any size says the same."""
_CORNER_ZERO = re.compile(rb"^f[ \t](?:.*?[ \t])?0+(?=[/ \t\r]|$)", re.MULTILINE)
_TRIANGLE_FAN = 6
"""Mode of a glTF primitive."""


@dataclass
class _Part:
    """One mesh of a file, in numpy, z up."""

    vertices: Float[ndarray, "vertex 3"]
    faces: Int[ndarray, "face 3"]
    normals: Float[ndarray, "vertex 3"] | None
    albedo: Float[ndarray, "vertex 3"]
    roughness: Float[ndarray, "vertex"]
    metallic: Float[ndarray, "vertex"]


def import_mesh(path: Path | str) -> Asset:
    """Asset with this mesh and a constant light of 1; Gaussians where a GLB holds splats. Cameras see the mesh in any case.

    Raises:
        ValueError: one sentence: unknown format, damaged, no triangles, or a value that is not finite or out of range.
    """
    path = Path(path)
    readers = {".ply": _read_ply, ".glb": _read_glb, ".obj": _read_obj}
    if path.suffix.lower() not in readers:
        raise ValueError(f"{path}: is no mesh this reads; expected .glb, .obj or .ply")
    if not path.is_file():
        raise ValueError(f"{path}: does not exist")
    if path.stat().st_size > MAX_BYTES:
        raise ValueError(f"{path}: has {path.stat().st_size} bytes; the limit is {MAX_BYTES}")
    parts = readers[path.suffix.lower()](path)
    gaussians = import_splats(path) if path.suffix.lower() == ".glb" else None
    if gaussians is not None and not parts:
        raise ValueError(f"{path}: holds {len(gaussians.centers)} splats and no triangles; an asset needs a mesh: export one with them")
    mesh = _mesh_from_parts(parts, str(path))
    binding = None if gaussians is None else bind_gaussians(gaussians.centers, mesh)
    environment = Environment(torch.ones(ENVIRONMENT_HEIGHT, 2 * ENVIRONMENT_HEIGHT, 3))
    provenance = {"source": {"kind": "import", "file": path.name}}
    return Asset(gaussians, mesh, binding, environment, provenance=provenance, primary=None if gaussians is None else "mesh")


def _mesh_from_parts(parts: list[_Part], name: str) -> TriangleMesh:
    if not parts:
        raise ValueError(f"{name}: holds no triangles")
    offsets = np.cumsum([0, *(len(part.vertices) for part in parts)])
    if offsets[-1] > MAX_VERTICES:
        raise ValueError(f"{name}: has {offsets[-1]} vertices; the limit is {MAX_VERTICES}")

    def joined(arrays: list[np.ndarray]) -> torch.Tensor:
        return torch.from_numpy(np.ascontiguousarray(np.concatenate(arrays), np.float32))

    vertices = joined([part.vertices for part in parts])
    faces = torch.from_numpy(np.concatenate([part.faces + offset for part, offset in zip(parts, offsets, strict=False)]).astype(np.int32))
    materials = {key: joined([getattr(part, key) for part in parts]) for key in ("albedo", "roughness", "metallic")}
    if not torch.isfinite(vertices).all():
        raise ValueError(f"{name}: holds {int((~torch.isfinite(vertices)).sum())} vertex coordinates that are not finite")
    for key, values in materials.items():
        if not (torch.isfinite(values).all() and values.min() >= -1e-4 and values.max() <= 1 + 1e-4):
            raise ValueError(f"{name}: {key} spans {values.min():g} to {values.max():g}; expected 0 to 1")
    computed = vertex_normals(vertices, faces)
    given = [
        computed[a:b].numpy() if part.normals is None else part.normals for part, a, b in zip(parts, offsets, offsets[1:], strict=False)
    ]
    normals = joined(given)
    length = normals.norm(dim=-1, keepdim=True)
    unit = torch.where((length - 1).abs() < 1e-4, normals, normals / length)  # keeps a file's own bits
    normals = torch.where(torch.isfinite(unit).all(-1, keepdim=True), unit, computed)
    normals = torch.where(normals.norm(dim=-1, keepdim=True) > 0.5, normals, torch.tensor([0.0, 0.0, 1.0]))  # vertices of no face
    corners = vertices[faces.long()]
    face_normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    agreement = (face_normals * normals[faces.long()].sum(1)).sum(-1)
    if (agreement < 0).sum() > (agreement > 0).sum():  # wound clockwise, yet with outward normals
        faces = faces[:, [0, 2, 1]].contiguous()
    doubled = _faces_on_faces_turned_over(vertices, faces)
    if doubled:
        warnings.warn(
            f"{name}: {doubled} triangles lie on others that face the other way; a ray meets either one, and a back is black: "
            "give such sheets a thickness or keep one side",
            stacklevel=3,
        )
    albedo, roughness, metallic = (materials[name].clamp(0, 1) for name in ("albedo", "roughness", "metallic"))
    mesh = TriangleMesh(vertices, faces, normals, albedo, roughness, metallic)
    refuse_unusable(mesh, name)
    return mesh


def _faces_on_faces_turned_over(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> int:
    """Number of triangles whose corners lie where those of another triangle do that faces the other way."""
    corners = vertices[faces.long()].double()
    low, middle = corners.amin(1), corners.sum(1)  # the same in any order of the corners: sums of three float32 are exact
    normals = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    order = torch.from_numpy(np.lexsort([*middle.T.numpy(), *low.T.numpy()]))
    low, middle, normals = low[order], middle[order], normals[order]
    same = (low[1:] == low[:-1]).all(-1) & (middle[1:] == middle[:-1]).all(-1)
    return int((same & ((normals[1:] * normals[:-1]).sum(-1) < 0)).sum())


def _read_ply(path: Path) -> list[_Part]:
    ply = parse_ply(path.read_bytes(), str(path))
    vertex = ply.elements.get("vertex")
    if vertex is None or not {"x", "y", "z"} <= set(vertex.scalars):
        raise ValueError(f"{path}: has no vertices with x, y, z")
    found = vertex.scalars

    def columns(names: list[str]) -> Shaped[ndarray, "vertex column"] | None:
        return np.stack([found[key] for key in names], -1) if set(names) <= set(found) else None

    def constant(key: str, value: float) -> Float[ndarray, "vertex"]:
        return found[key] if key in found else np.full(vertex.rows, value, np.float32)

    vertices = np.stack([found[key] for key in "xyz"], -1)
    albedo = columns(["albedo_r", "albedo_g", "albedo_b"])
    colors = columns(["red", "green", "blue"])
    if albedo is None and colors is not None:
        albedo = _linear(colors / 255 if colors.dtype == np.uint8 else colors)
    if albedo is None:
        albedo = np.full((vertex.rows, 3), DEFAULT_ALBEDO, np.float32)
    normals = columns(["nx", "ny", "nz"])
    faces = triangles_from_faces(ply, vertex.rows, str(path))
    return [_Part(vertices, faces, normals, albedo, constant("roughness", DEFAULT_ROUGHNESS), constant("metallic", DEFAULT_METALLIC))]


def _read_glb(path: Path) -> list[_Part]:
    data, factors = _glb_with_numbered_materials(path)

    def load() -> trimesh.Scene:
        return trimesh.load_scene(trimesh.util.wrap_as_stream(data), file_type="glb", resolver=_BesideResolver(None), process=False)

    z_up_from_y_up = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
    return _parts_of(load, z_up_from_y_up, factors, path, "GLB")


def _read_obj(path: Path) -> list[_Part]:
    text, beside = _utf8(path.read_bytes()), _BesideResolver(path.parent)
    corner = _CORNER_ZERO.search(text)
    if corner is not None:
        raise ValueError(f"{path}: the face {corner[0][:60]!r} names vertex 0; vertices of an OBJ count from 1")

    def load() -> trimesh.Scene:
        stream = trimesh.util.wrap_as_stream(text)
        return trimesh.load_scene(stream, file_type="obj", resolver=beside, process=False, maintain_order=True)

    parts = _parts_of(load, np.eye(4), {}, path, "OBJ")
    if beside.unreadable:
        raise ValueError(f"{path}: its texture {beside.unreadable[0][:100]!r} is damaged, or no picture that is read here")
    return parts


def _parts_of(
    load: Callable[[], trimesh.Scene], root: Float[ndarray, "4 4"], factors: dict[str, dict], path: Path, kind: str
) -> list[_Part]:
    try:
        return _parts_from_scene(load(), root, factors, str(path))
    except MemoryError:
        raise
    except Exception as error:  # trimesh lets whatever a damaged file provokes escape
        if isinstance(error, ValueError) and str(error).startswith(str(path)):
            raise
        raise ValueError(f"{path}: is not a readable {kind} ({error!r})") from error


def _parts_from_scene(scene: trimesh.Scene, root: Float[ndarray, "4 4"], factors: dict[str, dict], name: str) -> list[_Part]:
    """Every triangle mesh under every node, moved to world space."""
    parts, textures = [], Textures(name)
    rank = {key: k for k, key in enumerate(scene.geometry)}
    for node in sorted(
        scene.graph.nodes_geometry, key=lambda node: (rank[scene.graph[node][1]], str(node))
    ):  # trimesh gives no fixed order
        matrix, key = scene.graph[node]
        mesh = scene.geometry[key]
        if not isinstance(mesh, trimesh.Trimesh) or len(mesh.faces) == 0:
            continue
        if mesh.faces.min() < 0 or mesh.faces.max() >= len(mesh.vertices):
            raise ValueError(f"{name}: a face names vertex {int(mesh.faces.max())}, but there are {len(mesh.vertices)} vertices")
        world_from_mesh = root @ matrix
        linear = world_from_mesh[:3, :3]
        normals = mesh._cache["vertex_normals"]  # None unless the file has them; the property would compute them
        albedo, roughness, metallic = _vertex_materials(mesh, factors, textures, name)
        faces = mesh.faces[:, ::-1] if np.linalg.det(linear) < 0 else mesh.faces
        part = _Part(mesh.vertices @ linear.T + world_from_mesh[:3, 3], faces, None, albedo, roughness, metallic)
        if normals is not None:
            turned = normals @ np.linalg.inv(linear)
            part.normals = turned / np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)
        parts.append(_join_seams(part) if getattr(mesh.visual, "uv", None) is not None else part)
    return parts


def _vertex_materials(
    mesh: trimesh.Trimesh, factors: dict[str, dict], textures: Textures, name: str
) -> tuple[Float[ndarray, "vertex 3"], Float[ndarray, "vertex"], Float[ndarray, "vertex"]]:
    count = len(mesh.vertices)
    own: Any = mesh.vertex_attributes
    visual: Any = mesh.visual
    if {"_ALBEDO", "_ROUGHNESS", "_METALLIC"} <= set(own):
        return own["_ALBEDO"].reshape(count, 3), own["_ROUGHNESS"].reshape(count), own["_METALLIC"].reshape(count)
    albedo = np.full((count, 3), DEFAULT_ALBEDO)
    roughness, metallic = np.full(count, DEFAULT_ROUGHNESS), np.full(count, DEFAULT_METALLIC)
    material, uv = getattr(visual, "material", None), getattr(visual, "uv", None)
    if isinstance(material, PBRMaterial):
        exact = factors.get(str(material.name), {})
        albedo[:] = exact.get("baseColorFactor", [1.0, 1.0, 1.0, 1.0])[:3]
        roughness[:], metallic[:] = exact.get("roughnessFactor", 1.0), exact.get("metallicFactor", 1.0)
        # What the file names counts, not what trimesh found: it passes over a picture that it cannot open.
        if uv is not None and "baseColorTexture" in exact:
            albedo *= _linear(textures.sample(material.baseColorTexture, _texture_uv(uv, exact["baseColorTexture"], name)))
        if uv is not None and "metallicRoughnessTexture" in exact:
            texels = textures.sample(material.metallicRoughnessTexture, _texture_uv(uv, exact["metallicRoughnessTexture"], name))
            roughness, metallic = roughness * texels[:, 1], metallic * texels[:, 2]
        colors = visual.vertex_attributes.get("color")
        if colors is not None:
            scale = np.iinfo(colors.dtype).max if colors.dtype.kind == "u" else 1.0
            albedo *= np.asarray(colors, np.float64)[:, :3] / scale  # COLOR_0 is linear
        if exact.get("extras") == BASE_COLOR_MARK:
            albedo = albedo_from_gltf(*map(torch.from_numpy, (albedo, roughness, metallic))).numpy()
    elif isinstance(material, SimpleMaterial) and visual.defined:
        if uv is not None and material.image is not None:
            albedo = _linear(textures.sample(material.image, uv))
        elif material.diffuse is not None:
            albedo[:] = np.asarray(material.diffuse, np.float64)[:3] / 255
    elif visual.kind == "vertex":
        colors = np.asarray(visual.vertex_colors, np.float64)[:, :3] / 255
        albedo = colors if factors else _linear(colors)  # linear in glTF, as on the screen in OBJ
    return albedo, roughness, metallic


def _texture_uv(uv: Float[ndarray, "vertex 2"], use: object, name: str) -> Float[ndarray, "vertex 2"]:
    """Where a glTF material looks into one of its textures: KHR_texture_transform applied, v counting upwards as in `uv`.

    Raises:
        ValueError: a second set of coordinates, or a turned texture.
    """
    if not isinstance(use, dict):
        return uv
    transform = use.get("extensions", {}).get("KHR_texture_transform", {})
    if transform.get("texCoord", use.get("texCoord", 0)) != 0:
        raise ValueError(f"{name}: has a texture on its second set of texture coordinates; export it with one set")
    if transform.get("rotation", 0) != 0:
        raise ValueError(f"{name}: has a texture that is turned by KHR_texture_transform; export it with that applied")
    if not transform:
        return uv
    (scale_u, scale_v), (offset_u, offset_v) = transform.get("scale", (1, 1)), transform.get("offset", (0, 0))
    return np.stack([uv[:, 0] * scale_u + offset_u, 1 - ((1 - uv[:, 1]) * scale_v + offset_v)], -1)


def _join_seams(part: _Part) -> _Part:
    """Vertices that texture seams had doubled (same place, same normal) become one, with the mean material."""
    low, high = part.vertices.min(0), part.vertices.max(0)
    places = (part.vertices - low) / ((high - low).max() or 1.0)  # in sizes of the part, so that its unit does not matter
    keys = places if part.normals is None else np.concatenate([places, part.normals], -1)
    inverse = unique_rows(torch.from_numpy(np.round(keys.astype(np.float32), 6)))[1].numpy()
    first = np.unique(inverse, return_index=True)[1]
    order = np.argsort(first)  # keep the file's order
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    target, kept = rank[inverse.reshape(-1)], first[order]
    counts = np.bincount(target)

    def mean(values: Float[ndarray, "vertex *value"]) -> Float[ndarray, "kept *value"]:
        return np.stack([np.bincount(target, column) / counts for column in values.reshape(len(values), -1).T], -1).reshape(
            -1, *values.shape[1:]
        )

    normals = None if part.normals is None else part.normals[kept]
    return _Part(part.vertices[kept], target[part.faces], normals, mean(part.albedo), mean(part.roughness), mean(part.metallic))


def _glb_with_numbered_materials(path: Path) -> tuple[bytes, dict[str, dict]]:
    """The file with materials renamed 0, 1, ..., and their exact factors: trimesh keeps only 8 bits of them, and the name.

    Also the door: files that point outside themselves, or hold what trimesh would pass over in silence, are refused here; sparse accessors
    and normalised texture coordinates, which trimesh takes for zeros and for whole numbers, are written out.
    """
    data = path.read_bytes()
    try:
        magic, _, _, length, kind = struct.unpack_from("<5I", data)
        if magic != 0x46546C67 or kind != 0x4E4F534A or 20 + length > len(data):
            raise ValueError("wrong magic or length")
        document = json.loads(data[20 : 20 + length])
        materials = document.get("materials", [])
        factors = {str(k): dict(material.get("pbrMetallicRoughness", {})) for k, material in enumerate(materials)}
        outside = [entry["uri"] for key in ("buffers", "images") for entry in document.get(key, []) if "uri" in entry]
        needed = set(document.get("extensionsRequired", []))
        primitives = [primitive for mesh in document.get("meshes", []) for primitive in mesh.get("primitives", [])]
        fans = sum(primitive.get("mode") == _TRIANGLE_FAN for primitive in primitives)
        obscure = _obscure_accessors(document.get("accessors", []), primitives)
    except (struct.error, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise ValueError(f"{path}: is not a readable GLB ({error})") from error
    if any(not str(uri).startswith("data:") for uri in outside):
        raise ValueError(f"{path}: points to files outside itself; export it with everything embedded")
    undecodable = needed & {"KHR_draco_mesh_compression", "EXT_meshopt_compression", "KHR_mesh_quantization"}
    if undecodable:
        raise ValueError(f"{path}: is compressed with {min(undecodable)}, which this cannot read; export it without compression")
    if fans:
        raise ValueError(f"{path}: holds {fans} triangle fans, which are not read here; export it with plain triangles")
    rest = data[20 + length :]
    if obscure:
        try:
            document, binary = open_gltf(path).written_out(obscure)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from error
        rest = struct.pack("<2I", len(binary), 0x004E4942) + binary
    for k, material in enumerate(document.get("materials", [])):
        material["name"] = str(k)
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    head = struct.pack("<5I", 0x46546C67, 2, 20 + len(text) + len(rest), len(text), 0x4E4F534A)
    return head + text + rest, factors or {"none": {}}


def _obscure_accessors(accessors: list[dict], primitives: list[dict]) -> set[int]:
    """Those that trimesh reads wrongly."""
    named = {index for primitive in primitives for name, index in primitive["attributes"].items() if not name.startswith("COLOR_")}
    return {
        index for index, accessor in enumerate(accessors) if "sparse" in accessor or (index in named and accessor.get("normalized") is True)
    }


def _utf8(text: bytes) -> bytes:
    """Old programs write names in Latin-1, in which any bytes have a meaning; trimesh would ask a package for it that is not installed."""
    try:
        text.decode()
    except UnicodeDecodeError:
        return text.decode("latin-1").encode()
    return text


def _linear(srgb: Float[ndarray, "*shape"]) -> Float[ndarray, "*shape"]:
    return linear_from_srgb(torch.from_numpy(np.ascontiguousarray(srgb, np.float64))).numpy()


class _BesideResolver(trimesh.resolvers.Resolver):
    """Gives trimesh the files that lie right beside a mesh, by plain name, and no others."""

    def __init__(self, folder: Path | None):
        self.folder = folder
        self.unreadable: list[str] = []
        """Pictures that trimesh will pass over in silence."""

    def get(self, key: str) -> bytes:
        file = Path(key.strip())
        if self.folder is None or file.name != str(file) or not (self.folder / file).is_file():
            raise ValueError(f"{key!r} is not a file beside the mesh")
        data = (self.folder / file).read_bytes()
        if file.suffix.lower() == ".mtl":
            return _utf8(data)
        try:
            Image.open(io.BytesIO(data))
        except Exception:  # whatever a damaged picture provokes; the reader says so
            self.unreadable.append(key.strip())
        return data

    def write(self, name: str, data: bytes) -> None:
        raise ValueError("a mesh is read here, not written")

    def namespaced(self, namespace: str) -> "_BesideResolver":
        return self

    def keys(self) -> list[str]:
        return [] if self.folder is None else [entry.name for entry in self.folder.iterdir()]
