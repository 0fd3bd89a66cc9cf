"""A captured character danced by its skeleton under a turning light, frame by frame beside the truth.

In: the evidence of a scene that says by which file it is rigged (character/photograph.py). Out: a strip, a film, a curve of errors over the clip, and a cell
for each frame, so that a killed run goes on where it was. Ours is the built asset with two edits, as a user gives them: the light, turned, and the pose of
the file's animation at a time, which the asset's own mesh follows (docs/rigs.md). The truth is the file's mesh, skinned as glTF says, with its own
materials, normals from its moved triangles, drawn by who took the photographs: our renderer, where lights and rays are the same but in number and the filter after ours, or Mitsuba.
"""

import hashlib
import json
from dataclasses import asdict, dataclass, replace
from functools import cached_property, reduce
from pathlib import Path
from typing import Literal, get_args

import igl
import numpy as np
import torch

from benchmarks._plot import Curve, linear_svg
from benchmarks.paper.cells import write_whole
from benchmarks.paper.films import FPS, write_film
from benchmarks.paper.sheets import Array, film_picture, object_window, sheet
from benchmarks.paper.tables import SceneEvidence, write_picture
from benchmarks.paper.traced import traced_settings
from benchmarks.paper.variant import AbstractVariant
from benchmarks.reconstruct.draw_scene import BOUNCES, Renderer
from benchmarks.render._mitsuba import mitsuba_picture
from benchmarks.scenes.bench_scene import read_light, read_rgba
from drgs.convert.import_mesh import import_mesh
from drgs.deform.pose_scene import pose_scene
from drgs.deform.rig.rig_clip import find_animation
from drgs.deform.rig.skeleton import pose_rig
from drgs.evaluate.metrics import light_scale, on_white, psnr, scale_light, ssim
from drgs.exchange.gltf_rig import read_gltf_rig
from drgs.exchange.rig import Rig, RigAnimation
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.camera import Camera
from drgs.scene.edits import parse_edits
from drgs.scene.environment import Environment
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs.scene.posed_scene import PosedScene

TRUTH_RAYS = 4
"""Of a picture of the truth, for one of ours."""
HELD_EVERY = 8
"""Every so many-th frame is drawn with both standing as well: what of the error is there without any motion."""
STRIP = (0, 14, 31, 43, 57, 82)
"""Frames of the film that the strip has, no two on the same beat."""
DIFFERENCE_GAIN = 4.0
"""Differences are shown stronger by this factor."""
Kind = Literal["dancing", "standing"]
Owner = Literal["ours", "truth"]
KINDS: tuple[Kind, ...] = get_args(Kind)
OWNERS: tuple[Owner, ...] = get_args(Owner)
Pair = tuple[Array, Array]
"""Ours and the truth."""


@dataclass(frozen=True)
class RigFacts:
    """What a scene's file says of its dance."""

    file: str
    """A .glb in the scene's folder."""
    clip: str
    light: str
    """Name of the environment that turns."""
    renderer: Renderer = "ours"
    """Who took the photographs and draws the truth."""


@dataclass(frozen=True, eq=False)
class Dance:
    """What frames are drawn from; each is read when the first frame is to be drawn."""

    evidence: SceneEvidence
    facts: RigFacts

    @property
    def file(self) -> Path:
        return self.evidence.scene.folder / self.facts.file

    @cached_property
    def rig(self) -> Rig:
        return read_gltf_rig(self.file)

    @cached_property
    def animation(self) -> RigAnimation:
        return find_animation(self.rig, self.facts.clip)

    @cached_property
    def true_mesh(self) -> TriangleMesh:
        """At rest."""
        return import_mesh(self.file).mesh

    @cached_property
    def light(self) -> Environment:
        return read_light(self.evidence.scene, self.facts.light)

    @property
    def camera(self) -> Camera:
        return self.evidence.scene.cameras[0]

    @property
    def frames(self) -> int:
        """The last of the animation, which is the first, is left out."""
        return round(self.animation.duration * FPS)

    @property
    def places(self) -> range:
        """Those that are drawn."""
        return range(0, self.frames, self.evidence.settings.dance_every)

    @property
    def held(self) -> range:
        """Those that are drawn standing as well."""
        return range(0, self.frames, HELD_EVERY)

    def degrees(self, place: int) -> float:
        """How far the light is turned: once around in all."""
        return 360 * place / self.frames

    def picture_path(self, kind: Kind, whose: str, place: int) -> Path:
        return self.evidence.cells.folder / "pictures" / self.evidence.scene.name / kind / whose / f"{place:03d}.png"

    def read_pair(self, kind: Kind, place: int, whose: str = "ours") -> Pair:
        """(height, width, 4) each, as 8-bit files hold them."""
        return read_rgba(self.picture_path(kind, whose, place)), read_rgba(self.picture_path(kind, "truth", place))


