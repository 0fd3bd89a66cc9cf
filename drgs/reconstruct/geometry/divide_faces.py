"""Each face of a mesh becomes four, by the middles of its edges: the same surface, with room for finer values at its vertices.

In: faces, what their vertices carry, what is bound to them. Out: the same on the divided faces, and how often photographs want them divided.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Int
from torch import Tensor

from drgs.maths.unique_rows import unique_rows
from drgs.scene.binding import Binding
from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh


@dataclass(frozen=True)
class DivisionSettings:
    """How fine."""

    edge_pixels: float = 1.5
    """Faces are divided while their mean edge is longer [pixels of the photographs] ..."""
    most_faces: int = 250_000
    """... and there are no more than this afterwards."""


@dataclass(frozen=True, eq=False)
class DividedFaces:
    """The new faces, and what the new vertices lie between. Old vertices keep their numbers and come first."""

    faces: Int[Tensor, "face 3"]
    """Of old face f of F: f, F + f and 2 F + f at its corners, 3 F + f in its middle."""
    between: Int[Tensor, "new 2"]
    """Old vertices at the ends of the edge whose middle a new vertex is."""

    def carried(self, values: Tensor) -> Tensor:
        """(vertex, ...) of what the old vertices carried."""
        start, end = self.between.unbind(1)
        return torch.cat([values, 0.5 * (values[start] + values[end])])


def divided_faces(faces: Int[Tensor, "face 3"], vertices: int) -> DividedFaces:
    """Of a mesh with so many vertices; edges that faces share get one new vertex."""
    corners = faces.long()
    ends = torch.cat([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]]).sort(1).values
    between, number = unique_rows(ends)
    first, second, third = (vertices + number).view(3, -1)
    a, b, c = corners.unbind(1)
    parts = [(a, first, third), (b, second, first), (c, third, second), (first, second, third)]
    return DividedFaces(torch.cat([torch.stack(part, 1) for part in parts]).to(faces), between)


def undivided_faces(faces: Int[Tensor, "face 3"]) -> Int[Tensor, "coarse 3"]:
    """Those that divided_faces made these of."""
    count = len(faces) // 4
    return torch.stack([faces[:count, 0], faces[count : 2 * count, 0], faces[2 * count : 3 * count, 0]], 1)


def divisions(mesh: TriangleMesh, cameras: tuple[Camera, ...], settings: DivisionSettings) -> int:
    """How often each face is to be divided into four."""
    corners = mesh.vertices[mesh.faces.long()]
    edge = float((corners - corners.roll(1, 1)).norm(dim=-1).mean())
    middle = mesh.vertices.mean(0)
    pixel = torch.stack([(camera.center_world.to(middle) - middle).norm() / camera.intrinsics[0, 0].to(middle) for camera in cameras])
    times, faces = 0, len(mesh.faces)
    while edge / 2**times > settings.edge_pixels * float(pixel.median()) and 4 * faces <= settings.most_faces:
        times, faces = times + 1, 4 * faces
    return times


def divided_binding(binding: Binding, faces: int) -> Binding:
    """The same places on the divided faces of a mesh that had so many."""
    a, b, c = binding.barycentric.unbind(1)
    children = torch.stack(
        [
            torch.stack([2 * a - 1, 2 * b, 2 * c], 1),
            torch.stack([2 * b - 1, 2 * c, 2 * a], 1),
            torch.stack([2 * c - 1, 2 * a, 2 * b], 1),
            torch.stack([1 - 2 * c, 1 - 2 * a, 1 - 2 * b], 1),
        ]
    )
    most, corner = binding.barycentric.max(1)
    child = torch.where(most > 0.5, corner, torch.full_like(corner, 3))
    inside = children[child, torch.arange(len(child), device=child.device)]
    return replace(binding, face=(child * faces + binding.face.long()).to(binding.face), barycentric=inside)
