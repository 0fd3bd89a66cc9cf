"""A still picture against its rays a pixel."""

from benchmarks.scale.cost_curve import CostCurve, Point
from benchmarks.scale.scale_run import ScaleRun
from benchmarks.scale.timed_pictures import shown_asset, still_seconds


def samples(run: ScaleRun) -> CostCurve:
    """In passes as `drgs render` makes them, of the user's asset or a made object."""
    asset, points = shown_asset(run), list[Point]()
    for rays in run.sizes.samples:
        seconds, cpu_seconds = still_seconds(asset, run.sizes.samples_side, rays, None, run.repeats)
        points.append({"x": rays, "seconds": seconds, "cpu_seconds": cpu_seconds})
    return CostCurve("samples", "rays a pixel", points)
