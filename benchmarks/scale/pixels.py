"""Pictures against their pixels."""

from benchmarks.scale.cost_curve import CostCurve
from benchmarks.scale.scale_run import ScaleRun
from benchmarks.scale.timed_pictures import PICTURE_COSTS, picture_point, shown_asset


def pixels(run: ScaleRun) -> CostCurve:
    """A moving picture and a first still pass, of the user's asset or a made object."""
    asset = shown_asset(run)
    points = [{"x": side * side, "side": side} | picture_point(asset, side, run) for side in run.sizes.pixels]
    return CostCurve("pixels", "pixels of a picture", points, PICTURE_COSTS)
