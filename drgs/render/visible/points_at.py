"""Some of the points that a pass sees."""

from dataclasses import replace

from torch import Tensor

from drgs.render.records import PrimaryPoints, RayStarts, ShadingPoints


def points_at(primary: PrimaryPoints, here: Tensor) -> PrimaryPoints:
    """The points with the numbers (chosen,) int64, in that order."""
    points = ShadingPoints(**{name: values[here] for name, values in vars(primary.points).items()})
    starts = primary.starts
    face = None if starts.face is None else starts.face[here]
    barycentric, rays = (None if values is None else values[here] for values in (primary.barycentric, primary.ray))
    chosen = RayStarts(starts.origin_world[here], starts.surface_normal_world[here], face)
    return replace(primary, points=points, starts=chosen, depth=primary.depth[here], barycentric=barycentric, ray=rays)
