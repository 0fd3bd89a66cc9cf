"""Gaussians bound to a deliberately poor mesh, and what learning their offsets and opacities there is worth.

In: the checkpoints that the build of a scene's asset left. Out: a sheet of one test view, and a row for each of what is learned. The mesh is the fused one with few faces, its
vertices moved at random along their normals; a Gaussian on each face is fitted to the photographs as `python -m benchmarks binding` does.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from benchmarks.deform.binding import VARIANTS, figures_of_fit, picture_of_fit, tables_of_fit
from benchmarks.paper.sheets import object_window, sheet
from benchmarks.paper.tables import SceneEvidence
from benchmarks.paper.variant import AbstractVariant
from benchmarks.paper.wires import with_wires
from benchmarks.scenes.bench_scene import read_rgba
from drgs.evaluate.metrics import on_white, psnr
from drgs.reconstruct.checkpoints import read_tensors
from drgs.reconstruct.fit.surfels.fit_mesh_surfels import MeshFitSettings, fit_mesh_surfels, start_mesh_fit, surfels_on_faces
from drgs.reconstruct.geometry.mesh_from_gaussians import reduced_mesh
from drgs.reconstruct.geometry.mesh_surfels import mesh_surfels
from drgs.reconstruct.stages import FIT, MESH, read_geometry
from drgs.scene.mesh import TriangleMesh, vertex_normals

FACES = 4000
ROUGHNESS = 0.02
"""Standard deviation of vertices along their normals [radii of the object]."""
ITERATIONS = 120
LEARNED = {"mesh": "both learned", "mesh_without_offset": "no offsets", "mesh_without_opacity": "opacities as taken over"}
"""Of binding's variants, and what they are called here."""


def poor_mesh(evidence: SceneEvidence, variants: list[AbstractVariant], path: Path) -> dict:
    """drgs2026, Fig. 9."""
    fit, geometry = checkpoints(evidence)
    tensors, _ = read_tensors(fit, torch.device("cpu"))
    stage_one = {name.removeprefix("parameter."): value for name, value in tensors.items() if name.startswith("parameter.")}
    gaussians, mesh = read_geometry(geometry, torch.device("cpu"))
    radius = 0.5 * float((mesh.vertices.amax(0) - mesh.vertices.amin(0)).norm())
    poor, camera = spoiled(reduced_mesh(mesh, FACES, radius), radius), evidence.scene.cameras[0]
    truth = read_rgba(evidence.scene.folder / "test" / f"{camera.name}.png")
    rows, drawn, alphas = [], [], [truth[..., 3]]
    for name, title in LEARNED.items():
        settings = replace(MeshFitSettings(), iterations=ITERATIONS, **VARIANTS[name])
        with torch.enable_grad():
            state = start_mesh_fit(*mesh_surfels(gaussians, poor, settings.variant), poor, stage_one, settings)
            fit_mesh_surfels(evidence.subject.views, state, settings, radius)
        surfels = surfels_on_faces(state)
        rgba = picture_of_fit(surfels, tables_of_fit(surfels), camera, radius)
        figures = figures_of_fit(surfels, evidence.scene.folder, radius)
        rows.append({"on a poor mesh": title, "PSNR": f"{figures['psnr']:.2f}", "SSIM": f"{figures['ssim']:.3f}"})
        drawn.append((f"{title}, {psnr(on_white(rgba), on_white(truth)):.1f} dB", on_white(rgba)))
        alphas.append(rgba[..., 3])
    wires = with_wires(np.ones((camera.height, camera.width, 3)), poor, camera)
    window = object_window([*alphas, 1 - wires[..., 0]])
    sheet([[(title, picture[window]) for title, picture in [("truth", on_white(truth)), ("the poor mesh", wires), *drawn]]], path)
    told = f"a Gaussian on each of {len(poor.faces)} faces of a mesh made poor, fitted to the photographs in {ITERATIONS} steps"
    return {"caption": told, "rows": rows}


def checkpoints(evidence: SceneEvidence) -> tuple[Path, Path]:
    """The fitted Gaussians and the fused mesh, where the asset's build has left them."""
    folder = Path(f"{evidence.asset_path}.build")
    return folder / FIT, folder / MESH


def spoiled(mesh: TriangleMesh, radius: float) -> TriangleMesh:
    """Vertices moved at random along their normals, the same way each time."""
    numbers = torch.Generator().manual_seed(0)
    along = ROUGHNESS * radius * torch.randn(len(mesh.vertices), 1, generator=numbers)
    vertices = mesh.vertices + along * vertex_normals(mesh.vertices, mesh.faces)
    return replace(mesh, vertices=vertices, normals=vertex_normals(vertices, mesh.faces))
