"""Deformations as functions of space: where points go, and the deformation gradient there. Every variant is driven by the same one.

In: points (n, 3) at rest, world units. Out: moved points (n, 3) and F (n, 3, 3).
"""

from collections.abc import Callable
from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.deform.carry.drive_mesh import drive_points, vertex_gradients
from drgs.deform.displace.maps import evaluate_map
from drgs.reconstruct.geometry.bind_gaussians import bind_gaussians
from drgs.scene.edits import DeformEdit, parse_edits
from drgs.scene.mesh import TriangleMesh

Field = Callable[[Tensor], tuple[Tensor, Tensor]]


def at_rest(points: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "n 3"], Float[Tensor, "n 3 3"]]:
    """Nothing moves."""
    return points, torch.eye(3, device=points.device, dtype=points.dtype).expand(len(points), 3, 3)


def field_of_map(analytic: dict) -> Field:
    """Of a map as edits write it ({"type": "twist", "rate": 0.6}).

    Raises:
        ValueError: there is no such map.
    """
    (edit,) = parse_edits([{"op": "deform", "map": analytic}])
    assert isinstance(edit, DeformEdit) and edit.map is not None
    return partial(evaluate_map, edit.map)


def field_of_moved_mesh(rest: TriangleMesh, moved: Float[Tensor, "vertex 3"]) -> Field:
    """Near a mesh whose vertices moved: points keep their place relative to the closest one of its surface at rest, as our own surfels do."""
    gradients = vertex_gradients(rest.vertices, moved, rest.faces)

    def move(points: Tensor) -> tuple[Tensor, Tensor]:
        return drive_points(rest.vertices, moved, rest.faces, gradients, bind_gaussians(points, rest), points)

    return move


def rigid_field(rotation: Float[Tensor, "3 3"], shift: Float[Tensor, "3"]) -> Field:
    """A turn about the origin, then a shift."""

    def move(points: Tensor) -> tuple[Tensor, Tensor]:
        turn = rotation.to(points)
        return points @ turn.T + shift.to(points), turn.expand(len(points), 3, 3)

    return move
