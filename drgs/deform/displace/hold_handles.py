"""The handles of a deform edit: which vertices they hold, where those go, and the whole object after them.

In: the object at rest, where picked points lie, and as earlier edits left it, which is what is dragged. Out: positions and deformation
gradients of any points that go along. What is held is prepared once (drgs/deform/displace/arap.py); a drag then only brings new targets.
"""

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.deform.displace.arap import ArapHandles, ArapSettings
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.scene.edits import Grip, Handles


class HeldObject:
    """An object held by the grips of a deform edit, whatever their targets. Final; nothing in it changes after it is made."""

    def __init__(
        self,
        rest: Float[Tensor, "vertex 3"],
        vertices: Float[Tensor, "vertex 3"],
        faces: Int[Tensor, "face 3"],
        handles: Handles,
        points: Float[Tensor, "point 3"],
        settings: ArapSettings | None = None,
    ) -> None:
        """Find the vertices held and prepare the object.

        Args:
            rest: (vertex, 3) what picked points and radii refer to.
            vertices: (vertex, 3) as earlier edits left them.
            points: (point, 3) what goes along, as earlier edits left it.

        Raises:
            ValueError: a grip names a vertex that the mesh does not have.
        """
        taken = torch.zeros(len(rest), dtype=torch.bool, device=rest.device)
        held, self._anchors = [], []
        for grip in (*handles.drag, *handles.pin):
            own = _held_vertices(rest, grip)
            anchor = vertices[own].double().mean(0)
            if grip.point is not None:
                anchor = anchor + rest.new_tensor(grip.point).double() - rest[own].double().mean(0)
            self._anchors.append(anchor)
            held.append(own[~taken[own]])  # what two grips hold belongs to the first
            taken[own] = True
        self._parts = [vertices[own].double() for own in held]
        self._handles = ArapHandles(vertices, faces, torch.cat(held), points, settings)

    def pull(self, handles: Handles) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 3 3"]]:
        """Positions (point, 3) and gradients (point, 3, 3) of the points with these handles' targets; their grips are those given before.

        The same targets give the same result, whatever came before.
        """
        goals = []
        for handle, part, anchor in zip(handles.drag, self._parts, self._anchors, strict=False):
            rotation = _rotation(part.new_tensor(handle.turn).deg2rad())
            goals.append((part - anchor) @ rotation.T + part.new_tensor(handle.target))
        return self._handles.drag(torch.cat([*goals, *self._parts[len(handles.drag) :]]))


def _held_vertices(rest: Float[Tensor, "vertex 3"], grip: Grip) -> Int[Tensor, "held"]:
    """Numbers of the vertices that a grip holds, ascending; at least one."""
    if grip.vertices is not None:
        last = max(grip.vertices)
        if last >= len(rest):
            raise ValueError(f"a grip names vertex {last}; the mesh has {len(rest)}, counted from 0")
        return torch.tensor(sorted(set(grip.vertices)), device=rest.device)
    distance = (rest - rest.new_tensor(grip.point)).norm(dim=-1)
    return torch.nonzero(distance <= max(grip.radius, float(distance.min()))).flatten()


def _rotation(vector: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """(3, 3) of a rotation vector (3,) [radians]."""
    half = vector.norm() / 2
    return rotation_from_quat_wxyz(torch.cat([half.cos()[None], 0.5 * vector * torch.sinc(half / torch.pi)]))
