"""What it costs to bind surfels to the mesh, what each part of that is worth, and how each rule moves them.

    python -m benchmarks binding SOURCE [--dataset DATASET] [--preset fast] [--iterations N] [--spp 64] [--lights training|all]
                                 [--out FOLDER] [--json]

SOURCE is a capture, or the OUT of an earlier `drgs build` whose checkpoints are still beside it (then name its --dataset).
`static`: test views as the fit itself draws them (split sum), PSNR of the surfels as fitted (particles), rebuilt on the mesh, and rebuilt
without a part: the ablations of drgs2026, Fig. 9 (offset, opacity), and Alg. 1 as printed. `--iterations 0` leaves this table out.
`deform`: finished assets of both bindings under the capture's own deformations, given as a map (surfels by the exact rule and by Eq. 7), and as
moved vertices by the corrected and by the printed Eq. 8, traced and scored like `drgs eval`.
"""

import argparse
import json
import shutil
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor

from drgs.deform.carry.carry_gaussians import carry_tangents
from drgs.deform.carry.drive_mesh import drive_surfels, vertex_gradients
from drgs.deform.displace.maps import evaluate_map
from drgs.deform.pose_scene import pose_scene
from drgs.evaluate.metrics import picture_figures, score_renders, truth_folders
from drgs.maths.color import srgb_from_linear
from drgs.reconstruct.build_asset import BuildSettings, build_asset, build_stages
from drgs.reconstruct.capture.initial_points import initial_points
from drgs.reconstruct.capture.load_views import load_cameras, load_views
from drgs.reconstruct.checkpoints import read_tensors
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.surfels.fit_mesh_surfels import MeshFitSettings, fit_mesh_surfels, start_mesh_fit, surfels_on_faces
from drgs.reconstruct.fit.surfels.render_stage_one import render_stage_one
from drgs.reconstruct.geometry.mesh_from_gaussians import reduced_mesh
from drgs.reconstruct.geometry.mesh_surfels import mesh_surfels
from drgs.reconstruct.presets import PRESETS
from drgs.reconstruct.stages import CHECKPOINTS, read_geometry
from drgs.render.records import RenderSettings
from drgs.render.render_cameras import render_cameras
from drgs.render.visible.rasterize.near_plane import near_plane
from drgs.scene.asset import Asset
from drgs.scene.camera import Camera
from drgs.scene.edits import DeformEdit, Edit, parse_edits
from drgs.scene.gaussians import surfel_tangents
from drgs.scene.posed_scene import PosedScene
from drgs.warp_torch import device_from_name

VARIANTS: dict[str, dict[str, Any]] = {
    "mesh": {},
    "mesh_without_offset": {"learn_offset": False},
    "mesh_without_opacity": {"learn_opacity": False},
    "mesh_paper": {"variant": "paper"},
}
"""Settings that differ from MeshFitSettings."""
DRIVERS = ("map", "map_paper", "vertices", "vertices_paper")


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks binding", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("source", type=Path)
    parser.add_argument("--dataset", type=Path, help="the capture of an earlier build")
    parser.add_argument("--preset", default="fast", choices=list(PRESETS))
    parser.add_argument("--iterations", type=int, default=120, help="of each variant's fine-tuning; 0: no static table")
    parser.add_argument("--spp", type=int, default=64, help="rays a pixel of the deformed pictures; 0: no deformed table")
    parser.add_argument("--lights", default="training", choices=["training", "all"])
    parser.add_argument("--device", default="cpu", choices=["auto", "cpu", "cuda"])
    parser.add_argument("--out", type=Path, help="keep assets, checkpoints and pictures here, and go on from them")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    built = Path(f"{given.source}.build")
    if not (built / "stage1.safetensors").is_file():
        if given.dataset is not None:
            raise ValueError(f"{built} holds no stage1.safetensors; expected what an earlier drgs build left")
        given.dataset = given.source
    elif given.dataset is None:
        raise ValueError("--dataset is missing; expected the capture that SOURCE was built from")
    with tempfile.TemporaryDirectory() as temporary:
        work = given.out or Path(temporary)
        for binding in ("particles", "mesh"):
            (work / f"{binding}.build").mkdir(parents=True, exist_ok=True)
            for name in CHECKPOINTS:
                if (built / name).is_file() and not (work / f"{binding}.build" / name).exists():
                    shutil.copyfile(built / name, work / f"{binding}.build" / name)
        result: dict = {"scene": given.dataset.name, "preset": given.preset}
        prepare(given.dataset, work, given.preset, given.device)
        if given.iterations > 0:
            result |= {
                "iterations": given.iterations,
                "static": static_table(given.dataset, work, given.preset, given.iterations, given.device),
            }
        if given.spp > 0:
            result["deform"] = deform_table(given.dataset, work, given.preset, given.spp, given.lights == "all", given.device)
    print(json.dumps(result, indent=None if given.json else 1))


