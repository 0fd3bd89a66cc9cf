"""One captured object dropped, twisted and torn as jelly, as metal (von Mises plasticity) and as sand, and how far its picture is from its particles.

In: a scene's evidence. Out: a sheet of frames, a row for each matter; a film of all clips side by side; and for the fall of sand errors against every particle drawn as a ball of its volume:
outline and surface by a float64 tracer of balls (drgs/reference/trace_spheres.py), the lit picture by the renderer itself on finer balls.
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
import trimesh
from scipy.spatial import cKDTree
from torch import Tensor

from benchmarks.paper.films import FPS as FILM_FPS
from benchmarks.paper.films import write_film
from benchmarks.paper.sheets import Array, film_picture, halved, object_window, sheet
from benchmarks.paper.tables import SceneEvidence
from benchmarks.paper.variant import AbstractVariant
from drgs.deform.clip import ClipFrame
from drgs.deform.matter.show_grains import grains_of, show_grains
from drgs.deform.matter.simulate import Simulation
from drgs.deform.matter.simulation_scene import SimulationScene, parse_simulation_scene
from drgs.evaluate.metrics import on_white, psnr
from drgs.reference.trace_spheres import trace_spheres
from drgs.render.records import Frame, RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.asset import Asset
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene

LAWS: dict[str, dict] = {
    "jelly": {"preset": "jelly"},
    "metal": {"preset": "clay", "density": 7800.0, "hardening": 0.05},
    "sand": {"preset": "sand"},
}
"""Matter by the name in the figure; metal's stiffness and yield are those of clay in units of its own weight, so that one sees it yield."""
MOMENTS = {"drop": (0.15, 0.3, 0.6), "twist": (0.15, 0.3), "tear": (0.2, 0.4)}
"""Of each clip, when a picture is taken [s]."""
FPS = 40
"""Pictures of a simulated second; films show FILM_FPS of them in one, slower than it happens."""
HELD = 12
"""Pictures for which a film stays on the end."""
SPEED = 1.0
"""At which the object meets the floor [sizes of the object/s]."""
FOOT, HEAD = 0.25, 0.6
"""Up to what part of the height the lower grip holds, and from where on the upper ones do."""
PULL = 1.5
"""Speed of the grips [sizes of the object/s]."""
SHARE_OF_BUDGET = 1 / 12
ELEVATION = 30.0
"""Of the view, as nearly as a test camera has it [degrees]: from above one sees how far a heap reaches, from the side how high."""
WIDER = 0.65
"""The view's focal length, as a part of the photographs': heaps are wider than the object."""
SIDE = 320
"""Of a traced picture [pixels]; the sheet shows half, the film all."""
BOUNCES = 1
BALL_SUBDIVISIONS = 1
"""Of the reference's balls in the lit picture: 80 faces, four times those of a grain."""


@dataclass(frozen=True, eq=False)
class Clips:
    """A bare asset, seen by one camera, with what its simulations need."""

    asset: Asset
    camera: Camera
    particles: int
    samples_per_pixel: int

    @property
    def size(self) -> float:
        low, high = self.asset.mesh.vertices.amin(0), self.asset.mesh.vertices.amax(0)
        return float((high - low).max())

    def scene(self, matter: dict, action: str) -> SimulationScene:
        """What the object is dropped, twisted or torn by."""
        duration = max(MOMENTS[action])
        given = {"matter": matter, "particles": self.particles, "fps": FPS, "duration": duration}
        if action == "drop":
            return parse_simulation_scene(given | {"velocity": [0, 0, -SPEED * self.size]})
        (x0, y0, z0), (x1, y1, z1) = self.asset.mesh.vertices.amin(0).tolist(), self.asset.mesh.vertices.amax(0).tolist()
        reach, middle, speed = self.size, (x0 + x1) / 2, PULL * self.size
        foot, head = z0 + FOOT * (z1 - z0), z0 + HEAD * (z1 - z0)

        def grip(low: list[float], high: list[float], velocity: list[float]) -> dict:
            return {"shape": {"box": {"minimum": low, "maximum": high}}, "effect": "sticky", "velocity": velocity}

        held = grip([x0 - reach, y0 - reach, z0 - reach], [x1 + reach, y1 + reach, foot], [0, 0, 0])
        if action == "tear":
            moving = [grip([x0 - reach, y0 - reach, head], [x1 + reach, y1 + reach, z1 + 0.01 * reach], [0, 0, speed])]
        else:
            # Grips move along lines: two that pass each other turn what is between them.
            moving = [
                grip([x0 - reach, y0 - reach, head], [middle, y1 + reach, z1 + reach], [0, -0.5 * speed, 0]),
                grip([middle, y0 - reach, head], [x1 + reach, y1 + reach, z1 + reach], [0, 0.5 * speed, 0]),
            ]
        return parse_simulation_scene(given | {"acts": [held, *moving], "floor": None})

    def picture(self, scene: PosedScene) -> Frame:
        return render_frame(scene, self.camera, RenderSettings(samples_per_pixel=self.samples_per_pixel, bounces=BOUNCES, primary="mesh"))

    def posed(self, frame: ClipFrame) -> PosedScene:
        """As pose_scene poses it."""
        mesh = replace(self.asset.mesh, vertices=frame.vertices, normals=frame.normals)
        scene = PosedScene(None, mesh, self.asset.environment, preferred="mesh")
        return scene if frame.parted is None else show_grains(scene, grains_of(mesh, None, frame.parted))


