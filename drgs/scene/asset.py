"""An asset: the relightable object at rest, and what it was made from; a folder or zip on disk (design: Asset)."""

import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Literal, get_args

import numpy as np
import safetensors.numpy
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from drgs.exchange.exr import decode_environment, encode_environment
from drgs.exchange.gaussian_ply import decode_gaussian_ply, encode_gaussian_ply
from drgs.exchange.glb import GlbMesh, decode_glb, encode_glb
from drgs.exchange.package import read_package, write_package
from drgs.exchange.photographs import PHOTOGRAPHS
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.scene.albedo_detail import MOST_PARTS, AlbedoDetail, parts_of
from drgs.scene.binding import Binding
from drgs.scene.camera import Camera, opengl_from_camera
from drgs.scene.certainty import Certainty
from drgs.scene.edits import LARGEST, SMALLEST, Edit, EnvironmentEdit
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PRIMARY_SURFACES, PrimarySurface

LightFrame = Literal["object", "camera"]
LIGHT_FRAMES: tuple[LightFrame, ...] = get_args(LightFrame)
SCHEMA_VERSION = 1
"""Of the asset folder; a reader refuses a larger one."""

CONVENTIONS = {
    "world": "right-handed, z up",
    "mesh": "vertex buffers are z up, in world units; the node's matrix turns them to glTF's y up and metres",
    "cameras": "transform_matrix is OpenGL camera-to-world; camera_from_world is OpenCV; pixel centres at +0.5",
    "quaternions": "wxyz",
    "colour": "linear Rec.709",
    "environment": "lat-long; texel (u, v) holds radiance from d with u = 0.5 - atan2(d_y, d_x) / 2 pi, v = acos(d_z) / pi",
    "brdf": "metallic-roughness, GGX with alpha = roughness^2",
}
_FILES = (
    "gaussians.ply",
    "mesh.glb",
    "binding.safetensors",
    "environment.exr",
    "cameras.json",
    "horizons.safetensors",
    "certainty.safetensors",
    "detail.safetensors",
)
_REQUIRED = ("mesh.glb", "environment.exr", "cameras.json")
THUMBNAIL = "thumb.jpg"


@dataclass(frozen=True, eq=False)
class Asset:
    """Everything a renderer or an editor needs. Written by pack_asset, read by everything."""

    gaussians: Gaussians | None
    """None for an asset imported from a mesh: primary visibility is then the mesh."""
    mesh: TriangleMesh
    binding: Binding | None
    environment: Environment
    """The recovered light of the capture (a constant 1 for imported meshes)."""
    cameras: tuple[Camera, ...] = ()
    """Training cameras."""
    meters_per_unit: float = 1.0
    provenance: dict = field(default_factory=dict)
    """Plain JSON: source, preset, seed, versions, seconds per stage, quality."""
    horizons: UInt8[Tensor, "face 8"] | None = None
    """How high the mesh rises around each of its faces (drgs.render.intersect.horizon.stored_horizons); None: found out while rendering."""
    primary: PrimarySurface | None = None
    """What cameras see unless they are told otherwise; None: the Gaussians where there are some."""
    certainty: Certainty | None = None
    """What the photographs say of each vertex of the mesh, and what is a guess; None: nobody looked (imported meshes, older assets)."""
    light_frame: LightFrame = "object"
    """What the light of the photographs stood still with. camera: on a turntable; then `environment` is that of the first training camera."""


