"""Gaussians in glTF by KHR_gaussian_splatting: points whose attributes are rotation, scales, opacity and the harmonics of their colour.

In and out: plain arrays as the file holds them: scales linear, opacities 0..1, unit quaternions x y z w, positions in the space of a node.
Materials, for which the extension has no names, stand beside them as attributes of ours, in 0..1: _ALBEDO (linear), _ROUGHNESS, _METALLIC.
Written: floats, all four degrees of harmonics, and COLOR_0 (their constant part in linear light, and the opacity, in 8 bits) for readers
that know points only. Read: all that the kernel "ellipse" allows, at every node that shows it. It does not know which way the world is up,
and that our Gaussians are flat.
Source: KHR_gaussian_splatting (docs/sources.md: khronos2026). We read no indexed points, of which the specification does not speak, and
bring rotations to unit length, which it demands: splat-transform writes them as a PLY held them.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np

from drgs.exchange.glb import GlbPoints
from drgs.exchange.gltf_accessors import GltfFile, numbers, open_gltf, whole
from drgs.maths.color_numpy import linear_from_srgb
from drgs.maths.spherical_harmonics import K00, SH_OFFSET

EXTENSION = "KHR_gaussian_splatting"
KERNEL = "ellipse"
ColorSpace = Literal["srgb_rec709_display", "lin_rec709_display"]
COLOR_SPACES: tuple[ColorSpace, ...] = get_args(ColorSpace)
MATERIALS = {"_ALBEDO": "VEC3", "_ROUGHNESS": "SCALAR", "_METALLIC": "SCALAR"}
"""Attributes of ours, and the types of their accessors."""
HIGHEST_DEGREE = 3
SHORTEST = 1e-6
"""Length of a quaternion that still says which way."""
_HEADER_BYTES = 20


@dataclass(frozen=True, eq=False)
class GltfSplats:
    """Gaussians of one primitive, float32."""

    centers: np.ndarray
    """(splat, 3)"""
    quats_xyzw: np.ndarray
    """(splat, 4) of unit length."""
    scales: np.ndarray
    """(splat, 3) standard deviations along the axes that the rotation turns; not negative."""
    opacities: np.ndarray
    """(splat,) 0..1."""
    sh: np.ndarray
    """(splat, 16, 3) harmonics of the colour less 0.5, in the basis of drgs/maths/spherical_harmonics; 0 of degrees that a file leaves out."""
    color_space: ColorSpace
    """Of the colours and of blending them."""
    materials: dict[str, np.ndarray] = field(default_factory=dict)
    """Those of MATERIALS that there are."""


@dataclass(frozen=True, eq=False)
class PlacedSplats:
    """Splats as a node shows them."""

    splats: GltfSplats
    gltf_from_splats: np.ndarray
    """(4, 4) float64."""


@dataclass(frozen=True)
class _Kind:
    """What the specification allows an attribute to be."""

    type: str
    components: tuple[tuple[int, bool], ...]
    """Component types, and whether they are normalised."""
    words: str


_ROTATION = _Kind("VEC4", ((5126, False), (5120, True), (5122, True)), "floats, or normalised signed bytes or shorts")
_SCALE = _Kind("VEC3", ((5126, False), (5121, False), (5121, True), (5123, False), (5123, True)), "floats, or unsigned bytes or shorts")
_OPACITY = _Kind("SCALAR", ((5126, False), (5121, True), (5123, True)), "floats, or normalised unsigned bytes or shorts")
_COEFFICIENT = _Kind("VEC3", ((5126, False),), "floats")


def points_from_splats(splats: GltfSplats) -> GlbPoints:
    """What a GLB holds of them; the extension's defaults are written out."""
    attributes = {"POSITION": splats.centers, "COLOR_0": _fallback_colors(splats)}
    attributes |= {_named("ROTATION"): splats.quats_xyzw, _named("SCALE"): splats.scales, _named("OPACITY"): splats.opacities}
    for degree in range(HIGHEST_DEGREE + 1):
        attributes |= {_coefficient(degree, n): splats.sh[:, degree * degree + n] for n in range(2 * degree + 1)}
    said = {"kernel": KERNEL, "colorSpace": splats.color_space, "projection": "perspective", "sortingMethod": "cameraDistance"}
    return GlbPoints("splats", attributes | splats.materials, {EXTENSION: said})


