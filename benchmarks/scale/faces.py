"""Pictures against the faces of what they show: the same surface, cut finer."""

import psutil

from benchmarks.scale.cost_curve import CostCurve, Point
from benchmarks.scale.made_objects import bumpy_ball
from benchmarks.scale.scale_run import ScaleRun
from benchmarks.scale.timed_pictures import PICTURE_COSTS, median_seconds, picture_point
from drgs.render.intersect.trace_rays import build_tracer


def faces(run: ScaleRun) -> CostCurve:
    """A moving picture, a first still pass, the tree that rays search, and the resident memory of this process behind them."""
    points = [_point(count, run) for count in sorted(run.sizes.faces)]
    costs = PICTURE_COSTS | {"tree_seconds": "tree of faces"}
    return CostCurve("faces", "faces of the mesh", points, costs)


def _point(count: int, run: ScaleRun) -> Point:
    """Of a mesh that is forgotten again; smaller ones come first, so that memory is this one's."""
    asset = bumpy_ball(count, run.device)
    point = {"x": len(asset.mesh.faces)} | picture_point(asset, run.sizes.faces_side, run)
    point["tree_seconds"], _ = median_seconds(lambda: build_tracer(asset.mesh), run.repeats, run.device)
    point["memory_mib"] = round(psutil.Process().memory_info().rss / 2**20)
    return point