def save_asset(asset: Asset, path: Path | str, thumbnail_jpeg: bytes | None = None, photographs_zip: bytes | None = None) -> None:
    """Write a folder, or a zip if the path ends in .zip, atomically; float32 arrays are kept bit for bit.

    Args:
        photographs_zip: small copies of what the training cameras saw (exchange/photographs.py). They are no part of `Asset`: only
            people look at them.

    Raises:
        ValueError: a value is not finite, an index points nowhere, or the path is taken by something that is no asset.
    """
    _check(asset, "the asset")
    mesh = asset.mesh
    files: dict[str, bytes] = {}
    if asset.gaussians is not None:
        normals = rotation_from_quat_wxyz(asset.gaussians.quats_wxyz)[..., 2]
        note = "spherical harmonics: linear radiance under the light of environment.exr"
        files["gaussians.ply"] = encode_gaussian_ply(_arrays(asset.gaussians), _array(normals), comments=(note,))
    albedo, roughness, metallic = _array(mesh.albedo), _array(mesh.roughness), _array(mesh.metallic)
    # COLOR_0 is the albedo again (one buffer), so that any glTF viewer shows the colours.
    attributes = {"POSITION": _array(mesh.vertices), "NORMAL": _array(mesh.normals), "COLOR_0": albedo}
    attributes |= {"_ALBEDO": albedo, "_ROUGHNESS": roughness, "_METALLIC": metallic}
    means = {"roughnessFactor": min(max(float(roughness.mean()), 0), 1), "metallicFactor": min(max(float(metallic.mean()), 0), 1)}
    files["mesh.glb"] = encode_glb(GlbMesh(attributes, _array(mesh.faces), means), asset.meters_per_unit)
    if asset.binding is not None:
        files["binding.safetensors"] = safetensors.numpy.save(_arrays(asset.binding))
    if asset.horizons is not None:
        files["horizons.safetensors"] = safetensors.numpy.save({"sine": _array(asset.horizons)})
    if asset.certainty is not None:
        files["certainty.safetensors"] = safetensors.numpy.save(_arrays(asset.certainty))
    if mesh.detail is not None:
        share = {} if mesh.detail.share is None else {"share": _array(mesh.detail.share)}
        files["detail.safetensors"] = safetensors.numpy.save({"codes": _array(mesh.detail.codes)} | share)
    files["environment.exr"] = encode_environment(_array(asset.environment.radiance))
    files["cameras.json"] = json.dumps({"camera_model": "PINHOLE", "frames": [_camera_json(c) for c in asset.cameras]}, indent=1).encode()
    if thumbnail_jpeg is not None:
        files[THUMBNAIL] = thumbnail_jpeg
    if photographs_zip is not None:
        files[PHOTOGRAPHS] = photographs_zip
    surfels = 0 if asset.gaussians is None else len(asset.gaussians.centers)
    manifest = {
        "format": "drgs asset",
        "schema_version": SCHEMA_VERSION,
        "meters_per_unit": asset.meters_per_unit,
        "conventions": CONVENTIONS,
        **({} if asset.primary is None else {"primary": asset.primary}),
        **({} if asset.light_frame == "object" else {"light_frame": asset.light_frame}),
        "counts": {"surfels": surfels, "vertices": len(mesh.vertices), "faces": len(mesh.faces), "cameras": len(asset.cameras)},
        "provenance": asset.provenance,
    }
    write_package(Path(path), manifest, files)


def load_asset(path: Path | str, device: torch.device | str = "cpu") -> Asset:
    """Read what `save_asset` wrote.

    Raises:
        ValueError: one sentence: no asset, a newer schema, an unsafe zip, or a missing, truncated, changed or non-finite file.
    """
    path = Path(path)
    manifest, files = read_package(path, _FILES, _REQUIRED, SCHEMA_VERSION)
    gaussians = binding = None
    if "gaussians.ply" in files:
        arrays = decode_gaussian_ply(files["gaussians.ply"], f"{path}: gaussians.ply")
        gaussians = Gaussians(**{key: torch.from_numpy(np.ascontiguousarray(values)).to(device) for key, values in arrays.items()})
    glb = decode_glb(files["mesh.glb"], f"{path}: mesh.glb")
    names = {"vertices": "POSITION", "normals": "NORMAL", "albedo": "_ALBEDO", "roughness": "_ROUGHNESS", "metallic": "_METALLIC"}
    missing = [name for name in names.values() if name not in glb.attributes]
    if missing:
        raise ValueError(f"{path}: mesh.glb lacks the vertex attribute {missing[0]}")
    tensors = {key: torch.from_numpy(glb.attributes[name]).to(device) for key, name in names.items()}
    detail = _read_detail(files["detail.safetensors"], path, device) if "detail.safetensors" in files else None
    mesh = TriangleMesh(faces=torch.from_numpy(glb.faces).to(device), **tensors, detail=detail)
    if "binding.safetensors" in files:
        binding = _read_binding(files["binding.safetensors"], path, device)
    horizons = _read_horizons(files["horizons.safetensors"], path, device) if "horizons.safetensors" in files else None
    certainty = _read_certainty(files["certainty.safetensors"], path, device) if "certainty.safetensors" in files else None
    radiance = decode_environment(files["environment.exr"], f"{path}: environment.exr", clamp_negative=False)
    cameras = _read_cameras(files["cameras.json"], path, device)
    meters, provenance = manifest.get("meters_per_unit"), manifest.get("provenance", {})
    if not isinstance(meters, float | int) or not SMALLEST <= meters <= LARGEST or not isinstance(provenance, dict):
        raise ValueError(f"{path}: asset.json has meters_per_unit {str(meters)[:40]}; expected {SMALLEST:g} to {LARGEST:g}")
    primary = manifest.get("primary")
    if primary is not None and primary not in PRIMARY_SURFACES:
        raise ValueError(f"{path}: asset.json has primary {str(primary)[:40]!r}; expected {' or '.join(PRIMARY_SURFACES)}")
    light_frame = manifest.get("light_frame", "object")
    if light_frame not in LIGHT_FRAMES:
        raise ValueError(f"{path}: asset.json has light_frame {str(light_frame)[:40]!r}; expected {' or '.join(LIGHT_FRAMES)}")
    environment = Environment(torch.from_numpy(radiance).to(device))
    asset = Asset(gaussians, mesh, binding, environment, cameras, float(meters), provenance, horizons, primary, certainty, light_frame)
    _check(asset, str(path))
    return asset