def prepare(dataset: Path, work: Path, preset: str, device: str) -> None:
    """Stage 1 and the mesh, once for both bindings."""
    settings = BuildSettings(preset=preset, device=device, resume=True)
    for stage, _ in build_stages(dataset, work / "particles", settings):
        if stage == "mesh":
            break
    for name in ("stage1.safetensors", "mesh.safetensors"):
        shutil.copyfile(work / "particles.build" / name, work / "mesh.build" / name)


def static_table(dataset: Path, work: Path, preset_name: str, iterations: int, device_name: str) -> dict:
    """Figures of test views, drawn as the fit draws them, and seconds of fine-tuning."""
    preset, device = PRESETS[preset_name], device_from_name(device_name)
    views = load_views(dataset, max_side=preset.image_side)
    radius = initial_points(views, preset.points, 0).bounds_radius
    tensors, _ = read_tensors(work / "particles.build" / "stage1.safetensors", device)
    stage_one = {name.removeprefix("parameter."): value for name, value in tensors.items() if name.startswith("parameter.")}
    gaussians, mesh = read_geometry(work / "particles.build" / "mesh.safetensors", device)
    table = {"particles": {"surfels": len(stage_one["centers"])} | figures_of_fit(stage_one, dataset, radius)}
    coarse = reduced_mesh(mesh, preset.fit.densify.budget, radius)
    for name, changes in VARIANTS.items():
        settings = replace(MeshFitSettings(), iterations=iterations, **changes)
        started = time.perf_counter()
        state = start_mesh_fit(*mesh_surfels(gaussians, coarse, settings.variant), coarse, stage_one, settings)
        seconds = time.perf_counter() - started
        before = figures_of_fit(surfels_on_faces(state), dataset, radius)
        started = time.perf_counter()
        fit_mesh_surfels(views, state, settings, radius)
        table[name] = {
            "surfels": len(state.face),
            "rebuild_seconds": round(seconds, 2),
            "fit_seconds": round(time.perf_counter() - started, 1),
            "psnr_before_fit": before["psnr"],
        } | figures_of_fit(surfels_on_faces(state), dataset, radius)
        print(f"binding: {name} {table[name]['psnr']:.2f} dB", file=sys.stderr)
    return table


def figures_of_fit(parameters: dict[str, Tensor], dataset: Path, radius: float) -> dict:
    """PSNR and SSIM on white over the capture's test views."""
    pairs, tables = [], tables_of_fit(parameters)
    for camera in load_cameras(dataset / "transforms_test.json"):
        with Image.open(dataset / "test" / f"{camera.name}.png") as picture:
            pairs.append((picture_of_fit(parameters, tables, camera, radius), np.asarray(picture.convert("RGBA"), np.float64) / 255))
    figures = picture_figures(pairs)
    return {name: round(figures[name], 4) for name in ("psnr", "ssim")}


@torch.no_grad()
def tables_of_fit(parameters: dict[str, Tensor]) -> Float[Tensor, "texel 3"]:
    """Of its light."""
    return filter_environment(environment_table(parameters))