def laws(evidence: SceneEvidence, variants: list[AbstractVariant], path: Path) -> dict:
    """Point by point what drgs2026 shows of one law, of three: a clip of each as frames and as a film; sand is held against its particles."""
    asset = replace(evidence.subject.asset, gaussians=None, binding=None, horizons=None)
    settings = evidence.settings
    camera = widened(min(evidence.scene.cameras, key=lambda seen: abs(elevation(seen) - ELEVATION)), WIDER, SIDE)
    clips = Clips(asset, camera, max(int(SHARE_OF_BUDGET * settings.budget), 1), settings.samples_per_pixel)
    shown: dict[tuple[str, str], list[Array]] = {}
    figures: dict[str, float] = {}
    for name, matter in LAWS.items():
        for action, moments in MOMENTS.items():
            simulation = Simulation(asset, clips.scene(matter, action))
            shown[name, action] = []
            for place in range(simulation.frame_count):
                seen = clips.picture(clips.posed(simulation.at(place / FPS)))
                rgba = rgba_of(seen)
                shown[name, action].append(np.concatenate([on_white(rgba), rgba[..., 3:]], -1))
                if name == "sand" and action == "drop" and place in map(picture_at, moments):
                    told = against_balls(clips, simulation, seen)
                    figures |= {f"{word} at {place / FPS:g} s": value for word, value in told.items()}
    rows = [
        [
            (f"{name}, {action} {seconds:g} s", halved(shown[name, action][picture_at(seconds)]))
            for action, moments in MOMENTS.items()
            for seconds in moments
        ]
        for name in LAWS
    ]
    window = object_window([picture[..., 3] for row in rows for _, picture in row])
    sheet([[(title, picture[window][..., :3]) for title, picture in row] for row in rows], path)
    write_film(film_pictures(shown), path.with_suffix(".mp4"), back=False)
    caption = f"dropped, twisted and torn as three kinds of matter, {clips.particles} particles"
    return {
        "caption": caption,
        "figures": figures,
        "film_shows": f"the clips side by side, {FPS / FILM_FPS:.2g} times slower than they happen",
    }


def picture_at(seconds: float) -> int:
    """Of a clip."""
    return round(seconds * FPS)


def film_pictures(shown: dict[tuple[str, str], list[Array]]) -> Iterator[Array]:
    """All clips side by side, a row a matter; what has ended stays on its end.

    Args:
        shown: by matter and action, (height, width, 4) each: on white, and what is covered.
    """
    columns = {
        action: object_window([picture[..., 3] for (_, own), clip in shown.items() if own == action for picture in clip])
        for action in MOMENTS
    }
    tall = slice(min(rows.start for rows, _ in columns.values()), max(rows.stop for rows, _ in columns.values()))
    for place in range(max(map(len, shown.values())) + HELD):

        def titled(name: str, action: str, place: int = place) -> tuple[str, Array]:
            clip = shown[name, action]
            now = min(place, len(clip) - 1)
            return f"{name}, {action} {now / FPS:.2f} s", clip[now][tall, columns[action][1], :3]

        yield film_picture([[titled(name, action) for action in MOMENTS] for name in LAWS])


