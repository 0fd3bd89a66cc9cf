"""A capture with everything known, drawn by us: the mesh and cameras of a scene of the benchmark, of other matter or shape, under other light.

    python -m benchmarks draw_scene SCENE OUT --matter chrome|lacquer|gold|as_it_is [--shape urn|mug|plant|chair|bricks|panels] --light FILE.exr --new-light FILE.exr [--spp 64]
                                    [--turned] [--above] [--every 2] [--side 200]

With --above photographs are taken from a ring above the object, as people take them of things on tables, and test views from between them: what faces
down is in neither. With --turned the light of the photographs stands still with the camera, as on a turntable; the file holds it as the first photograph's camera
sees it, which is how an asset holds it. OUT has the layout of the scenes in shared/bench (photographs, test views with maps, the same under the new light), so that `drgs build` takes it
and `drgs eval` scores what was built. Our own renderer drew it, so it says nothing of that one; it says what a build makes of matter and light
that no scene at hand has.
"""

import argparse
import json
import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
import trimesh
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from benchmarks.measures.swap_parts import swapped_picture
from benchmarks.render._mitsuba import mitsuba_picture
from benchmarks.scenes.bench_scene import Array, BenchScene, open_scene, read_true_mesh, training_cameras
from benchmarks.scenes.draw_film import looking_pose
from benchmarks.scenes.embossed_urn import embossed_urn
from benchmarks.scenes.hollow_things import mug, plant
from benchmarks.scenes.made_things import bricks, chair
from benchmarks.scenes.thin_panels import panels
from drgs.reconstruct.capture.load_views import load_cameras
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.visible.trace_primary import trace_primary
from drgs.scene.camera import Camera, camera_from_opengl, opengl_from_camera, scaled_camera
from drgs.scene.environment import turned_environment
from drgs.scene.load_environment import load_environment
from drgs.scene.mesh import TriangleMesh

Renderer = Literal["ours", "mitsuba"]
BOUNCES = 4
ABOVE_TURNS, ABOVE_FROM, ABOVE_TO = 1.15, 20.0, 55.0
"""Of cameras above: rounds, and the first and the last one's height above the horizontal of the object's middle [degrees]; a film's are alike."""
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


SHAPES: dict[str, Callable[[], TriangleMesh]] = {"urn": urn, "mug": mug, "plant": plant, "chair": chair, "bricks": bricks, "panels": panels}


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


def turns_with(first: Camera) -> Callable[[Camera], Float[Tensor, "3 3"]]:
    """Of a camera, the rotation of directions in the world to those of a light that stands still with the camera and is upright before the first."""
    rotation = first.camera_from_world[:3, :3].double()
    return lambda camera: (rotation.T @ camera.camera_from_world[:3, :3].double()).float()


def draw(
    tracer: AbstractTracer,
    cameras: list[Camera],
    light: Path,
    folder: Path,
    samples: int,
    turn: Callable[[Camera], Float[Tensor, "3 3"]] | None = None,
    renderer: Renderer = "ours",
) -> None:
    """RGBA pictures of the cameras' names into `folder`.

    Args:
        turn: of each camera, the rotation of directions in the world to those of the light; None: it stands still.
    """
    folder.mkdir(parents=True, exist_ok=True)
    still = load_environment(light)
    for camera in cameras:
        environment = still if turn is None else turned_environment(still, turn(camera))
        if renderer == "mitsuba":
            picture = mitsuba_picture(tracer.mesh, environment.radiance.numpy(), camera, samples, BOUNCES)
        else:
            picture = swapped_picture(tracer, tracer, environment, camera, samples, BOUNCES)
        Image.fromarray((255 * picture + 0.5).astype(np.uint8)).save(folder / f"{Path(camera.name).name}.png")


@dataclass(frozen=True)
class Drawing:
    """How a capture is drawn."""

    samples: int = 64
    """Rays a pixel of a photograph."""
    turned: bool = False
    """The light of the photographs stands still with the camera."""
    above: bool = False
    """All cameras stand in a ring above the object, as far from it as the scene's."""
    every: int = 1
    """Of the scene's photographs and test views, one in so many."""
    side: int | None = None
    """Of a picture [pixels]; None: as the scene's."""
    renderer: Renderer = "ours"


