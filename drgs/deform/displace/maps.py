"""Analytic deformations: where a point goes, and the exact deformation gradient F there (design: Edits).

In: points (n, 3) in world units, z up. Out: moved points and F = d x' / d x. Evaluated in float64, returned in the points' type.
Source: Barr 1984 (twist, bend), Sederberg & Parry 1986 (lattice); docs/sources.md.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.scene.edits import AnalyticMap, BendMap, LatticeMap, StretchMap, TwistMap

MAX_CONTROL_POINTS = 16
"""Along one axis of a lattice."""


def evaluate_map(analytic: AnalyticMap, points_world: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Moved points (n, 3) and deformation gradients (n, 3, 3).

    Raises:
        ValueError: a lattice whose control points form no box of at least 2x2x2.
    """
    points = points_world.double()
    match analytic:
        case TwistMap():
            moved, gradient = _twist(points, analytic.rate)
        case BendMap():
            moved, gradient = _bend(points, analytic.curvature)
        case StretchMap():
            side = analytic.factor**-0.5
            scale = points.new_tensor([side, side, analytic.factor])
            moved, gradient = points * scale, torch.diag(scale).expand(len(points), 3, 3)
        case LatticeMap():
            moved, gradient = _lattice(points, analytic)
    return moved.to(points_world.dtype), gradient.to(points_world.dtype)


def check_map(analytic: AnalyticMap, vertices_world: Float[Tensor, "vertex 3"]) -> None:
    """Refuse a bend so strong that the object would pass through its centre of curvature.

    Raises:
        ValueError: J = 1 - k x is not positive at some vertex.
    """
    if isinstance(analytic, BendMap) and len(vertices_world):
        smallest = float((1 - analytic.curvature * vertices_world[:, 0].double()).min())
        if smallest <= 0:
            reach = vertices_world[:, 0].max() if analytic.curvature > 0 else vertices_world[:, 0].min()
            raise ValueError(
                f"a bend of curvature {analytic.curvature:g} folds the object through itself; "
                f"it reaches x = {float(reach):g}, so |curvature| must stay below {abs(1 / float(reach)):g}"
            )


def _matrix(rows: list[list[Tensor]]) -> Float[Tensor, "n 3 3"]:
    return torch.stack([torch.stack(row, -1) for row in rows], -2)


def _twist(points: Float[Tensor, "n 3"], rate: float) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    x, y, z = points.unbind(-1)
    cos, sin, zero, one = torch.cos(rate * z), torch.sin(rate * z), torch.zeros_like(x), torch.ones_like(x)
    turned_x, turned_y = cos * x - sin * y, sin * x + cos * y
    gradient = _matrix([[cos, -sin, -rate * turned_y], [sin, cos, rate * turned_x], [zero, zero, one]])
    return torch.stack([turned_x, turned_y, z], -1), gradient


def _bend(points: Float[Tensor, "n 3"], k: float) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """x' = 1/k - r cos phi and z' = r sin phi with r = 1/k - x, rewritten with sin(t)/t so that k = 0 is the identity."""
    x, y, z = points.unbind(-1)
    phi = k * z
    cos, sin, zero, one = torch.cos(phi), torch.sin(phi), torch.zeros_like(x), torch.ones_like(x)
    stretch = 1 - k * x  # k r
    half = torch.sin(phi / 2) * torch.sinc(phi / (2 * math.pi))  # (1 - cos phi) / phi
    moved = torch.stack([x * cos + z * half, y, z * torch.sinc(phi / math.pi) - x * sin], -1)
    return moved, _matrix([[cos, zero, stretch * sin], [zero, one, zero], [-sin, zero, stretch * cos]])


def _lattice(points: Float[Tensor, "n 3"], lattice: LatticeMap) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Tensor-product Bernstein polynomials; outside the lattice's box they simply continue."""
    grid = lattice.control_points
    sizes = (len(grid), len(grid[0]) if grid else 0, len(grid[0][0]) if grid and grid[0] else 0)
    even = all(len(plane) == sizes[1] and all(len(line) == sizes[2] for line in plane) for plane in grid)
    if not even or not all(2 <= size <= MAX_CONTROL_POINTS for size in sizes):
        raise ValueError(
            f"a lattice has 2 to {MAX_CONTROL_POINTS} control points along each axis, in full rows; found {'x'.join(map(str, sizes))}"
        )
    low, high = points.new_tensor(lattice.minimum), points.new_tensor(lattice.maximum)
    if not (high > low).all():
        raise ValueError(f"a lattice's maximum {lattice.maximum} must exceed its minimum {lattice.minimum} along every axis")
    control = points.new_tensor(grid)
    uvw = (points - low) / (high - low)
    weights, slopes = zip(*(_bernstein(uvw[:, axis], sizes[axis] - 1) for axis in range(3)), strict=True)

    def blend(u: Tensor, v: Tensor, w: Tensor) -> Tensor:
        planes = torch.einsum("ni,ijkc->njkc", u, control)
        return torch.einsum("nk,nkc->nc", w, torch.einsum("nj,njkc->nkc", v, planes))

    columns = [blend(*(slopes[axis] if axis == turn else weights[axis] for axis in range(3))) / (high - low)[turn] for turn in range(3)]
    return blend(*weights), torch.stack(columns, -1)


def _bernstein(t: Float[Tensor, "n"], degree: int) -> tuple[Float[Tensor, "n {degree}+1"], Float[Tensor, "n {degree}+1"]]:
    """Values and derivatives (n, degree + 1) of the Bernstein polynomials of a degree."""

    def values(d: int) -> Tensor:
        return torch.stack([math.comb(d, i) * t**i * (1 - t) ** (d - i) for i in range(d + 1)], -1)

    lower = torch.nn.functional.pad(values(degree - 1), (1, 1))
    return values(degree), degree * (lower[:, :-1] - lower[:, 1:])