def read_gltf_splats(path: Path) -> list[PlacedSplats]:
    """Splats of a .glb, at every node of every scene that shows some; none where the file does not speak of the extension.

    Raises:
        ValueError: one sentence that names the file: damaged, or what the extension forbids, or with another kernel or colour space.
    """
    if not _speaks_of_splats(path):
        return []
    try:
        return list(_placed(open_gltf(path)))
    except (ValueError, OSError) as error:
        raise ValueError(f"{path}: {error}") from error
    except (KeyError, TypeError, AttributeError, IndexError, OverflowError) as error:
        raise ValueError(f"{path}: is not well-formed glTF ({type(error).__name__}: {str(error)[:80]})") from error


def _named(attribute: str) -> str:
    return f"{EXTENSION}:{attribute}"


def _coefficient(degree: int, n: int) -> str:
    return _named(f"SH_DEGREE_{degree}_COEF_{n}")


def _fallback_colors(splats: GltfSplats) -> np.ndarray:
    """(splat, 4) uint8 of COLOR_0, which is linear in glTF."""
    shown = np.clip(splats.sh[:, 0] * K00 + SH_OFFSET, 0, 1)
    linear = linear_from_srgb(shown) if splats.color_space == "srgb_rec709_display" else shown
    return np.rint(np.concatenate([linear, splats.opacities[:, None]], -1) * 255).astype(np.uint8)


def _speaks_of_splats(path: Path) -> bool:
    """Whether the name of the extension stands in a GLB's JSON: cheap, and files without it are none of our business."""
    with path.open("rb") as file:
        header = file.read(_HEADER_BYTES)
        return EXTENSION.encode() in file.read(int.from_bytes(header[12:16], "little"))


def _placed(file: GltfFile) -> Iterator[PlacedSplats]:
    for index, matrix in _placements(file):
        for primitive in file.item("meshes", index)["primitives"]:
            if EXTENSION in primitive.get("extensions", {}):
                yield PlacedSplats(_splats(file, primitive), matrix)


def _placements(file: GltfFile) -> Iterator[tuple[int, np.ndarray]]:
    """Index of the mesh, and (4, 4) gltf_from_mesh, of every node that has a mesh."""
    nodes = file.items("nodes")
    children = [[whole(child, len(nodes) - 1, "a node's child") for child in node.get("children", [])] for node in nodes]
    below = {child for family in children for child in family}
    left = [(root, np.eye(4)) for root in range(len(nodes)) if root not in below]
    seen: set[int] = set()
    while left:
        index, above = left.pop()
        if index in seen:
            raise ValueError(f"its node {index} has two parents")
        seen.add(index)
        with np.errstate(over="ignore", invalid="ignore"):
            gltf_from_node = above @ _matrix(nodes[index], f"of node {index}")
        if not np.isfinite(gltf_from_node).all():
            raise ValueError(f"the transform of its node {index} is not finite")
        if "mesh" in nodes[index]:
            yield whole(nodes[index]["mesh"], len(file.items("meshes")) - 1, "a node's mesh"), gltf_from_node
        left += [(child, gltf_from_node) for child in children[index]]


def _matrix(node: dict, of: str) -> np.ndarray:
    """(4, 4) of a node in its parent's space."""
    if "matrix" in node:
        return numbers(node["matrix"], 16, f"the matrix {of}").reshape(4, 4).T
    x, y, z, w = numbers(node.get("rotation", [0, 0, 0, 1]), 4, f"the rotation {of}")
    turn = np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip
    matrix = np.eye(4)
    matrix[:3, :3] = turn * numbers(node.get("scale", [1, 1, 1]), 3, f"the scale {of}")
    matrix[:3, 3] = numbers(node.get("translation", [0, 0, 0]), 3, f"the translation {of}")
    return matrix


