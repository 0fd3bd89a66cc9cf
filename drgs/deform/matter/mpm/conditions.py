"""Boundary conditions on the grid's nodes: planes, spheres, boxes and solids that hold, guide, stop or push (docs: Condition in records.py)."""

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.deform.matter.mpm.records import Box, Condition, Plane, Solid, Sphere
from drgs.maths.constants import UNBOUNDED

wp.set_module_options({"enable_backward": False})

SHAPES = (Plane, Sphere, Box, Solid)
EFFECTS = ("sticky", "slip", "separate", "push")
FAR_FUTURE = 1e30
WIDTH = 17
"""Numbers in a condition's row: shape, effect, friction, start, end, point 3, second 3 (normal, radius, half extents, or spacing and place
of a solid's distances), velocity 3, nodes of a solid's lattice 3."""
MOST_DISTANCES = 1 << 24
"""Of all solids: places up to here are exact in float32."""


def pack_conditions(
    conditions: tuple[Condition, ...], device: torch.device
) -> tuple[Float[Tensor, "condition width"], Float[Tensor, "distance"]]:
    """(condition, WIDTH) float32, one row each, and the distances of all solids, as `apply_conditions` reads them.

    Raises:
        ValueError: a shape without size, a normal of length 0, or more solids than fit.
    """
    rows, distances, place = [], [torch.zeros(1, device=device)], 1
    for condition in conditions:
        shape = condition.shape
        point: tuple[float, ...]
        second: tuple[float, ...]
        nodes: tuple[int, ...] = (0, 0, 0)
        if isinstance(shape, Plane):
            length = sum(c * c for c in shape.normal) ** 0.5
            if not length > 0:
                raise ValueError(f"the plane through {shape.point} has the normal {shape.normal}; expected a direction")
            point, second = shape.point, tuple(c / length for c in shape.normal)
        elif isinstance(shape, Sphere):
            if not shape.radius > 0:
                raise ValueError(f"the sphere at {shape.center} has the radius {shape.radius}; expected a positive one")
            point, second = shape.center, (shape.radius, 0.0, 0.0)
        elif isinstance(shape, Solid):
            point, second, nodes = shape.minimum, (shape.spacing, float(place), 0.0), tuple(shape.distances.shape)
            distances.append(shape.distances.to(device, torch.float32).reshape(-1))
            place += shape.distances.numel()
            if place > MOST_DISTANCES:
                raise ValueError(f"all solids together have more than {MOST_DISTANCES} distances: use fewer, or a larger spacing")
        else:
            point = tuple((low + high) / 2 for low, high in zip(shape.minimum, shape.maximum, strict=True))
            second = tuple((high - low) / 2 for low, high in zip(shape.minimum, shape.maximum, strict=True))
            if min(second) <= 0:
                raise ValueError(f"the box {shape.minimum} to {shape.maximum} is empty")
        kinds = (float(SHAPES.index(type(shape))), float(EFFECTS.index(condition.effect)))
        window = (condition.start, min(condition.end, FAR_FUTURE))
        rows.append((*kinds, condition.friction, *window, *point, *second, *condition.velocity, *map(float, nodes)))
    return torch.tensor(rows, dtype=torch.float32, device=device).reshape(-1, WIDTH), torch.cat(distances)


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
def distance_from_solid(q: wp.vec3, place: int, nx: int, ny: int, nz: int, distances: wp.array[float]):
    """Trilinear, at q in cells from the lattice's first node; negative inside, huge beyond the lattice."""
    x = int(wp.floor(q[0]))
    y = int(wp.floor(q[1]))
    z = int(wp.floor(q[2]))
    if x < 0 or y < 0 or z < 0 or x > nx - 2 or y > ny - 2 or z > nz - 2:
        return float(UNBOUNDED)
    fy = q[1] - float(y)
    fz = q[2] - float(z)
    low = place + (x * ny + y) * nz + z
    high = low + ny * nz
    near = wp.lerp(wp.lerp(distances[low], distances[low + 1], fz), wp.lerp(distances[low + nz], distances[low + nz + 1], fz), fy)
    far = wp.lerp(wp.lerp(distances[high], distances[high + 1], fz), wp.lerp(distances[high + nz], distances[high + nz + 1], fz), fy)
    return wp.lerp(near, far, q[0] - float(x))


@wp.func
def normal_of_solid(q: wp.vec3, place: int, nx: int, ny: int, nz: int, distances: wp.array[float]):
    """Outward, at a point inside: differences over one cell, centred, so that a curved surface tilts no normal to one side."""
    x = wp.vec3(0.5, 0.0, 0.0)
    y = wp.vec3(0.0, 0.5, 0.0)
    z = wp.vec3(0.0, 0.0, 0.5)
    slope = wp.vec3(
        distance_from_solid(q + x, place, nx, ny, nz, distances) - distance_from_solid(q - x, place, nx, ny, nz, distances),
        distance_from_solid(q + y, place, nx, ny, nz, distances) - distance_from_solid(q - y, place, nx, ny, nz, distances),
        distance_from_solid(q + z, place, nx, ny, nz, distances) - distance_from_solid(q - z, place, nx, ny, nz, distances),
    )
    return wp.normalize(slope)


@wp.func
def apply_conditions(
    position: wp.vec3, velocity: wp.vec3, dt: float, time: float, conditions: wp.array2d[float], distances: wp.array[float]
):
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
            elif shape == 3:
                cells = q / second[0]
                place = int(second[1])
                nx = int(conditions[c, 14])
                ny = int(conditions[c, 15])
                nz = int(conditions[c, 16])
                inside = distance_from_solid(cells, place, nx, ny, nz, distances) <= 0.0
                if inside:
                    n = normal_of_solid(cells, place, nx, ny, nz, distances)
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