def against_balls(clips: Clips, simulation: Simulation, seen: Frame) -> dict[str, float]:
    """A frame of a simulation, which has just come to it, beside all of its matter as balls.

    Returns:
        The overlap of outlines (intersection over union), how far outside the nearest ball what is seen lies [spacings of the particles], and PSNR of
        the lit pictures on white [dB].
    """
    # What follows the surface has a thousandth of a particle's volume.
    matter = simulation.model.volumes > 0.5 * simulation.model.volumes.max()
    volumes = simulation.model.volumes[matter].double()
    mesh = clips.asset.mesh
    middle = (mesh.vertices.amin(0).double() + mesh.vertices.amax(0).double()) / 2
    centers = simulation.state.positions[matter].double() + middle
    radii = (volumes * 3 / (4 * math.pi)) ** (1 / 3)
    origin, directions = pixel_rays_world(clips.camera)
    _, ball, _ = trace_spheres(centers, radii, origin, directions.reshape(-1, 3))
    axis = clips.camera.camera_from_world[2, :3].double()
    hit = (ball >= 0).reshape(SIDE, SIDE)
    shown = seen.gbuffer.coverage > 0.5
    places = (
        origin.double() + (directions.double() / (directions.double() @ axis)[..., None] * seen.gbuffer.depth.double()[..., None])[shown]
    )
    tree, spacing = cKDTree(centers.numpy()), float(volumes.mean()) ** (1 / 3)
    # All balls but for rounding have one radius, so that the nearest centre is that of the nearest ball.
    away, _ = tree.query(places.numpy())
    away = np.maximum(away - float(radii.mean()), 0) / spacing
    _, nearest = cKDTree(mesh.vertices.numpy()).query(simulation.model.rest[matter].double().numpy() + middle.numpy())
    lit = clips.picture(PosedScene(None, balls(centers, radii, mesh, torch.from_numpy(nearest)), clips.asset.environment, preferred="mesh"))
    return {
        "outlines' IoU": float((hit & shown).sum() / (hit | shown).sum()),
        "spacings from the nearest ball, median": float(np.median(away)),
        "95 of 100": float(np.quantile(away, 0.95)),
        "PSNR of the lit pictures": psnr(on_white(rgba_of(seen)), on_white(rgba_of(lit))),
    }


def balls(centers: Tensor, radii: Tensor, mesh: TriangleMesh, nearest: Tensor) -> TriangleMesh:
    """Fine balls in the materials of the mesh's vertices `nearest`."""
    solid = trimesh.creation.icosphere(subdivisions=BALL_SUBDIVISIONS)
    # Of a ball's volume, not within it.
    corners = torch.tensor(solid.vertices * (4 / 3 * math.pi / solid.volume) ** (1 / 3))
    triangles = torch.tensor(solid.faces, dtype=torch.int32)
    placed = (centers[:, None] + radii[:, None, None] * corners).reshape(-1, 3).float()
    offsets = len(corners) * torch.arange(len(centers), dtype=torch.int32)
    faces = (offsets[:, None, None] + triangles).reshape(-1, 3)
    source = nearest.repeat_interleave(len(corners))
    normals = torch.nn.functional.normalize(corners, dim=-1).float().repeat(len(centers), 1)
    return TriangleMesh(placed, faces, normals, mesh.albedo[source], mesh.roughness[source], mesh.metallic[source])


def widened(camera: Camera, factor: float, side: int) -> Camera:
    """A square view from the same place in the same direction, of `factor` of the focal length."""
    focal = factor * float(camera.intrinsics[0, 0]) * side / camera.width
    intrinsics = torch.tensor([[focal, 0.0, side / 2], [0.0, focal, side / 2], [0.0, 0.0, 1.0]])
    return Camera(camera.camera_from_world, intrinsics, side, side, camera.name)


def elevation(camera: Camera) -> float:
    """How far above the object's height it looks down from [degrees]."""
    return math.degrees(math.asin(-float(camera.camera_from_world[2, 2])))


def rgba_of(frame: Frame) -> Array:
    return np.asarray(frame.rgba_srgb.clamp(0, 1).cpu().double().numpy())