def light_from_world(asset: Asset, edits: Sequence[Edit]) -> Callable[[Camera], Float[Tensor, "3 3"] | None]:
    """Of a camera that takes a picture after these edits, the rotation of directions in the world to those of the environment; None: the same.

    Only the asset's own light may turn with cameras: any other stands still with the object.
    """
    if asset.light_frame == "object" or any(isinstance(edit, EnvironmentEdit) and edit.file is not None for edit in edits):
        return lambda camera: None
    first = asset.cameras[0].camera_from_world[:3, :3].double().cpu()
    return lambda camera: (first.T @ camera.camera_from_world[:3, :3].double().cpu()).float()


def load_photographs(path: Path | str) -> bytes | None:
    """What `save_asset` was given as photographs_zip; None where there are none. Raises like load_asset."""
    return read_package(Path(path), (PHOTOGRAPHS,), (), SCHEMA_VERSION)[1].get(PHOTOGRAPHS)


def _check(asset: Asset, name: str) -> None:
    """What must hold of an asset on either side of a file: finite numbers, equal counts, indices that exist."""
    mesh, binding, gaussians = asset.mesh, asset.binding, asset.gaussians
    for record in (gaussians, mesh, binding, asset.environment, asset.certainty, *asset.cameras):
        for entry in fields(record) if record is not None else ():
            value = getattr(record, entry.name)
            if isinstance(value, Tensor) and not torch.isfinite(value).all():
                count = int((~torch.isfinite(value)).sum())
                raise ValueError(f"{name}: {type(record).__name__}.{entry.name} holds {count} values that are not finite")
    vertices, faces = len(mesh.vertices), mesh.faces
    if faces.numel() == 0 or int(faces.min()) < 0 or int(faces.max()) >= vertices:
        raise ValueError(f"{name}: the mesh has no faces, or a face names a vertex that does not exist ({vertices} vertices)")
    if any(len(values) != vertices for values in (mesh.normals, mesh.albedo, mesh.roughness, mesh.metallic)):
        raise ValueError(f"{name}: the mesh's vertex attributes differ in length ({vertices} vertices)")
    if mesh.detail is not None:
        _check_detail(mesh.detail, len(faces), vertices, name)
    if asset.horizons is not None and asset.horizons.shape != (len(faces), 8):
        raise ValueError(f"{name}: the horizons are of {len(asset.horizons)} faces, there are {len(faces)}")
    for entry in fields(Certainty) if asset.certainty is not None else ():
        certainty = getattr(asset.certainty, entry.name)
        if len(certainty) != vertices:
            raise ValueError(f"{name}: the certainty of {entry.name} is of {len(certainty)} vertices, there are {vertices}")
        low, high = float(certainty.min()), float(certainty.max())
        if low < 0 or high > 1:
            raise ValueError(f"{name}: the certainty of {entry.name} is {low:g} to {high:g}; expected numbers from 0 to 1")
    if asset.light_frame == "camera" and not asset.cameras:
        raise ValueError(f"{name}: its light stands still with the camera, but it has no cameras; expected those of the photographs")
    if asset.primary == "gaussians" and gaussians is None:
        raise ValueError(f"{name}: its primary surface is gaussians, but it has none")
    if binding is not None:
        if gaussians is None or len(binding.face) != len(gaussians.centers):
            found = 0 if gaussians is None else len(gaussians.centers)
            raise ValueError(f"{name}: the binding is of {len(binding.face)} surfels, there are {found}")
        if len(binding.face) and (int(binding.face.min()) < 0 or int(binding.face.max()) >= len(faces)):
            raise ValueError(f"{name}: the binding names a face that does not exist ({len(faces)} faces)")


def _check_detail(detail: AlbedoDetail, faces: int, vertices: int, name: str) -> None:
    if len(detail.codes) != faces:
        raise ValueError(f"{name}: the detail is of {len(detail.codes)} faces, there are {faces}")
    share = detail.share
    if share is not None and (len(share) != vertices or not bool(((share >= 0) & (share <= 1)).all())):
        raise ValueError(
            f"{name}: the detail's share is of {len(share)} vertices or beyond 0 to 1; expected {vertices} numbers from 0 to 1"
        )


