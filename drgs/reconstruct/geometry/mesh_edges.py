"""The edges of a triangle mesh that two faces share."""

from dataclasses import dataclass

import torch
from jaxtyping import Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class MeshEdges:
    """One entry an edge between two faces; borders are left out, of an edge with more faces each pair of successive ones counts."""

    vertices: Int[Tensor, "edge 2"]
    faces: Int[Tensor, "edge 2"]


def mesh_edges(faces: Tensor) -> MeshEdges:
    """Of faces (face, 3)."""
    corners = faces.long()
    ends = torch.cat([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [2, 0]]])
    face = torch.arange(len(corners), device=faces.device).repeat(3)
    low, high = ends.amin(1), ends.amax(1)
    key = low * (int(corners.max()) + 1 if len(corners) else 1) + high
    order = torch.argsort(key, stable=True)
    low, high, face, key = low[order], high[order], face[order], key[order]
    shared = (key[1:] == key[:-1]).nonzero().squeeze(1)
    return MeshEdges(torch.stack([low[shared], high[shared]], 1), torch.stack([face[shared], face[shared + 1]], 1))
