"""A mesh whose neighbours are near in memory: rays that start or end side by side then read the same lines of it.

Meshes come in the order in which marching cubes, simplification and divisions left them. The order along a curve changes nothing else, and a moving
picture of 240 000 faces takes a tenth less (benchmarks/README.md).
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from drgs.maths.z_order import z_order
from drgs.scene.binding import Binding
from drgs.scene.certainty import Certainty
from drgs.scene.mesh import TriangleMesh


@dataclass(frozen=True, eq=False)
class SpaceOrder:
    """What stands where."""

    vertices: Int[Tensor, "vertex"]
    """Which of the old ones stands at each place."""
    faces: Int[Tensor, "face"]

    def of_mesh(self, mesh: TriangleMesh) -> TriangleMesh:
        """The same surface; each face begins with the same corner."""
        columns = {name: values[self.vertices] for name, values in mesh.columns.items() if name != "faces"}
        faces = _places(self.vertices)[mesh.faces.long()][self.faces].to(mesh.faces)
        detail = mesh.detail
        if detail is not None:
            detail = replace(detail, codes=detail.codes[self.faces], share=None if detail.share is None else detail.share[self.vertices])
        return TriangleMesh(**columns, faces=faces, detail=detail)

    def of_certainty(self, certainty: Certainty) -> Certainty:
        return Certainty(**{name: values[self.vertices] for name, values in vars(certainty).items()})

    def of_binding(self, binding: Binding) -> Binding:
        """The same surfels on the same faces."""
        return replace(binding, face=_places(self.faces)[binding.face.long()].to(binding.face))


def order_in_space(mesh: TriangleMesh) -> SpaceOrder:
    """Faces along a curve through space, and vertices in the order in which these use them; those that none uses come last."""
    faces = z_order(mesh.vertices[mesh.faces.long()].mean(1))
    corners = mesh.faces[faces].long().reshape(-1)
    first_use = torch.full((len(mesh.vertices),), len(corners), device=corners.device)
    first_use.scatter_reduce_(0, corners, torch.arange(len(corners), device=corners.device), "amin")
    return SpaceOrder(torch.argsort(first_use, stable=True), faces)


def _places(order: Tensor) -> Tensor:
    """Where each stands now."""
    places = torch.empty_like(order)
    places[order] = torch.arange(len(order), device=order.device)
    return places