@torch.no_grad()
def picture_of_fit(parameters: dict[str, Tensor], tables: Float[Tensor, "texel 3"], camera: Camera, radius: float) -> NDArray[np.float64]:
    """(height, width, 4) straight alpha, sRGB, 0..1, as the fit draws it."""
    maps = render_stage_one(parameters, tables, camera.to(parameters["centers"].device), near_plane(radius), 3)
    rgba = torch.cat([srgb_from_linear(maps.radiance_linear).clamp(0, 1), maps.coverage.clamp(0, 1)[..., None]], -1)
    return rgba.double().cpu().numpy()


def deform_table(dataset: Path, work: Path, preset: str, samples: int, all_lights: bool, device: str) -> dict:
    """Figures of deformed pictures by binding and driver."""
    facts = json.loads((dataset / "scene.json").read_text())
    settings = RenderSettings(samples_per_pixel=samples, primary="gaussians")  # it is they whose driving is compared
    cameras = load_cameras(dataset / "transforms_test.json")
    table: dict = {}
    for binding in ("particles", "mesh"):
        asset = build_asset(dataset, work / binding, BuildSettings(preset=preset, binding=binding, device=device, resume=True))
        for driver in DRIVERS:
            renders = work / "renders" / f"{binding}-{driver}"
            for truth in truth_folders(dataset, "deform/*/*"):
                if not all_lights and truth.name != facts["train_env"]:
                    continue
                light = [] if truth.name == facts["train_env"] else _light(dataset, truth.name)
                wanted = [camera for camera in cameras if (truth / f"{camera.name}.png").exists()]
                scene = driven(asset, facts["deform"][truth.parent.name], driver, light, work)
                render_cameras(scene, wanted, renders / truth.relative_to(dataset), settings)
            figures = score_renders(dataset, renders)["deform"]
            table.setdefault(binding, {})[driver] = {
                place: {name: round(value, 4) for name, value in row.items() if name in ("psnr", "ssim", "psnr_scaled")}
                for place, row in figures.items()
            }
            print(f"binding: {binding} {driver} {table[binding][driver]}", file=sys.stderr)
    return table


def driven(asset: Asset, analytic_map: dict, driver: str, light: list[Edit], folder: Path) -> PosedScene:
    """The asset deformed by a map: known everywhere, or only at the mesh's vertices, from which the surfels follow by Eq. 8."""
    (edit,) = parse_edits([{"op": "deform", "map": analytic_map}])
    if driver == "map":
        return pose_scene(asset, [edit, *light])
    assert isinstance(edit, DeformEdit) and edit.map is not None
    if driver == "map_paper":
        scene, gaussians = pose_scene(asset, [edit, *light]), asset.gaussians
        assert gaussians is not None and scene.surfels is not None
        _, gradients = evaluate_map(edit.map, gaussians.centers)
        tangents = carry_tangents(surfel_tangents(gaussians), gradients, "paper")
        return replace(scene, surfels=replace(scene.surfels, tangents=tangents))
    vertices, _ = evaluate_map(edit.map, asset.mesh.vertices)
    path = (folder / "moved.npz").resolve()
    np.savez(path, vertices=vertices.cpu().numpy())
    scene = pose_scene(asset, [*parse_edits([{"op": "deform", "vertices": str(path)}]), *light])
    if driver == "vertices":
        return scene
    mesh, gaussians, binding = asset.mesh, asset.gaussians, asset.binding
    assert gaussians is not None and binding is not None and scene.surfels is not None
    gradients = vertex_gradients(mesh.vertices, vertices, mesh.faces)
    tangents = surfel_tangents(gaussians)
    centers, tangents = drive_surfels(mesh.vertices, vertices, mesh.faces, gradients, binding, gaussians.centers, tangents, "paper")
    return replace(scene, surfels=replace(scene.surfels, centers=centers, tangents=tangents))


def _light(dataset: Path, name: str) -> list[Edit]:
    return parse_edits([{"op": "environment", "file": str((dataset / "env" / f"{name}.exr").resolve())}])


if __name__ == "__main__":
    main(sys.argv[1:])
