"""Places on the faces of a mesh, each once: the samples of AlbedoDetail's grids, of which neighbouring faces share those on their edges.

In: faces, and into how many parts each side is cut. Out: numbers of samples, and between which vertices they lie.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse import csr_matrix, diags
from torch import Tensor

from drgs.maths.unique_rows import unique_rows
from drgs.scene.albedo_detail import sample_places


@dataclass(frozen=True, eq=False)
class FaceSamples:
    """The samples of all faces. The first ones are the vertices, in their order."""

    number: Int[Tensor, "face place"]
    """Of the sample in each place of a face's grid (sample_places)."""
    corners: Int[Tensor, "sample 3"]
    """Of a face that has it."""
    weights: Float[Tensor, "sample 3"]
    """Of these corners, at the sample."""

    def __getitem__(self, chosen: Tensor) -> "FaceSamples":
        """Some of the samples; the numbers stay those of all."""
        return FaceSamples(self.number, self.corners[chosen], self.weights[chosen])

    def at(self, values: Float[Tensor, "vertex k"]) -> Float[Tensor, "sample k"]:
        """Vertices' values, linear between them."""
        first, second, third = (self.weights[:, k, None] * values[self.corners[:, k]] for k in range(3))
        return first + second + third

    def between(self, marked: Bool[Tensor, "vertex"]) -> Bool[Tensor, "sample"]:
        """Whether all vertices between which a sample lies are marked."""
        return (marked[self.corners] | (self.weights == 0)).all(1)

    @property
    def nearest(self) -> Int[Tensor, "sample"]:
        """Vertex at the nearest corner."""
        return self.corners.gather(1, self.weights.argmax(1, keepdim=True)).squeeze(1)

    def averaging(self, vertices: int) -> tuple[csr_matrix, csr_matrix]:
        """(sample, vertex) that takes vertices' values to samples, and (vertex, sample) that takes the mean of the samples around each vertex."""
        rows = np.repeat(np.arange(len(self.corners)), 3)
        shares = self.weights.flatten().cpu().double().numpy()
        outwards = csr_matrix((shares, (rows, self.corners.flatten().cpu().numpy())), shape=(len(self.corners), vertices))
        total = np.asarray(outwards.sum(0)).ravel()
        return outwards, (diags(1 / np.maximum(total, 1e-12)) @ outwards.T).tocsr()


def face_samples(faces: Int[Tensor, "face 3"], vertices: int, parts: int) -> FaceSamples:
    """Of a mesh with so many vertices. Behind the vertices come the samples on edges, then those inside faces."""
    corners, device = faces.long(), faces.device
    places = sample_places(parts).to(device)
    i, j = places.unbind(1)
    ends = torch.stack([corners[:, [0, 1]], corners[:, [1, 2]], corners[:, [0, 2]]], 1)
    edges, edge = unique_rows(ends.sort(-1).values.reshape(-1, 2))
    edge = edge.view(-1, 3)
    number = torch.empty(len(corners), len(places), dtype=torch.long, device=device)
    on_side = (j == 0, i + j == parts, i == 0)
    for side, (on, part) in enumerate(zip(on_side, (i, j, j), strict=True)):
        inner = (on & (part > 0) & (part < parts)).nonzero().squeeze(1)
        # Both faces of an edge count from its end of the lower number.
        forward = (ends[:, side, 0] < ends[:, side, 1])[:, None]
        number[:, inner] = vertices + (parts - 1) * edge[:, side, None] + torch.where(forward, part[inner], parts - part[inner]) - 1
    for corner, at in enumerate(((0, 0), (parts, 0), (0, parts))):
        number[:, ((i == at[0]) & (j == at[1])).nonzero().squeeze(1)] = corners[:, corner, None]
    inside = (~(on_side[0] | on_side[1] | on_side[2])).nonzero().squeeze(1)
    first = vertices + (parts - 1) * len(edges)
    number[:, inside] = first + torch.arange(len(corners) * len(inside), device=device).view(len(corners), -1)
    # A sample on an edge has two faces: the first one, so that it is the same each time. A vertex that no face has gets the first face's first corner.
    owner = torch.zeros(first + len(corners) * len(inside), dtype=torch.long, device=device)
    owner.scatter_reduce_(0, number.flatten(), torch.arange(number.numel(), device=device), "amin", include_self=False)
    face, place = owner // len(places), owner % len(places)
    weights = torch.stack([parts - i - j, i, j], -1).float() / parts
    return FaceSamples(number, corners[face], weights[place])