def _splats(file: GltfFile, primitive: dict) -> GltfSplats:
    said, attributes = primitive["extensions"][EXTENSION], primitive["attributes"]
    _refuse_other_kinds(said, primitive)
    if "POSITION" not in attributes:
        raise ValueError("its splats have no POSITION")
    centers = file.accessor(attributes["POSITION"], ("VEC3",), "POSITION").astype(np.float32)
    count = len(centers)
    quats = _attribute(file, attributes, _named("ROTATION"), _ROTATION, count)
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    if (lengths < SHORTEST).any():
        raise ValueError(f"{int((lengths < SHORTEST).sum())} of its {count} splats have a rotation of length 0; expected unit quaternions")
    scales = _attribute(file, attributes, _named("SCALE"), _SCALE, count)
    if (scales < 0).any():
        raise ValueError(
            f"the scales of its splats fall to {scales.min():g}; expected linear ones from 0 on: drafts of the extension held "
            "logarithms, write the file anew with a newer program"
        )
    opacities = _attribute(file, attributes, _named("OPACITY"), _OPACITY, count)
    if ((opacities < 0) | (opacities > 1)).any():
        raise ValueError(f"the opacities of its splats are {opacities.min():g} to {opacities.max():g}; expected 0 to 1")
    materials = {
        name: file.accessor(attributes[name], (kind,), name).astype(np.float32) for name, kind in MATERIALS.items() if name in attributes
    }
    for name, values in materials.items():
        if len(values) != count:
            raise ValueError(f"its {name} is of {len(values)} splats; expected {count}, as in POSITION")
    sh = _harmonics(file, attributes, count)
    return GltfSplats(centers, quats / lengths, scales, opacities, sh, said["colorSpace"], materials)


def _refuse_other_kinds(said: dict, primitive: dict) -> None:
    packed = [str(name)[:60] for name in said.get("extensions", {}) if "compression" in name]
    if packed:
        raise ValueError(f"its splats are compressed by {packed[0]}, which this program does not read; export them without compression")
    for key, known in (("kernel", (KERNEL,)), ("colorSpace", COLOR_SPACES)):
        if said.get(key) not in known:
            raise ValueError(f"its splats have the {key} {str(said.get(key))[:40]!r}; expected {' or '.join(known)}")
    if primitive.get("mode", 4) != 0 or "indices" in primitive:
        drawn = "are indexed" if "indices" in primitive else f"have the mode {str(primitive.get('mode', 4))[:20]}"
        raise ValueError(f"its splats {drawn}; expected plain points (mode 0)")


def _attribute(file: GltfFile, attributes: dict[str, Any], name: str, kind: _Kind, count: int) -> np.ndarray:
    """(splat,) or (splat, k) float32."""
    if name not in attributes:
        raise ValueError(f"its splats have no {name}")
    accessor = file.item("accessors", attributes[name])
    found = accessor.get("componentType"), accessor.get("normalized", False)
    if found not in kind.components:
        written = f"the component type {str(found[0])[:20]}{', normalised' if found[1] is True else ''}"
        raise ValueError(f"its {name} has {written}; expected {kind.words}")
    values = file.accessor(attributes[name], (kind.type,), name).astype(np.float32)
    if len(values) != count:
        raise ValueError(f"its {name} is of {len(values)} splats; expected {count}, as in POSITION")
    return values


def _harmonics(file: GltfFile, attributes: dict[str, Any], count: int) -> np.ndarray:
    """(splat, 16, 3); whole degrees only, and none above one that is missing."""
    there = [[n for n in range(2 * degree + 1) if _coefficient(degree, n) in attributes] for degree in range(HIGHEST_DEGREE + 1)]
    highest = max((degree for degree, found in enumerate(there) if found), default=0)
    sh = np.zeros((count, (HIGHEST_DEGREE + 1) ** 2, 3), np.float32)
    for degree in range(highest + 1):
        wanted = 2 * degree + 1
        if len(there[degree]) != wanted:
            raise ValueError(
                f"its splats have {len(there[degree])} harmonics of degree {degree}, and some of degree {highest}; expected {wanted}"
            )
        for n in range(wanted):
            sh[:, degree * degree + n] = _attribute(file, attributes, _coefficient(degree, n), _COEFFICIENT, count)
    return sh
