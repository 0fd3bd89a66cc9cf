"""Boundary conditions on the grid's nodes: planes, spheres and boxes that hold, guide, stop or push (docs: Condition in records.py)."""

import torch
import warp as wp
from torch import Tensor

from drgs.deform.mpm.records import Box, Condition, Plane, Sphere

wp.set_module_options({"enable_backward": False})

SHAPES = (Plane, Sphere, Box)
EFFECTS = ("sticky", "slip", "separate", "push")
FAR_FUTURE = 1e30
WIDTH = 14
"""Numbers in a condition's row: shape, effect, friction, start, end, point 3, second 3 (normal, radius or half extents), velocity 3."""


def pack_conditions(conditions: tuple[Condition, ...], device: torch.device) -> Tensor:
    """(condition, WIDTH) float32, one row each, as `apply_conditions` reads them.

    Raises:
        ValueError: a shape without size or a normal of length 0.
    """
    rows = []
    for condition in conditions:
        shape = condition.shape
        if isinstance(shape, Plane):
            length = sum(c * c for c in shape.normal) ** 0.5
            if not length > 0:
                raise ValueError(f"the plane through {shape.point} has the normal {shape.normal}; expected a direction")
            point, second = shape.point, tuple(c / length for c in shape.normal)
        elif isinstance(shape, Sphere):
            if not shape.radius > 0:
                raise ValueError(f"the sphere at {shape.center} has the radius {shape.radius}; expected a positive one")
            point, second = shape.center, (shape.radius, 0.0, 0.0)
        else:
            point = tuple((low + high) / 2 for low, high in zip(shape.minimum, shape.maximum, strict=True))
            second = tuple((high - low) / 2 for low, high in zip(shape.minimum, shape.maximum, strict=True))
            if min(second) <= 0:
                raise ValueError(f"the box {shape.minimum} to {shape.maximum} is empty")
        kinds = (float(SHAPES.index(type(shape))), float(EFFECTS.index(condition.effect)))
        rows.append((*kinds, condition.friction, condition.start, min(condition.end, FAR_FUTURE), *point, *second, *condition.velocity))
    return torch.tensor(rows, dtype=torch.float32, device=device).reshape(-1, WIDTH)


@wp.func
def nearest_face(q: wp.vec3, half: wp.vec3):
    """Outward normal of the face of a box, centred at 0, that a point inside is nearest to."""
    depth = half - wp.vec3(wp.abs(q[0]), wp.abs(q[1]), wp.abs(q[2]))
    n = wp.vec3(0.0, 0.0, wp.sign(q[2]))
    if depth[0] <= depth[1] and depth[0] <= depth[2]:
        n = wp.vec3(wp.sign(q[0]), 0.0, 0.0)
    elif depth[1] <= depth[2]:
        n = wp.vec3(0.0, wp.sign(q[1]), 0.0)
    return n


@wp.func
def apply_conditions(position: wp.vec3, velocity: wp.vec3, dt: float, time: float, conditions: wp.array2d(dtype=float)):
    """A node's velocity after all conditions, in their order."""
    v = velocity
    for c in range(conditions.shape[0]):
        start = conditions[c, 3]
        if time >= start and time < conditions[c, 4]:
            shape = int(conditions[c, 0])
            effect = int(conditions[c, 1])
            own = wp.vec3(conditions[c, 11], conditions[c, 12], conditions[c, 13])
            second = wp.vec3(conditions[c, 8], conditions[c, 9], conditions[c, 10])
            moved = wp.vec3()
            if effect != 3:
                moved = (time - start) * own
            q = position - wp.vec3(conditions[c, 5], conditions[c, 6], conditions[c, 7]) - moved
            inside = wp.bool(False)
            n = second
            if shape == 0:
                inside = wp.dot(q, n) <= 0.0
            elif shape == 1:
                distance = wp.length(q)
                inside = distance <= second[0]
                n = q / wp.max(distance, 1.0e-20)
            else:
                inside = wp.abs(q[0]) <= second[0] and wp.abs(q[1]) <= second[1] and wp.abs(q[2]) <= second[2]
                n = nearest_face(q, second)
            if inside:
                if effect == 3:
                    v = v + dt * own
                elif effect == 0:
                    v = own
                else:
                    u = v - own
                    normal = wp.dot(u, n)
                    if effect == 1 or normal < 0.0:
                        along = u - normal * n
                        if effect == 2:
                            speed = wp.length(along)
                            along = along * wp.max(0.0, 1.0 + conditions[c, 2] * normal / wp.max(speed, 1.0e-20))
                        v = own + along
    return v