def _read_binding(data: bytes, path: Path, device: torch.device | str) -> Binding:
    try:
        arrays = safetensors.numpy.load(data)
        face, barycentric, offset = arrays["face"], arrays["barycentric"], arrays["normal_offset"]
    except (safetensors.SafetensorError, KeyError) as error:
        raise ValueError(f"{path}: binding.safetensors is damaged ({error})") from error
    if face.dtype != np.int32 or face.ndim != 1 or barycentric.shape != (len(face), 3) or offset.shape != (len(face),):
        raise ValueError(f"{path}: binding.safetensors holds arrays of the wrong shape")
    return Binding(*(torch.from_numpy(values.copy()).to(device) for values in (face, barycentric, offset)))


def _read_horizons(data: bytes, path: Path, device: torch.device | str) -> Tensor:
    try:
        sine = safetensors.numpy.load(data)["sine"]
    except (safetensors.SafetensorError, KeyError) as error:
        raise ValueError(f"{path}: horizons.safetensors is damaged ({error})") from error
    if sine.dtype != np.uint8 or sine.ndim != 2:
        raise ValueError(f"{path}: horizons.safetensors holds an array of the wrong shape")
    return torch.from_numpy(sine.copy()).to(device)


def _read_detail(data: bytes, path: Path, device: torch.device | str) -> AlbedoDetail:
    try:
        arrays = safetensors.numpy.load(data)
        codes, share = arrays["codes"], arrays.get("share")
    except (safetensors.SafetensorError, KeyError) as error:
        raise ValueError(f"{path}: detail.safetensors is damaged ({error})") from error
    right_share = share is None or (share.dtype == np.float32 and share.ndim == 1)
    if codes.dtype != np.uint8 or codes.ndim != 3 or codes.shape[2] != 3 or not right_share:
        raise ValueError(f"{path}: detail.safetensors holds arrays of the wrong shape or type")
    try:
        parts = parts_of(codes.shape[1])
    except ValueError as error:
        raise ValueError(f"{path}: detail.safetensors: {error}") from error
    if parts > MOST_PARTS:
        raise ValueError(f"{path}: detail.safetensors cuts each side of a face into {parts} parts; expected at most {MOST_PARTS}")
    worn = None if share is None else torch.from_numpy(share.copy()).to(device)
    return AlbedoDetail(torch.from_numpy(codes.copy()).to(device), worn)


def _read_certainty(data: bytes, path: Path, device: torch.device | str) -> Certainty:
    try:
        arrays = safetensors.numpy.load(data)
        columns = {entry.name: arrays[entry.name] for entry in fields(Certainty)}
    except (safetensors.SafetensorError, KeyError) as error:
        raise ValueError(f"{path}: certainty.safetensors is damaged ({error})") from error
    if any(values.dtype != np.float16 or values.ndim != 1 or len(values) != len(columns["shape"]) for values in columns.values()):
        raise ValueError(f"{path}: certainty.safetensors holds arrays of the wrong shape or type; expected float16, one number a vertex")
    return Certainty(**{name: torch.from_numpy(values.copy()).to(device) for name, values in columns.items()})


def _camera_json(camera: Camera) -> dict:
    """A frame as nerfstudio spells it, and beside it the exact matrices (float32 values survive JSON's decimals)."""
    k = camera.intrinsics
    return {
        "file_path": camera.name,
        "fl_x": float(k[0, 0]), "fl_y": float(k[1, 1]), "cx": float(k[0, 2]), "cy": float(k[1, 2]),
        "w": camera.width, "h": camera.height,
        "transform_matrix": opengl_from_camera(camera.to("cpu")).tolist(),
        "camera_from_world": camera.camera_from_world.tolist(),
        "intrinsics": k.tolist(),
    }  # fmt: skip


def _read_cameras(data: bytes, path: Path, device: torch.device | str) -> tuple[Camera, ...]:
    try:
        frames = json.loads(data)["frames"]
        cameras = []
        for frame in frames:
            pose, k = (torch.tensor(frame[key], dtype=torch.float32, device=device) for key in ("camera_from_world", "intrinsics"))
            if pose.shape != (4, 4) or k.shape != (3, 3):
                raise ValueError("a matrix has the wrong shape")
            cameras.append(Camera(pose, k, int(frame["w"]), int(frame["h"]), str(frame["file_path"])))
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise ValueError(f"{path}: cameras.json is damaged ({error!r})") from error
    return tuple(cameras)


def _array(tensor: Tensor) -> np.ndarray:
    return tensor.detach().cpu().contiguous().numpy()


def _arrays(record: Gaussians | Binding | Certainty) -> dict[str, np.ndarray]:
    return {entry.name: _array(getattr(record, entry.name)) for entry in fields(record)}