def rig_facts(evidence: SceneEvidence) -> RigFacts | None:
    """None: the scene has no rig."""
    path = evidence.scene.folder / "scene.json"
    facts = json.loads(path.read_text()).get("rig") if path.is_file() else None
    return None if facts is None else RigFacts(**facts)


def asked_of_dance(evidence: SceneEvidence) -> dict:
    """What a dance's cells depend on."""
    facts = rig_facts(evidence)
    assert facts is not None
    rig_file = hashlib.sha256((evidence.scene.folder / facts.file).read_bytes()).hexdigest()[:16]
    return evidence.asked | asdict(facts) | {"rig_file": rig_file, "truth_rays": TRUTH_RAYS, "held_every": HELD_EVERY}


def dance(evidence: SceneEvidence, variants: list[AbstractVariant], path: Path) -> dict:
    """drgs2026, Fig. 7: a character moved by its skeleton under a turning light, here with its error in each frame."""
    facts = rig_facts(evidence)
    assert facts is not None
    shown = Dance(evidence, facts)
    places, held = shown.places, shown.held
    off = [frame_cell(shown, place)["surface_off"] for place in places]
    pictures = {kind: Pictures(shown, kind, light_scale([shown.read_pair(kind, place) for place in held])) for kind in KINDS}
    dancing = {place: scored(*pictures["dancing"].on_white(place)) for place in places}
    standing = [scored(*pictures["standing"].on_white(place)) for place in held]
    write_pictures(pictures["dancing"], dancing, path)
    curves = [
        Curve("dancing", [(place / FPS, score.psnr) for place, score in dancing.items()]),
        Curve("standing", [(place / FPS, score.psnr) for place, score in zip(held, standing, strict=True)]),
    ]
    plot = linear_svg(curves, f"{facts.clip} under {facts.light}, which turns once", "seconds", "PSNR [dB]")
    write_whole(path.with_suffix(".svg"), plot.encode())
    figures = {
        "PSNR, mean of all frames": float(np.mean([score.psnr for score in dancing.values()])),
        "worst frame": min(score.psnr for score in dancing.values()),
        "mean standing under the same lights": float(np.mean([score.psnr for score in standing])),
        "SSIM, mean of all frames": float(np.mean([score.ssim for score in dancing.values()])),
        "mean standing": float(np.mean([score.ssim for score in standing])),
        "vertices off the true surface, in per cent of its height, at rest": off[0],
        "mean of all frames": float(np.mean(off)),
        "largest": max(off),
    }
    drawn_by = "Mitsuba took the photographs and drew" if facts.renderer == "mitsuba" else "our own renderer drew"
    caption = f"{facts.clip} of {len(places)} frames under {facts.light} (new light), which turns once around; {drawn_by} the truth"
    told = {"caption": caption, "figures": figures, "film_shows": f"truth, ours, {DIFFERENCE_GAIN:g} times their difference"}
    return told | {
        "psnr": [round(score.psnr, 3) for score in dancing.values()],
        "ssim": [round(score.ssim, 4) for score in dancing.values()],
    }


def frame_cell(shown: Dance, place: int) -> dict:
    """A frame's pictures, in files; and how far our vertices are from the true surface."""
    evidence = shown.evidence
    kinds = KINDS if place in shown.held else KINDS[:1]
    files = [shown.picture_path(kind, whose, place) for kind in kinds for whose in OWNERS]

    def make() -> dict:
        off = {}
        for kind in kinds:
            ours, truth = posed_pair(shown, kind, place)
            rays = evidence.settings.samples_per_pixel
            draw(ours, shown.camera, traced_settings(rays), shown.picture_path(kind, "ours", place))
            draw_truth(shown, truth, TRUTH_RAYS * rays, shown.picture_path(kind, "truth", place))
            off[kind] = surface_off(ours.mesh, truth.mesh)
        return {"surface_off": off["dancing"]}

    return evidence.cells.cell(f"{evidence.scene.name}-{shown.facts.clip}-{place:03d}", asked_of_dance(evidence), make, files)


