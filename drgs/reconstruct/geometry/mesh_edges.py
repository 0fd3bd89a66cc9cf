"""The edges of a triangle mesh that two faces share."""

from dataclasses import dataclass, field

import torch
from jaxtyping import Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """One entry an edge between two faces; borders are left out, of an edge with more faces each pair of successive ones counts."""

    vertices: Int[Tensor, "edge 2"]
    faces: Int[Tensor, "edge 2"]
    _around: dict[int, tuple[Tensor, Tensor]] = field(default_factory=dict, repr=False)

    def around(self, count: int) -> tuple[Tensor, Tensor]:
        """(vertex + 1,) where each vertex' neighbours begin in a list of all, and that list, (2 edge,). Made once.

        Args:
            count: of vertices.
        """
        if count not in self._around:
            here, there = torch.cat([self.vertices, self.vertices.flip(1)]).unbind(1)
            order = torch.argsort(here, stable=True)
            before = torch.zeros(count + 1, dtype=torch.long, device=here.device)
            torch.cumsum(torch.bincount(here, minlength=count), 0, out=before[1:])
            self._around[count] = before, there[order].contiguous()
        return self._around[count]


def mesh_edges(faces: Tensor) -> MeshEdges:
    """Of faces (face, 3)."""
    corners = faces.long()
    ends = torch.cat([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    face = torch.arange(len(corners), device=faces.device).repeat(3)
    low, high = torch.minimum(*ends.unbind(1)), torch.maximum(*ends.unbind(1))
    key = low * (int(corners.max()) + 1 if len(corners) else 1) + high
    order = torch.argsort(key, stable=True)
    low, high, face, key = low[order], high[order], face[order], key[order]
    shared = (key[1:] == key[:-1]).nonzero().squeeze(1)
    return MeshEdges(torch.stack([low[shared], high[shared]], 1), torch.stack([face[shared], face[shared + 1]], 1))
