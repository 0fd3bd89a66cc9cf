"""An asset's folder, or the same zipped, as plain arrays for Blender. It knows no Blender, so that the suite reads assets with it, too.

The readers in `exchange` are drgs' own: blender/build.py puts them into the extension. Blender's BRDF is not ours, so vertices get the base
colour that sends back as much light as their albedo does (drgs/convert/gltf_reflectance.py). Harmonics are fitted from where photographs were taken,
never from behind, so splats get the mean of their front. build.py writes both as tables, since Blender has no torch.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from .exchange.gaussian_ply import decode_gaussian_ply
from .exchange.glb import decode_glb
from .exchange.package import read_package

NEWEST_SCHEMA = 1
"""Of assets that this extension reads; a newer one is refused."""
TABLE = Path(__file__).with_name("base_colors.npy")
"""(roughness, metallic, albedo) -> base colour, float32; each axis evenly from 0 to 1."""
LOBES = Path(__file__).with_name("lobes.npy")
"""(normal, 3 + 16): a unit normal, and the mean of each harmonic over the views that see a disc with it."""
_FILES = ("mesh.glb", "environment.exr", "cameras.json", "gaussians.ply")
_SH_OFFSET = 0.5
"""Radiance of a splat whose harmonics are all 0."""
_AT_ONCE = 4096
"""Splats whose normals are compared with the table's at a time: 8 MB."""


@dataclass(frozen=True, eq=False)
class Splats:
    """2D Gaussians: a disc each, whose third axis is the normal."""

    centers: np.ndarray
    """(splat, 3) [world units]."""
    quats_wxyz: np.ndarray
    """(splat, 4), of unit length."""
    scales: np.ndarray
    """(splat, 2) standard deviations [world units]."""
    opacities: np.ndarray
    """(splat,) in 0..1."""
    radiance: np.ndarray
    """(splat, 3) linear, under the light of the capture; the mean over views of the front."""


@dataclass(frozen=True, eq=False)
class CameraView:
    """One of the photographs' cameras."""

    name: str
    world_from_camera: np.ndarray
    """(4, 4); looks along -z with y up, as OpenGL's and Blender's do [world units]."""
    intrinsics: np.ndarray
    """(3, 3) [pixels; centres at + 0.5]."""
    width: int
    height: int


@dataclass(frozen=True, eq=False)
class BlenderAsset:
    """What Blender is given; world right-handed, z up."""

    name: str
    meters_per_unit: float
    light_turns: bool
    """Whether the light stood still with the camera while the object turned; then it is that of the first camera."""
    vertices: np.ndarray
    """(vertex, 3) float32 [world units]."""
    normals: np.ndarray
    """(vertex, 3) unit shading normals."""
    faces: np.ndarray
    """(face, 3) int32."""
    base_color: np.ndarray
    """(vertex, 3) linear, for a Principled BSDF."""
    roughness: np.ndarray
    """(vertex,) GGX alpha is its square, as Blender's is."""
    metallic: np.ndarray
    """(vertex,) in 0..1."""
    environment_exr: bytes
    """Lat-long; its directions are those of Blender's world."""
    cameras: tuple[CameraView, ...]
    splats: Splats | None


def read_asset(path: Path) -> BlenderAsset:
    """
    Args:
        path: an asset's folder, the asset.json in it, or the folder zipped.

    Raises:
        ValueError: one sentence: no asset, a newer schema, an unsafe zip, or a missing, truncated or changed file.
    """
    path = path.parent if path.name == "asset.json" else path
    manifest, files = read_package(path, _FILES, _FILES[:3], NEWEST_SCHEMA)
    mesh = decode_glb(files["mesh.glb"], f"{path}: mesh.glb")
    names = ("POSITION", "NORMAL", "_ALBEDO", "_ROUGHNESS", "_METALLIC")
    missing = [name for name in names if name not in mesh.attributes]
    if missing:
        raise ValueError(f"{path}: mesh.glb lacks the vertex attribute {missing[0]}; expected a mesh that drgs wrote")
    vertices, normals, albedo, roughness, metallic = (mesh.attributes[name] for name in names)
    return BlenderAsset(
        path.stem,
        float(manifest.get("meters_per_unit", 1.0)),
        manifest.get("light_frame") == "camera",
        vertices,
        normals,
        mesh.faces,
        base_color_from_albedo(albedo, roughness, metallic),
        roughness,
        metallic,
        files["environment.exr"],
        _cameras(files["cameras.json"], path),
        _splats(files["gaussians.ply"], path) if "gaussians.ply" in files else None,
    )


def base_color_from_albedo(albedo: np.ndarray, roughness: np.ndarray, metallic: np.ndarray) -> np.ndarray:
    """(vertex, 3) of albedo (vertex, 3), roughness (vertex,), metallic (vertex,), all 0..1; linear between the table's entries."""
    table = np.load(TABLE, allow_pickle=False)
    parts = np.broadcast_arrays(roughness[:, None], metallic[:, None], albedo)
    places = [np.clip(part, 0, 1) * (size - 1) for part, size in zip(parts, table.shape, strict=True)]
    low = [np.minimum(place.astype(np.int32), size - 2) for place, size in zip(places, table.shape, strict=True)]
    total = np.zeros_like(albedo)
    for corner in np.ndindex(2, 2, 2):
        weights = [1 - abs(first + step - place) for first, step, place in zip(low, corner, places, strict=True)]
        total += np.prod(weights, axis=0) * table[tuple(first + step for first, step in zip(low, corner, strict=True))]
    return total


def _cameras(data: bytes, path: Path) -> tuple[CameraView, ...]:
    try:
        return tuple(
            CameraView(
                Path(str(frame["file_path"])).name,
                np.array(frame["transform_matrix"], float).reshape(4, 4),
                np.array(frame["intrinsics"], float).reshape(3, 3),
                int(frame["w"]),
                int(frame["h"]),
            )
            for frame in json.loads(data)["frames"]
        )
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path}: cameras.json is damaged ({error!r})") from error


def _splats(data: bytes, path: Path) -> Splats:
    found = decode_gaussian_ply(data, f"{path}: gaussians.ply")
    quats = found["quats_wxyz"] / np.maximum(np.linalg.norm(found["quats_wxyz"], axis=1, keepdims=True), 1e-12)
    radiance = _mean_radiance(found["sh"], _normals(quats))
    return Splats(found["centers"], quats, np.exp(found["log_scales"]), 1 / (1 + np.exp(-found["opacity_logits"])), radiance)


def _normals(quats_wxyz: np.ndarray) -> np.ndarray:
    """(splat, 3) third axes of the rotations."""
    w, x, y, z = quats_wxyz.T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], -1)


def _mean_radiance(sh: np.ndarray, normals: np.ndarray) -> np.ndarray:
    """(splat, 3) of harmonics (splat, 16, 3); the table's nearest normal stands for a splat's own."""
    table = np.load(LOBES, allow_pickle=False)
    starts = range(0, len(normals), _AT_ONCE)
    nearest = [np.argmax(normals[start : start + _AT_ONCE] @ table[:, :3].T, axis=1) for start in starts]
    means = table[np.concatenate(nearest), 3:] if nearest else np.zeros((0, sh.shape[1]))
    return np.maximum(np.einsum("nk,nkc->nc", means, sh) + _SH_OFFSET, 0).astype(np.float32)
