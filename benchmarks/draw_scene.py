"""A capture with everything known, drawn by us: the mesh and cameras of a scene of the benchmark, of other matter or shape, under other light.

    python -m benchmarks draw_scene SCENE OUT --matter chrome|lacquer|gold|as_it_is [--shape urn] --light FILE.exr --new-light FILE.exr [--spp 64]

OUT has the layout of the scenes in shared/bench (photographs, test views with maps, the same under the new light), so that `drgs build` takes it
and `drgs eval` scores what was built. Our own renderer drew it, so it says nothing of that one; it says what a build makes of matter and light
that no scene at hand has.
"""

import argparse
import json
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from PIL import Image

from benchmarks.measures.bench_scene import Array, open_scene, read_true_mesh, training_cameras
from benchmarks.measures.embossed_urn import embossed_urn
from benchmarks.measures.swap_parts import swapped_picture
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.visible.trace_primary import trace_primary
from drgs.scene.camera import Camera
from drgs.scene.load_environment import load_environment
from drgs.scene.mesh import TriangleMesh

BOUNCES = 4
TEST_RAYS = 2
"""Rays of a test picture, for one of a photograph."""


@dataclass(frozen=True)
class Matter:
    """One everywhere."""

    albedo: tuple[float, float, float]
    """Linear."""
    roughness: float
    metallic: float


MATTERS = {
    "chrome": Matter((0.85, 0.83, 0.8), 0.12, 1.0),
    "lacquer": Matter((0.03, 0.03, 0.035), 0.15, 0.0),
    "gold": Matter((0.9, 0.64, 0.28), 0.25, 1.0),
    "as_it_is": None,
}


def urn() -> TriangleMesh:
    """See embossed_urn; white paint."""
    shape = embossed_urn()
    count = len(shape.vertices)
    return TriangleMesh(
        torch.from_numpy(np.array(shape.vertices, np.float32)),
        torch.from_numpy(np.array(shape.faces, np.int32)),
        torch.from_numpy(np.array(shape.vertex_normals, np.float32)),
        torch.ones(count, 3),
        torch.ones(count),
        torch.zeros(count),
    )


def of_matter(mesh: TriangleMesh, matter: Matter | None) -> TriangleMesh:
    """The mesh, all of it made of `matter`; None: as it is."""
    if matter is None:
        return mesh
    one = torch.ones(len(mesh.vertices))
    albedo = torch.tensor(matter.albedo).expand(len(one), 3).contiguous()
    return replace(mesh, albedo=albedo, roughness=matter.roughness * one, metallic=matter.metallic * one)


def true_maps(tracer: AbstractTracer, camera: Camera) -> Array:
    """(height, width, 10): what the camera sees, in the order of the benchmark's aov files; 0 where it sees nothing."""
    seen = trace_primary(tracer.mesh, camera, tracer=tracer)
    single = (seen.depth, seen.roughness, seen.metallic, seen.coverage)
    maps = torch.cat([seen.albedo, seen.normal_world, *(values[..., None] for values in single)], -1)
    return torch.where(seen.coverage[..., None] > 0.5, maps, torch.zeros_like(maps)).double().numpy()


def draw(tracer: AbstractTracer, cameras: list[Camera], light: Path, folder: Path, samples: int) -> None:
    """RGBA pictures of the cameras' names into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    environment = load_environment(light)
    for camera in cameras:
        picture = swapped_picture(tracer, tracer, environment, camera, samples, BOUNCES)
        Image.fromarray((255 * picture + 0.5).astype(np.uint8)).save(folder / f"{Path(camera.name).name}.png")


def draw_scene(
    scene_folder: Path, out: Path, matter: Matter | None, light: Path, new_light: Path, samples: int, shape: TriangleMesh | None = None
) -> None:
    """Write the capture.

    Args:
        shape: in place of the scene's mesh, and about as large.

    Raises:
        ValueError: the scene has no true mesh, or `out` is there.
    """
    scene = open_scene(scene_folder)
    if shape is None and not (scene_folder / "gt_mesh.ply").is_file():
        raise ValueError(f"{scene_folder}: has no gt_mesh.ply; expected a scene with its true mesh")
    if out.exists():
        raise ValueError(f"{out} is there already; name a folder that is not")
    mesh = of_matter(shape or read_true_mesh(scene), matter)
    tracer, tests = build_tracer(mesh), list(scene.cameras)
    (out / "env").mkdir(parents=True)
    for path in (light, new_light):
        shutil.copy(path, out / "env" / path.name)
    for name in ("transforms_train.json", "transforms_test.json"):
        shutil.copy(scene_folder / name, out)
    if shape is None:
        shutil.copy(scene_folder / "gt_mesh.ply", out)
    else:
        trimesh.Trimesh(shape.vertices.numpy(), shape.faces.numpy(), process=False).export(out / "gt_mesh.ply")
    np.savez(out / "gt_materials.npz", **{name: getattr(mesh, name).numpy() for name in ("albedo", "roughness", "metallic")})
    facts = {"name": out.name, "train_env": light.stem, "relight": [new_light.stem], "deform": {}}
    (out / "scene.json").write_text(json.dumps(facts))
    draw(tracer, tests, light, out / "test", TEST_RAYS * samples)
    for camera in tests:
        np.savez_compressed(out / "test" / f"{Path(camera.name).name}_aov.npz", aov=true_maps(tracer, camera).astype(np.float16))
    draw(tracer, tests[::2], new_light, out / "relight" / new_light.stem, TEST_RAYS * samples)
    draw(tracer, sorted(training_cameras(scene), key=lambda camera: camera.name), light, out / "train", samples)


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks draw_scene", description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--matter", choices=tuple(MATTERS), default="as_it_is")
    parser.add_argument("--shape", choices=("urn", "as_it_is"), default="as_it_is")
    parser.add_argument("--light", type=Path, required=True)
    parser.add_argument("--new-light", type=Path, required=True)
    parser.add_argument("--spp", type=int, default=64, help="rays a pixel of a photograph; test pictures have twice as many")
    given = parser.parse_args(arguments)
    draw_scene(
        given.scene, given.out, MATTERS[given.matter], given.light, given.new_light, given.spp, urn() if given.shape == "urn" else None
    )
