"""The figures: what the tables' numbers look like. Each is one JPEG of a scene, and a cell that says what is on it; what moves has a film beside it.

In: a scene's evidence, and the pictures that the tables' cells left. Out: OUT/images/paper/SCENE_FIGURE.jpg and .mp4. All are on white, cut to the object,
of the first camera that has a deformed truth.
"""

from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from benchmarks.measures.peak_memory import measured
from benchmarks.paper.cells import NotMade
from benchmarks.paper.danced_ways import dance_ways
from benchmarks.paper.dances import asked_of_dance, dance, rig_facts
from benchmarks.paper.fields import field_of_map
from benchmarks.paper.films import shares, write_film
from benchmarks.paper.laws import laws, rgba_of
from benchmarks.paper.poor_mesh import checkpoints, poor_mesh
from benchmarks.paper.sheets import Array, halved, object_window, sheet
from benchmarks.paper.tables import SceneEvidence
from benchmarks.paper.traced import traced_settings
from benchmarks.paper.variant import AbstractVariant
from benchmarks.paper.wires import with_wires
from benchmarks.scenes.bench_scene import has_true_maps, read_light, read_rgba, read_true_maps
from drgs.deform.matter.simulation_scene import make_material, parse_simulation_scene
from drgs.deform.pose_scene import pose_scene
from drgs.evaluate.metrics import normal_error_degrees, on_white, psnr
from drgs.maths.color_numpy import srgb_from_linear
from drgs.maths.constants import STILL_BOUNCES
from drgs.reconstruct.geometry.mesh_from_gaussians import reduced_mesh
from drgs.render.records import Frame
from drgs.render.render_frame import render_frame
from drgs.scene.asset import Asset
from drgs.scene.camera import Camera
from drgs.scene.edits import parse_edits

Mask = NDArray[np.bool_]
Figure = Callable[[SceneEvidence, list[AbstractVariant], Path], dict]
"""Writes a picture and says what is on it: {"caption", ...}."""
EDITS: dict[str, list[dict]] = {
    "as captured": [],
    "gold, polished": [{"op": "material", "select": {"all": True}, "set": {"albedo": [0.9, 0.6, 0.2], "metallic": 1.0, "roughness": 0.1}}],
    "gold, rough": [{"op": "material", "select": {"all": True}, "set": {"albedo": [0.9, 0.6, 0.2], "metallic": 1.0, "roughness": 0.5}}],
    "red paint": [{"op": "material", "select": {"all": True}, "set": {"albedo": [0.6, 0.05, 0.05], "metallic": 0.0, "roughness": 0.3}}],
}
MATTERS: dict[str, tuple[str, float | None]] = {
    "jelly, E": ("jelly", None),
    "jelly, 10 E": ("jelly", 10.0),
    "clay": ("clay", None),
    "sand": ("sand", None),
}
"""Presets by the name in the figure, softest first, and how many times as stiff. E of jelly is 10 rho g L."""
FALL = {"time": 0.4, "speed": 1.5}
"""When the pictures of matter are taken [s], and how fast the object arrives [world units/s]."""
PARTICLES_SHARE = 1 / 12
"""Of the budget: how many particles the falling object has."""
WIRE_FACES = 3000
"""Of the mesh whose edges are drawn over pictures."""
AMOUNTS = {"rate": 0.0, "curvature": 0.0, "factor": 1.0}
"""Of maps, and their value at rest."""
STRIP = (0, 8, 12, 16, 24)
"""Which pictures of the film the strip has: at rest, with a quarter of the deformation, a half, three quarters, and all of it."""
AROUND_MAPS = 0.85
"""Grey, so that metal, which is 1, is seen."""
DIFFERENCE_GAIN = 4.0
"""Differences are shown brighter by this factor."""
NORMAL_ERROR_SHOWN = 30.0
"""[degrees] that is drawn white."""