def posed_pair(shown: Dance, kind: Kind, place: int) -> tuple[PosedScene, PosedScene]:
    """Ours as edits pose it, and the truth; standing: both at rest."""
    facts, seconds, degrees = shown.facts, place / FPS, shown.degrees(place)
    edits: list[dict] = [{"op": "environment", "file": f"env/{facts.light}.exr", "rotation": degrees}]
    if kind == "dancing":
        edits.append({"op": "pose", "clip": f"{facts.file}#{facts.clip}", "time": seconds})
    ours = pose_scene(shown.evidence.subject.asset, parse_edits(edits), shown.evidence.scene.folder)
    true = true_pose(shown, seconds if kind == "dancing" else None)
    return ours, PosedScene(None, true, shown.light, degrees, preferred="mesh")


def true_pose(shown: Dance, seconds: float | None) -> TriangleMesh:
    """The file's mesh, skinned; None: as its nodes stand."""
    pose = pose_rig(shown.rig) if seconds is None else pose_rig(shown.rig, shown.animation, seconds)
    x, y, z = pose.vertices.unbind(-1)
    vertices = torch.stack([x, -z, y], -1).float()  # y up to z up
    return replace(shown.true_mesh, vertices=vertices, normals=vertex_normals(vertices, shown.true_mesh.faces))


def surface_off(ours: TriangleMesh, true: TriangleMesh) -> float:
    """Mean distance of our vertices from the true surface [per cent of its height]."""
    points, vertices = (mesh.vertices.double().numpy() for mesh in (ours, true))
    squared = igl.point_mesh_squared_distance(points, vertices, true.faces.numpy().astype(np.int64))[0]
    return float(100 * np.sqrt(squared).mean() / (vertices[:, 2].max() - vertices[:, 2].min()))


def draw(scene: PosedScene, camera: Camera, settings: RenderSettings, path: Path) -> None:
    """Write a picture whole."""
    part = path.with_name(f"{path.stem}.part.png")
    write_picture(render_frame(scene, camera, settings).rgba_srgb, part)
    part.replace(path)


def draw_truth(shown: Dance, scene: PosedScene, rays: int, path: Path) -> None:
    """By who took the photographs."""
    if shown.facts.renderer == "ours":
        draw(scene, shown.camera, RenderSettings(rays, bounces=BOUNCES), path)
        return
    light, degrees = scene.environment.radiance.numpy(), scene.environment_rotation_degrees
    picture = torch.from_numpy(mitsuba_picture(scene.mesh, light, shown.camera, rays, BOUNCES, degrees))
    part = path.with_name(f"{path.stem}.part.png")
    write_picture(picture, part)
    part.replace(path)


@dataclass(frozen=True, eq=False)
class Pictures:
    """Of all frames of a kind, drawn after one factor a channel, since nobody can tell dark paint from dim light."""

    shown: Dance
    kind: Kind
    scale: Array
    """(3,)"""
    whose: str = "ours"

    def on_white(self, place: int) -> Pair:
        """(height, width, 3) each."""
        ours, truth = self.shown.read_pair(self.kind, place, self.whose)
        return on_white(scale_light(ours, self.scale)), on_white(truth)


@dataclass(frozen=True)
class FrameScore:
    """How near a frame is to the truth."""

    psnr: float
    """[dB]"""
    ssim: float


def scored(ours: Array, truth: Array) -> FrameScore:
    return FrameScore(psnr(ours, truth), ssim(ours, truth))


def write_pictures(pictures: Pictures, scores: dict[int, FrameScore], path: Path) -> None:
    """The strip, and the film, which shows each frame for as long as it stands for."""
    frames = (pictures.shown.read_pair(pictures.kind, place) for place in scores)
    # One at a time: all of them together would be a gigabyte.
    window = object_window([reduce(np.maximum, (picture[..., 3].copy() for pair in frames for picture in pair))])

    def titled(place: int) -> list[tuple[str, Array]]:
        ours, truth = (picture[window] for picture in pictures.on_white(place))
        difference = 1 - DIFFERENCE_GAIN * np.abs(ours - truth)
        named = ((f"truth, {place / FPS:.2f} s", truth), (f"ours, {scores[place].psnr:.1f} dB", ours))
        return [*named, (f"{DIFFERENCE_GAIN:g} x difference", difference)]

    every = pictures.shown.places.step
    columns = [titled(place // every * every) for place in STRIP if place < pictures.shown.frames]
    sheet([[column[row] for column in columns] for row in range(3)], path)
    film = (picture for place in scores for picture in every * [film_picture([titled(place)])])
    write_film(film, path.with_suffix(".mp4"), back=False)