def draw_scene(
    scene_folder: Path, out: Path, matter: Matter | None, light: Path, new_light: Path, drawing: Drawing, shape: TriangleMesh | None = None
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
    (out / "env").mkdir(parents=True)
    for path in (light, new_light):
        shutil.copy(path, out / "env" / path.name)
    photographs, tests = drawn_cameras(scene, drawing)
    if drawing.above:
        middle = 0.5 * (mesh.vertices.amin(0) + mesh.vertices.amax(0)).double().numpy()
        photographs, tests = from_above(photographs, middle, 0.0), from_above(tests, middle, 0.5)
    for name, cameras in (("transforms_train.json", photographs), ("transforms_test.json", tests)):
        document = chosen_frames(json.loads((scene_folder / name).read_text()), drawing)
        if drawing.above:
            poses = {Path(camera.name).name: opengl_from_camera(camera).tolist() for camera in cameras}
            document["frames"] = [frame | {"transform_matrix": poses[Path(frame["file_path"]).name]} for frame in document["frames"]]
        (out / name).write_text(json.dumps(document))
    if shape is None:
        shutil.copy(scene_folder / "gt_mesh.ply", out)
    else:
        trimesh.Trimesh(shape.vertices.numpy(), shape.faces.numpy(), process=False).export(out / "gt_mesh.ply")
    np.savez(out / "gt_materials.npz", **{name: getattr(mesh, name).numpy() for name in ("albedo", "roughness", "metallic")})
    facts = {"name": out.name, "train_env": light.stem, "relight": [new_light.stem], "deform": {}}
    (out / "scene.json").write_text(json.dumps(facts))
    tracer = build_tracer(mesh)
    for camera in tests:
        (out / "test").mkdir(exist_ok=True)
        np.savez_compressed(out / "test" / f"{Path(camera.name).name}_aov.npz", aov=true_maps(tracer, camera).astype(np.float16))
    draw(tracer, tests[::2], new_light, out / "relight" / new_light.stem, TEST_RAYS * drawing.samples, None, drawing.renderer)
    draw_photographs(tracer, photographs, tests, light, out, drawing)


def draw_photographs(
    tracer: AbstractTracer, photographs: list[Camera], tests: list[Camera], light: Path, out: Path, drawing: Drawing
) -> None:
    """Photographs and test views under their light, which is upright before the first photograph's camera if it turns."""
    turn = turns_with(photographs[0]) if drawing.turned else None
    draw(tracer, tests, light, out / "test", TEST_RAYS * drawing.samples, turn, drawing.renderer)
    draw(tracer, sorted(photographs, key=lambda camera: camera.name), light, out / "train", drawing.samples, turn, drawing.renderer)


def drawn_cameras(scene: BenchScene, drawing: Drawing) -> tuple[list[Camera], list[Camera]]:
    """Of the photographs, in the order of their file, and of the test views, in the order of their names."""

    def chosen(cameras: list[Camera]) -> list[Camera]:
        return [camera if drawing.side is None else scaled_camera(camera, drawing.side / camera.width) for camera in cameras]

    tests = sorted(load_cameras(scene.folder / "transforms_test.json")[:: drawing.every], key=lambda camera: camera.name)
    return chosen(training_cameras(scene)[:: drawing.every]), chosen(tests)


def from_above(cameras: list[Camera], middle: Array, offset: float) -> list[Camera]:
    """The cameras, as far from the middle as they were and looking at it, once around and a little further while they rise.

    Args:
        offset: in cameras, along the way.
    """
    moved = []
    for k, camera in enumerate(cameras):
        share = (k + offset) / len(cameras)
        around, up = 2 * np.pi * ABOVE_TURNS * share, np.radians(ABOVE_FROM + (ABOVE_TO - ABOVE_FROM) * share)
        outward = np.array([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])
        eye = middle + float(np.linalg.norm(camera.center_world.double().numpy() - middle)) * outward
        moved.append(camera_from_opengl(looking_pose(eye, middle), camera.intrinsics, camera.width, camera.height, camera.name))
    return moved


def chosen_frames(document: dict[str, Any], drawing: Drawing) -> dict[str, Any]:
    """A transforms.json without the frames that are not drawn, and of pictures as large as those that are.

    Raises:
        ValueError: its cameras do not say how wide their pictures are, or what they say cannot be scaled.
    """
    frames = document["frames"][:: drawing.every]
    if drawing.side is None:
        return document | {"frames": frames}
    if "camera_angle_x" not in document or "fl_x" in document:
        raise ValueError("--side needs a scene whose cameras are given by camera_angle_x; leave it out")
    return {name: value for name, value in document.items() if name not in ("w", "h")} | {"frames": frames}


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="python -m benchmarks draw_scene", description=__doc__.split("\n")[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--matter", choices=tuple(MATTERS), default="as_it_is")
    parser.add_argument("--shape", choices=(*SHAPES, "as_it_is"), default="as_it_is")
    parser.add_argument("--light", type=Path, required=True)
    parser.add_argument("--new-light", type=Path, required=True)
    parser.add_argument("--spp", type=int, default=64, help="rays a pixel of a photograph; test pictures have twice as many")
    parser.add_argument("--turned", action="store_true", help="the light of the photographs stands still with the camera")
    parser.add_argument("--above", action="store_true", help="photographs and test views are taken from a ring above the object")
    parser.add_argument("--every", type=int, default=1, help="draw one in so many of the scene's views")
    parser.add_argument("--side", type=int, help="of a picture [pixels]; as the scene's without")
    given = parser.parse_args(arguments)
    drawing = Drawing(given.spp, given.turned, given.above, given.every, given.side)
    shape = SHAPES[given.shape]() if given.shape in SHAPES else None
    draw_scene(given.scene, given.out, MATTERS[given.matter], given.light, given.new_light, drawing, shape)
