"""What the surface's fit makes of a build: normals by shading, positions by normals and masks, materials by traced light on the mesh.

    python -m benchmarks surface BUILT DATASET OUT [--passes 7] [--material-steps 300] [--seed 0] [--json]

BUILT is the OUT of an earlier `drgs build` whose checkpoints (BUILT.build) are still beside it. OUT becomes an asset whose mesh is the refined
one, with a surfel on each of its faces: score it with `drgs eval OUT DATASET` and, as its mesh alone, `drgs render OUT ... --primary mesh`.
The builds of `drgs build` do not take this way yet: docs/decisions/0003-fitting.md says what it gains and where it loses.
"""

import argparse
import json
import sys
import time
from dataclasses import replace
from pathlib import Path

import torch

from drgs.reconstruct.build_asset import PRESETS
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.checkpoints import read_tensors
from drgs.reconstruct.fit.environment_pyramid import environment_table
from drgs.reconstruct.fit.fit_mesh_materials import MeshMaterialSettings, fit_mesh_materials, start_mesh_materials
from drgs.reconstruct.fit.fit_surface import mesh_from_surface_fit, start_surface
from drgs.reconstruct.fit.surface_passes import PassSettings, fit_surface_in_passes
from drgs.reconstruct.geometry.face_surfels import radiating_surfels
from drgs.reconstruct.stages import FIT, MESH, read_geometry
from drgs.scene.asset import Asset, load_asset, save_asset
from drgs.scene.environment import Environment


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks surface", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("built", type=Path)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--passes", type=int, default=PassSettings.passes)
    parser.add_argument("--material-steps", type=int, default=MeshMaterialSettings.iterations)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args(arguments)
    row = refine(
        given.built, given.dataset, given.out, PassSettings(given.passes, replace(PassSettings().surface, seed=given.seed)),
        MeshMaterialSettings(iterations=given.material_steps, seed=given.seed),
    )  # fmt: skip
    print(json.dumps(row) if given.json else "  ".join(f"{name} {value}" for name, value in row.items()))
    return 0


def refine(built: Path, dataset: Path, out: Path, surface: PassSettings, materials: MeshMaterialSettings) -> dict:
    """Write the refined asset; seconds of both fits, and the refined mesh's faces.

    Raises:
        ValueError: there are no checkpoints, or they are damaged.
    """
    folder, cpu = Path(f"{built}.build"), torch.device("cpu")
    if not (folder / FIT).exists() or not (folder / MESH).exists():
        raise ValueError(f"{folder} holds no {FIT} and {MESH}; expected the checkpoints of `drgs build {dataset} {built}`: build it first")
    old = load_asset(built, cpu)
    views = load_views(dataset, max_side=PRESETS[old.provenance["preset"]].image_side)
    gaussians, mesh = read_geometry(folder / MESH, cpu)
    prefix = "parameter."
    light = {
        name.removeprefix(prefix): value
        for name, value in read_tensors(folder / FIT, cpu)[0].items()
        if name.startswith(f"{prefix}environment_")
    }
    center = 0.5 * (mesh.vertices.amin(0) + mesh.vertices.amax(0))
    radius = float((mesh.vertices - center).norm(dim=1).max())
    clock = time.monotonic()
    state = start_surface(gaussians, mesh, light, surface.surface, radius)
    state, faces = fit_surface_in_passes(
        views,
        mesh,
        state,
        surface,
        radius,
        lambda index, r: print(f"\rsurface, pass {index + 1}: {r.iteration}/{r.iterations} {r.psnr:.2f} dB", end="", file=sys.stderr),
    )
    fitted = time.monotonic()
    state = start_mesh_materials(state, materials, radius)
    fit_mesh_materials(
        views,
        faces,
        state,
        materials,
        lambda r: print(f"\rmaterials {r.iteration}/{r.iterations} {r.psnr:.2f} dB", end="", file=sys.stderr),
    )
    done = time.monotonic()
    refined = mesh_from_surface_fit(state, faces)
    environment = Environment(environment_table(state.parameters).detach())
    surfels, binding = radiating_surfels(refined, environment)
    save_asset(
        Asset(surfels, refined, binding, environment, views.cameras, provenance=old.provenance | {"refined": "benchmarks surface"}), out
    )
    return {
        "surface_seconds": round(fitted - clock, 1),
        "materials_seconds": round(done - fitted, 1),
        "faces": len(faces),
    }
