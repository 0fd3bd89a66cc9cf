"""The G-buffer of Gaussians against how many there are: a torus covered by surfels that are as much smaller as they are more."""

import torch

from benchmarks.render.rasterize import load_workload
from benchmarks.scale.cost_curve import CostCurve, Point
from benchmarks.scale.scale_run import ScaleRun
from benchmarks.scale.timed_pictures import median_seconds
from benchmarks.scenes.torus_workload import write_torus_workload
from drgs.render.visible.rasterize import rasterize_gbuffer
from drgs.scene.materials import Materials
from drgs.scene.posed_scene import PosedSurfels


def surfels(run: ScaleRun) -> CostCurve:
    """Seconds of one G-buffer at 400 x 400."""
    return CostCurve("surfels", "surfels", [_point(count, run) for count in run.sizes.surfels])


def _point(count: int, run: ScaleRun) -> Point:
    path = run.folder / f"torus_{count}.npz"
    write_torus_workload(path, count)
    camera, torus = load_workload(path, run.device)
    centers, tangents, opacities, features = (values.detach() for values in torus)
    materials = Materials(features[:, :3].contiguous(), features[:, 3].contiguous(), features[:, 4].contiguous())
    posed = PosedSurfels(centers, tangents, opacities, materials)
    with torch.no_grad():
        seconds, cpu_seconds = median_seconds(lambda: rasterize_gbuffer(posed, camera), run.repeats, run.device)
    return {"x": count, "seconds": seconds, "cpu_seconds": cpu_seconds}