def deformed(evidence: SceneEvidence, variants: list[AbstractVariant], path: Path, new_light: bool) -> dict:
    """drgs2026, Fig. 3 (light of the photographs) and Fig. 4 (new light): every way beside the truth."""
    folder = next(folder for folder, new in evidence.truths() if new is new_light)
    name = camera_of(evidence).name
    truth = read_rgba(evidence.scene.folder / folder / f"{name}.png")
    drawn = [("truth", truth)]
    for variant in variants:
        file = evidence.pictures(variant) / folder / f"{name}.png"
        drawn.append((variant.title, read_rgba(file)))
    at_rest = read_rgba(evidence.scene.folder / "test" / f"{name}.png")
    window = object_window([picture[..., 3] for _, picture in [("", at_rest), *drawn]])
    white = [(title, on_white(picture)) for title, picture in drawn]
    cut = [(title, picture[window]) for title, picture in [*wired(evidence, folder.parent.name, on_white(at_rest), white[0][1]), *white]]
    middle = -(-len(cut) // 2)
    sheet([row for row in (cut[:middle], cut[middle:]) if row], path)
    return {"caption": f"{folder.parent.name} under {folder.name}" + (" (new light)" if new_light else " (light of the photographs)")}


def wired(evidence: SceneEvidence, deformation: str, at_rest: Array, deformed: Array) -> list[tuple[str, Array]]:
    """The truth at rest and deformed, with the edges of our mesh, thinned out, over it."""
    mesh, camera = evidence.subject.asset.mesh, camera_of(evidence)
    radius = 0.5 * float((mesh.vertices.amax(0) - mesh.vertices.amin(0)).norm())
    thinned = reduced_mesh(mesh, WIRE_FACES, radius)
    moved = replace(thinned, vertices=field_of_map(evidence.deformations[deformation])(thinned.vertices)[0].contiguous())
    pictures = (("at rest, our mesh over it", at_rest, thinned), ("deformed, our mesh over it", deformed, moved))
    return [(title, with_wires(picture, wires, camera)) for title, picture, wires in pictures]


def materials(evidence: SceneEvidence, variants: list[AbstractVariant], path: Path) -> dict:
    """drgs2026, Fig. 6: edits of the material alone."""
    drawn = [(name, picture_of(evidence, edits)) for name, edits in EDITS.items()]
    sheet([drawn], path)
    return {"caption": "material edits under the recovered light"}


def inter_reflection(evidence: SceneEvidence, variants: list[AbstractVariant], path: Path) -> dict:
    """drgs2026, Fig. 8: light between surfaces on and off, and what it adds."""
    frames = {bounces: frame_of(evidence, [], bounces) for bounces in (STILL_BOUNCES, 0)}
    with_it, without = (on_white(rgba_of(frame)) for frame in frames.values())
    truth = on_white(read_rgba(evidence.scene.folder / "test" / f"{camera_of(evidence).name}.png"))
    window = object_window([rgba_of(frame)[..., 3] for frame in frames.values()])
    cut = [("truth", truth), ("with", with_it), ("without", without), ("4 x difference", 1 - DIFFERENCE_GAIN * np.abs(with_it - without))]
    sheet([[(name, halved(picture)[halved_window(window)]) for name, picture in cut]], path)
    figures = {"psnr_with": psnr(with_it, truth), "psnr_without": psnr(without, truth)}
    return {"caption": "inter-reflection on and off, light of the photographs", "figures": figures}


def normals_and_light(evidence: SceneEvidence, variants: list[AbstractVariant], path: Path) -> dict:
    """drgs2026, Fig. 10: normals, their error, and the recovered light beside the true one."""
    frame, camera = frame_of(evidence, [], 0), camera_of(evidence)
    true = read_true_maps(evidence.scene, camera)
    inside = true.alpha > 0.5
    normal = array_of(frame.gbuffer.normal_world)
    error = np.zeros(inside.shape)
    error[inside] = normal_error_degrees(normal[inside], true.normal_world[inside])
    window = halved_window(object_window([true.alpha]))
    maps = [
        ("true normals", colors_of_normals(true.normal_world, inside)),
        ("ours", colors_of_normals(normal, array_of(frame.gbuffer.coverage) > 0.5)),
        (f"error, white {NORMAL_ERROR_SHOWN:.0f} degrees", np.repeat(error[..., None] / NORMAL_ERROR_SHOWN, 3, -1)),
    ]
    assert evidence.scene.training_light is not None
    recovered = array_of(evidence.subject.asset.environment.radiance)
    truth = array_of(read_light(evidence.scene, evidence.scene.training_light).radiance)
    # One factor, since nobody can tell how bright light and how dark paint is.
    recovered = recovered * float(truth.mean() / recovered.mean())
    lights = [("true light", light_picture(truth)), ("recovered", light_picture(recovered))]
    sheet([[(name, halved(picture)[window]) for name, picture in maps], lights], path)
    return {"caption": "normals and the light of the photographs", "figures": {"normal_mae_of_this_view": float(error[inside].mean())}}


def material_maps(evidence: SceneEvidence, variants: list[AbstractVariant], path: Path) -> dict:
    """drgs2026, Fig. 11: materials and visibility, the truth above."""
    frame, camera = frame_of(evidence, [], 0), camera_of(evidence)
    true = read_true_maps(evidence.scene, camera)
    shown = array_of(frame.gbuffer.coverage) > 0.5
    window = halved_window(object_window([true.alpha, shown.astype(float)]))

    def grey(values: Array, where: Mask) -> Array:
        return np.where(where[..., None], np.repeat(values[..., None], 3, -1), AROUND_MAPS)

    def colour(albedo: Array, where: Mask) -> Array:
        return np.where(where[..., None], srgb_from_linear(albedo.clip(0, 1)), AROUND_MAPS)

    inside, gbuffer = true.alpha > 0.5, frame.gbuffer
    above = [
        ("true albedo", colour(true.albedo, inside)),
        ("true roughness", grey(true.roughness, inside)),
        ("true metallic", grey(true.metallic, inside)),
    ]
    below = [
        ("albedo", colour(array_of(gbuffer.albedo), shown)),
        ("roughness", grey(array_of(gbuffer.roughness), shown)),
        ("metallic", grey(array_of(gbuffer.metallic), shown)),
        ("open sky", grey(array_of(frame.radiance.visibility), shown)),
    ]
    sheet([[(name, halved(picture)[window]) for name, picture in row] for row in (above, below)], path)
    return {"caption": "material maps and visibility; albedo is known up to one factor a channel"}


def strip(evidence: SceneEvidence, variants: list[AbstractVariant], path: Path) -> dict:
    """drgs2026, Fig. 12: a continuous deformation, ours, as a strip and as a film. Its end is beside the truth, where there is one under this light."""
    (name, analytic), *_ = evidence.deformations.items()
    amount = amount_of(analytic)
    assert amount is not None
    still = AMOUNTS[amount]
    values = [still + part * (analytic[amount] - still) for part in shares()]
    frames = [rgba_of(frame_of(evidence, [{"op": "deform", "map": analytic | {amount: value}}])) for value in values]
    pictures = [on_white(rgba) for rgba in frames]
    window = object_window([rgba[..., 3] for rgba in frames])
    write_film([picture[window] for picture in pictures], path.with_suffix(".mp4"))
    sheet([[(f"{amount} {values[place]:.2f}", halved(pictures[place])) for place in STRIP]], path)
    told: dict = {"caption": f"{name}, growing", "film_shows": "there and back"}
    truths = [folder for folder, new in evidence.truths() if folder.parent.name == name and not new]
    if truths:
        truth = on_white(read_rgba(evidence.scene.folder / truths[0] / f"{camera_of(evidence).name}.png"))
        told["figures"] = {"psnr_of_its_end": psnr(pictures[-1], truth)}
    return told


def matter(evidence: SceneEvidence, variants: list[AbstractVariant], path: Path) -> dict:
    """drgs2026, Fig. 5: the same fall with soft and with stiff matter; beside it clay, which stays bent, and sand."""
    particles = max(int(PARTICLES_SHARE * evidence.settings.budget), 1)
    drawn = [("at rest", picture_of(evidence, []))]
    for title, (preset, times) in MATTERS.items():
        stiffer = {} if times is None else {"young_modulus": times * young_modulus(evidence.subject.asset, preset)}
        scene = {
            "matter": {"preset": preset, **stiffer},
            "velocity": [0, 0, -FALL["speed"]],
            "particles": particles,
            "duration": FALL["time"],
        }
        drawn.append((title, picture_of(evidence, [{"op": "simulate", "scene": scene, "time": FALL["time"]}])))
    sheet([drawn], path)
    return {"caption": f"{FALL['time']:g} s after meeting the floor at {FALL['speed']:g} units/s, {particles} particles"}


def young_modulus(asset: Asset, preset: str) -> float:
    """Of an object of this size [Pa]."""
    low, high = asset.mesh.vertices.amin(0), asset.mesh.vertices.amax(0)
    matter = parse_simulation_scene({"matter": {"preset": preset}}).matter
    return make_material(matter, float((high - low).max()), asset.meters_per_unit).young_modulus / asset.meters_per_unit


def amount_of(analytic: dict) -> str | None:
    """What of a map says how much; None where no single number does."""
    return next((key for key in analytic if key in AMOUNTS), None)


def camera_of(evidence: SceneEvidence) -> Camera:
    """The first test camera that the deformed truth has a picture of."""
    folders = [evidence.scene.folder / folder for folder, _ in evidence.truths()]
    return next(camera for camera in evidence.scene.cameras if all((folder / f"{camera.name}.png").is_file() for folder in folders))


def frame_of(evidence: SceneEvidence, edits: list[dict], bounces: int = STILL_BOUNCES) -> Frame:
    """Ours as the asset prefers to be seen."""
    settings = traced_settings(evidence.settings.samples_per_pixel, bounces)
    return render_frame(pose_scene(evidence.subject.asset, parse_edits(edits)), camera_of(evidence), settings)


def picture_of(evidence: SceneEvidence, edits: list[dict]) -> Array:
    """Half as large, on white."""
    return halved(on_white(rgba_of(frame_of(evidence, edits))))


def array_of(values: Tensor) -> Array:
    return values.detach().cpu().double().numpy()


def colors_of_normals(normals: Array, inside: Mask) -> Array:
    return np.where(inside[..., None], 0.5 + 0.5 * normals, 1.0)


def halved_window(window: tuple[slice, slice]) -> tuple[slice, slice]:
    """Of a picture that is half as large."""
    rows, columns = (
        slice(None if part.start is None else part.start // 2, None if part.stop is None else part.stop // 2) for part in window
    )
    return rows, columns


def light_picture(table: Array) -> Array:
    """An environment at 128 rows, in sRGB."""
    while table.shape[0] > 128:
        table = halved(table)
    return np.asarray(srgb_from_linear(table.clip(0, 1)), np.float64)


FIGURES: dict[str, tuple[Figure, bool]] = {
    "comparison": (lambda evidence, variants, path: deformed(evidence, variants, path, False), False),
    "comparison_relit": (lambda evidence, variants, path: deformed(evidence, variants, path, True), False),
    "materials": (materials, False),
    "inter_reflection": (inter_reflection, False),
    "poor_mesh": (poor_mesh, False),
    "normals_and_light": (normals_and_light, True),
    "material_maps": (material_maps, True),
    "strip": (strip, False),
    "matter": (matter, False),
    "laws": (laws, False),
    "dance": (dance, False),
    "dance_ways": (dance_ways, False),
}
"""By name, and whether the figure needs the scene's true maps."""
COMPARISONS = ("comparison", "comparison_relit")
DANCES = ("dance", "dance_ways")
BESIDE = {"strip": {"film": ".mp4"}, "laws": {"film": ".mp4"}, "dance": {"film": ".mp4", "curve": ".svg"}}
"""What figures write beside their picture, and its suffix."""


def figure_cells(evidence: SceneEvidence, variants: list[AbstractVariant], wanted: list[str]) -> dict[str, dict]:
    """The wanted figures, of those that the scene has truth for, by name: {"caption", "picture", ...}."""
    found = {}
    for name, (figure, _) in FIGURES.items():
        if name not in wanted or not has_truth_for(evidence, name):
            continue
        path = evidence.cells.folder / f"images/paper/{evidence.scene.name}_{name}.jpg"
        files = {"picture": path} | {what: path.with_suffix(suffix) for what, suffix in BESIDE.get(name, {}).items()}
        named = {what: str(file.relative_to(evidence.cells.folder)) for what, file in files.items()}

        def make(figure: Figure = figure, path: Path = path, named: dict = named) -> dict:
            with torch.no_grad():
                told, cost = measured(lambda: figure(evidence, variants, path))
            return told | named | {"cost": asdict(cost)}

        asked = asked_of_dance(evidence) if name in DANCES else evidence.asked
        asked = asked | ({"ways": [variant.name for variant in variants]} if name in (*COMPARISONS, "dance_ways") else {})
        with suppress(NotMade):
            found[name] = evidence.cells.cell(f"{evidence.scene.name}-figure-{name}", asked, make, list(files.values()))
    return found


def has_truth_for(evidence: SceneEvidence, name: str) -> bool:
    """Whether the scene has what a figure is about."""
    if name in DANCES:
        return rig_facts(evidence) is not None
    if name == "poor_mesh":
        return all(file.is_file() for file in checkpoints(evidence))
    if not evidence.truths() or (FIGURES[name][1] and not (has_true_maps(evidence.scene) and evidence.scene.training_light)):
        return False
    if name == "strip":
        return amount_of(next(iter(evidence.deformations.values()))) is not None
    return name not in COMPARISONS or any(new is (name == "comparison_relit") for _, new in evidence.truths())
