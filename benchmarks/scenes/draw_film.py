"""A film of a scene's true object standing on a textured table under the scene's light, drawn by Mitsuba, with the truth beside it.

In: a scene with a mesh and its materials. Out, in a folder:

    film.mp4                  H.264; nothing else is ever given to a build
    truth/transforms.json     cameras of all frames
    truth/frames/<name>.png   as they were drawn, before the film was compressed
    truth/masks/<name>.png    the share of each pixel that the object covers

The camera goes once around the object and a little further, rises, and is held by no steady hand. Noise is Mitsuba's, as many rays leave it.
"""

import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import gaussian_filter

from benchmarks.render._mitsuba import load_mitsuba, mitsuba_light, mitsuba_mesh, mitsuba_sensor, sensor_transform
from benchmarks.scenes.bench_scene import BenchScene, has_true_materials, read_light, read_true_mesh
from drgs.maths.color_numpy import srgb_from_linear
from drgs.reconstruct.capture.load_views import load_cameras
from drgs.scene.camera import Camera, camera_from_opengl, opengl_from_camera
from drgs.scene.mesh import TriangleMesh

Array = NDArray[np.float64]
Table = Literal["print", "cloth", "wood", "plain"]
TABLES: tuple[Table, ...] = get_args(Table)
TABLE_COLORS = {"print": (0.5, 0.45, 0.4), "cloth": (0.45, 0.32, 0.22), "wood": (0.42, 0.27, 0.15), "plain": (0.6, 0.6, 0.58)}
"""Mean albedos, linear."""
TABLE_BLOTCHES = {"print": ((1.5, 0.25), (4, 0.25), (12, 0.15)), "cloth": ((2, 0.05), (6, 0.08), (24, 0.12), (80, 0.1))}
"""Width [texels] and strength of each layer of blurred noise, each channel by itself."""
GRAIN = ((40, 1.2, 60.0), (150, 6.0, 150.0))
"""Of wood: length, width [texels] and strength of its layers."""
GRAIN_COLOR = (0.05, 0.035, 0.02)
TEXTURE_SIDE = 1536
TABLE_SEED = 3
TABLE_MIDDLE, TABLE_HALVES = (0.3, -0.2), (3.0, 2.4)
"""[world units]; objects are about two units large."""
FIELD_OF_VIEW = 48.0
"""Across the picture [degrees]."""
TURNS = 1.15
"""Around the object."""
BOUNCES = 3
MASK_RAYS = 16
FRAMES_A_SECOND = 24
QUALITY = "16"
"""x264's constant rate factor: as good as telephones' films."""


@dataclass(frozen=True)
class FilmDrawing:
    """How a film is drawn."""

    table: Table = "print"
    frames: int = 64
    samples: int = 16
    """Rays a pixel."""
    width: int = 640
    height: int = 480


def film_cameras(mesh: TriangleMesh, drawing: FilmDrawing) -> list[Camera]:
    """One a frame, named by its number; the mesh's middle axis is the world's."""
    low, high = float(mesh.vertices[:, 2].min()), float(mesh.vertices[:, 2].max())
    focal = 0.5 * drawing.width / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    intrinsics = torch.tensor([[focal, 0, drawing.width / 2], [0, focal, drawing.height / 2], [0, 0, 1]])
    cameras = []
    for k in range(drawing.frames):
        share = k / drawing.frames
        around = 2 * np.pi * TURNS * share + 0.3
        up = np.radians(22 + 30 * share + 5 * np.sin(5 * around))
        distance = 3.9 + 0.25 * np.sin(2.3 * around)
        target = np.array([0.08 * np.sin(3 * around), 0.06 * np.cos(2 * around), (low + high) / 2 + 0.05 * np.sin(4 * around)])
        eye = distance * np.array([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)]) + [0, 0, target[2]]
        cameras.append(camera_from_opengl(looking_pose(eye, target), intrinsics, drawing.width, drawing.height, f"{k:05d}"))
    return cameras


def looking_pose(eye: Array, target: Array) -> torch.Tensor:
    """(4, 4) OpenGL camera-to-world, upright."""
    back = (eye - target) / np.linalg.norm(eye - target)
    right = np.cross([0, 0, 1.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, eye], 1)
    return torch.from_numpy(pose)


def table_texture(table: Table, side: int = TEXTURE_SIDE) -> NDArray[np.float32]:
    """(side, side, 3) linear albedo, the same in every run."""
    random = np.random.default_rng(TABLE_SEED)
    texture = np.zeros((side, side, 3))
    for width, strength in TABLE_BLOTCHES.get(table, ()):
        noise = random.standard_normal((side, side, 3))
        texture += strength * width * gaussian_filter(noise, (width, width, 0), mode="wrap")
    if table == "wood":
        layers = [strength * gaussian_filter(random.standard_normal((side, side)), (long, wide)) for long, wide, strength in GRAIN]
        grain = np.sum(layers, 0)
        texture = (grain / grain.std())[..., None] * np.array(GRAIN_COLOR)
    return np.clip(np.array(TABLE_COLORS[table]) + texture, 0.02, 0.9).astype(np.float32)


