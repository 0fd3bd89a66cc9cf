"""A scene with truth, as the benchmark lays it out: test pictures always; maps, mesh, materials and lights where the scene has them.

In: a folder with transforms_train.json, transforms_test.json, test/ and, optional, scene.json, gt_mesh.ply, gt_materials.npz, env/, relight/.
Out: arrays and the project's own records. Nothing here is ever an input of a build.
"""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from drgs.convert.import_mesh import import_mesh
from drgs.evaluate.metrics import truth_folders
from drgs.reconstruct.capture.load_views import load_cameras
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.load_environment import load_environment
from drgs.scene.mesh import TriangleMesh

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TrueMaps:
    """What a test camera truly sees, one entry a pixel; alpha-normalised, so meaningless where alpha is 0."""

    albedo: Array
    """(height, width, 3), linear."""
    normal_world: Array
    """(height, width, 3), unit."""
    depth: Array
    """(height, width), along the viewing axis [world units]."""
    roughness: Array
    metallic: Array
    alpha: Array


@dataclass(frozen=True, eq=False)
class BenchScene:
    """A scene folder and what it says of itself."""

    folder: Path
    name: str
    training_light: str | None
    """Name of the environment of the photographs, where it is known."""
    new_lights: tuple[str, ...]
    cameras: tuple[Camera, ...]
    """Test cameras, in the order of their names."""


def open_scene(folder: Path) -> BenchScene:
    """Raises:
    ValueError: there are no test views.
    """
    if not (folder / "transforms_test.json").is_file():
        raise ValueError(f"{folder}: has no transforms_test.json; expected a scene with test cameras and pictures")
    facts_path = folder / "scene.json"
    facts = json.loads(facts_path.read_text()) if facts_path.exists() else {}
    cameras = sorted(load_cameras(folder / "transforms_test.json"), key=lambda camera: camera.name)
    lights = tuple(path.name for path in truth_folders(folder, "relight/*"))
    return BenchScene(folder, facts.get("name", folder.name), facts.get("train_env"), lights, tuple(cameras))


def read_rgba(path: Path) -> Array:
    """(height, width, 4) in [0, 1], straight alpha, sRGB.

    Raises:
        ValueError: the picture is missing.
    """
    if not path.is_file():
        raise ValueError(f"{path} is missing; expected a picture")
    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGBA"), np.float64) / 255


def has_true_maps(scene: BenchScene) -> bool:
    return all((scene.folder / "test" / f"{camera.name}_aov.npz").is_file() for camera in scene.cameras)


def read_true_maps(scene: BenchScene, camera: Camera) -> TrueMaps:
    with np.load(scene.folder / "test" / f"{camera.name}_aov.npz", allow_pickle=False) as stored:
        aov = stored["aov"].astype(np.float64)
    normal = aov[..., 3:6] / np.maximum(np.linalg.norm(aov[..., 3:6], axis=-1, keepdims=True), 1e-9)
    return TrueMaps(aov[..., :3], normal, *(aov[..., channel] for channel in (6, 7, 8, 9)))


def has_true_mesh(scene: BenchScene) -> bool:
    return (scene.folder / "gt_mesh.ply").is_file()


def has_true_materials(scene: BenchScene) -> bool:
    return has_true_mesh(scene) and (scene.folder / "gt_materials.npz").is_file()


def read_true_mesh(scene: BenchScene) -> TriangleMesh:
    """The true mesh, with its true materials where the scene has them."""
    mesh = import_mesh(scene.folder / "gt_mesh.ply").mesh
    if not has_true_materials(scene):
        return mesh
    with np.load(scene.folder / "gt_materials.npz", allow_pickle=False) as stored:
        materials = {name: torch.from_numpy(stored[name].astype(np.float32)) for name in ("albedo", "roughness", "metallic")}
    return replace(mesh, albedo=materials["albedo"], roughness=materials["roughness"], metallic=materials["metallic"])


def read_light(scene: BenchScene, name: str) -> Environment:
    return load_environment(scene.folder / "env" / f"{name}.exr")


def training_cameras(scene: BenchScene) -> list[Camera]:
    return load_cameras(scene.folder / "transforms_train.json")