def draw_film(scene: BenchScene, out: Path, drawing: FilmDrawing) -> None:
    """Write the folder.

    Raises:
        ValueError: the scene lacks what a film needs, or Mitsuba is not there.
    """
    check_filmable(scene)
    mi = load_mitsuba()
    mesh = read_true_mesh(scene)
    cameras = film_cameras(mesh, drawing)
    things = {
        "light": mi.load_dict(mitsuba_light(mi, read_light(scene, str(scene.training_light)).radiance.numpy())),
        "object": mitsuba_mesh(mi, mesh, "principled"),
    }
    shown = _Stage(mi, things | {"table": _table(mi, drawing.table, float(mesh.vertices[:, 2].min()))}, cameras[0], 2 + BOUNCES)
    alone = _Stage(mi, things, cameras[0], 2, hide_emitters=True)
    frames, masks = out / "truth" / "frames", out / "truth" / "masks"
    for folder in (frames, masks):
        folder.mkdir(parents=True, exist_ok=True)
    for k, camera in enumerate(cameras):
        color = srgb_from_linear(shown.render(camera, drawing.samples, k)[..., :3].clip(0, 1))
        Image.fromarray((255 * color + 0.5).astype(np.uint8)).save(frames / f"{camera.name}.png")
        coverage = alone.render(camera, MASK_RAYS, k)[..., 3].clip(0, 1)
        Image.fromarray((255 * coverage + 0.5).astype(np.uint8)).save(masks / f"{camera.name}.png")
    write_cameras(cameras, out / "truth" / "transforms.json")
    write_film((frames / f"{camera.name}.png" for camera in cameras), drawing, out / "film.mp4")


def check_filmable(scene: BenchScene) -> None:
    """Raises:
    ValueError: there are no true materials, or the light is not known.
    """
    if not has_true_materials(scene) or scene.training_light is None:
        raise ValueError(f"{scene.folder}: has no true materials or no known light; expected gt_mesh.ply, gt_materials.npz and train_env")


class _Stage:
    """A Mitsuba scene whose camera moves. Final."""

    def __init__(self, mi: Any, things: dict[str, Any], camera: Camera, depth: int, hide_emitters: bool = False) -> None:
        integrator = {"type": "path", "max_depth": depth, "rr_depth": 100, "hide_emitters": hide_emitters}
        self._mi = mi
        self._scene = mi.load_dict({"type": "scene", "integrator": integrator, "sensor": mitsuba_sensor(mi, camera), **things})
        self._parameters = mi.traverse(self._scene)

    def render(self, camera: Camera, samples: int, seed: int) -> Array:
        """(height, width, 4) premultiplied linear colour, and coverage."""
        self._parameters["sensor.to_world"] = self._mi.Transform4f(sensor_transform(self._mi, camera))
        self._parameters.update()
        return np.array(self._mi.render(self._scene, spp=samples, seed=seed), np.float64)


def _table(mi: Any, table: Table, height: float) -> dict[str, Any]:
    place = mi.ScalarTransform4f().translate([*TABLE_MIDDLE, height]).scale([*TABLE_HALVES, 1])
    texture = {"type": "bitmap", "bitmap": mi.Bitmap(table_texture(table)), "raw": True}
    matter = {"type": "principled", "base_color": texture, "roughness": 0.6, "specular": 0.5}
    return {"type": "rectangle", "to_world": place, "bsdf": {"type": "twosided", "matter": matter}}


def write_film(pictures: Iterable[Path], drawing: FilmDrawing, path: Path) -> None:
    """An MP4 of pictures of the drawing's size."""
    import av

    with av.open(str(path), "w") as container:
        stream: Any = container.add_stream("libx264", rate=FRAMES_A_SECOND, options={"crf": QUALITY})
        stream.width, stream.height, stream.pix_fmt = drawing.width, drawing.height, "yuv420p"
        for picture in pictures:
            with Image.open(picture) as opened:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.asarray(opened.convert("RGB")), format="rgb24")))
        container.mux(stream.encode())


def write_cameras(cameras: list[Camera], path: Path) -> None:
    first = cameras[0]
    lens = {"fl_x": float(first.intrinsics[0, 0]), "fl_y": float(first.intrinsics[1, 1]), "cx": first.width / 2, "cy": first.height / 2}
    frames = [{"file_path": f"frames/{camera.name}", "transform_matrix": opengl_from_camera(camera).tolist()} for camera in cameras]
    path.write_text(json.dumps({"w": first.width, "h": first.height, **lens, "frames": frames}))


def read_film_cameras(folder: Path) -> list[Camera]:
    """The true ones of a drawn film, in the order of its frames."""
    return sorted(load_cameras(folder / "truth" / "transforms.json"), key=lambda camera: camera.name)
