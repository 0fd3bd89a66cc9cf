"""Albedo finer than a mesh's vertices: a grid of factors on each face, by which the albedo between its corners is multiplied.

In: faces, places on them. Out: factors. A grid needs no charts and no pictures: each side of a face is cut into the same number of parts, samples lie
where the cuts meet, and between three of them factors are linear. Samples on an edge or a corner stand with each face that has it, with the same
number, so nothing is seen of the faces. Factors are kept as bytes c with (c / 128)^2: 1 exactly, up to 3.97, in steps of 1.6 % at 1.

Source: Yuksel et al. 2010, mesh colors (docs/sources.md: yuksel2010). The kernels' twin is drgs/render/intersect/mesh_surface.py.
"""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

ONE = 128
"""Code of the factor 1."""
MOST_PARTS = 8
"""A side of a face is cut into so many at most: 45 samples a face."""


@dataclass(frozen=True, eq=False)
class AlbedoDetail:
    """Factors of the albedo of a mesh with as many faces. Written by face_detail, read wherever a ray sees the mesh."""

    codes: UInt8[Tensor, "face sample 3"]
    """Of the factors of red, green and blue; samples are ordered as in `sample_places`."""
    share: Float[Tensor, "vertex"] | None = None
    """How much of it a vertex wears, 0..1, linear between: what an edit painted has none. None: all of it everywhere."""

    @property
    def parts(self) -> int:
        """Of each side of a face."""
        return parts_of(self.codes.shape[1])


def samples_of(parts: int) -> int:
    """Samples a face."""
    return (parts + 1) * (parts + 2) // 2


def parts_of(samples: int) -> int:
    """Inverse of samples_of.

    Raises:
        ValueError: no grid has so many samples.
    """
    parts = (math.isqrt(8 * samples + 1) - 3) // 2
    if parts < 1 or samples_of(parts) != samples:
        raise ValueError(f"a face has {samples} samples of detail; expected 3, 6, 10, 15, ...")
    return parts


def sample_places(parts: int) -> Int[Tensor, "sample 2"]:
    """Of each sample, in how many parts of a side it lies towards the second and the third corner; rows of constant third."""
    return torch.tensor([(i, j) for j in range(parts + 1) for i in range(parts + 1 - j)])


def codes_of(factors: Float[Tensor, "*sample 3"]) -> UInt8[Tensor, "*sample 3"]:
    """The nearest bytes."""
    return (ONE * factors.clamp(min=0).sqrt()).round().clamp(0, 255).to(torch.uint8)


def factors_of(codes: UInt8[Tensor, "*sample 3"], dtype: torch.dtype = torch.float32) -> Float[Tensor, "*sample 3"]:
    """What bytes stand for."""
    return (codes.to(dtype) / ONE).square()


def detailed_albedo(
    albedo: Float[Tensor, "point 3"],
    detail: AlbedoDetail | None,
    faces: Int[Tensor, "face 3"],
    face: Int[Tensor, "point"],
    barycentric: Float[Tensor, "point 2"],
) -> Float[Tensor, "point 3"]:
    """The albedo of points on a mesh.

    Args:
        albedo: linear between the corners. faces: of the mesh. face: that each point lies on. barycentric: weights of its second and third corner.
    """
    if detail is None:
        return albedo
    parts, face = detail.parts, face.long()
    scaled = barycentric.clamp(0, 1) * parts
    i = scaled[:, 0].floor().long().clamp(max=parts - 1)
    j = torch.minimum(scaled[:, 1].floor().long().clamp(max=parts - 1), parts - 1 - i)
    f, g = scaled[:, 0] - i, scaled[:, 1] - j
    upper = (f + g > 1) & (i + j < parts - 1)
    # Of a triangle that points the other way the corner at (1, 1) takes the place of the one at (0, 0).
    first = _sample(i + upper, j + upper, parts)
    weights = torch.stack([torch.where(upper, f + g - 1, 1 - f - g), torch.where(upper, 1 - g, f), torch.where(upper, 1 - f, g)], -1)
    samples = torch.stack([first, _sample(i + 1, j, parts), _sample(i, j + 1, parts)], -1)
    factor = torch.einsum("pc,pck->pk", weights, factors_of(detail.codes[face[:, None], samples], albedo.dtype))
    if detail.share is not None:
        corners = torch.stack([1 - barycentric.sum(-1), barycentric[:, 0], barycentric[:, 1]], -1)
        share = (corners * detail.share.to(albedo)[faces[face].long()]).sum(-1, keepdim=True)
        factor = 1 + share * (factor - 1)
    return (albedo * factor).clamp(0, 1)


def _sample(i: Tensor, j: Tensor, parts: int) -> Tensor:
    """Number of the sample in place (i, j)."""
    return j * (parts + 1) - j * (j - 1) // 2 + i


def chosen_faces(detail: AlbedoDetail, chosen: Int[Tensor, "chosen"], faces: int, vertex_source: Int[Tensor, "new_vertex"]) -> AlbedoDetail:
    """Of a mesh whose first faces are the `chosen` ones of the detail's mesh; those behind them, up to `faces`, have none.

    Args:
        vertex_source: of the new mesh's vertices, those of the detail's mesh.
    """
    codes = torch.full((faces, *detail.codes.shape[1:]), ONE, dtype=torch.uint8, device=detail.codes.device)
    codes[: len(chosen)] = detail.codes[chosen]
    return AlbedoDetail(codes, None if detail.share is None else detail.share[vertex_source])


def worn_by(detail: AlbedoDetail | None, share: Float[Tensor, "vertex"] | None) -> AlbedoDetail | None:
    """The same detail, worn by the vertices as far as `share` says; None: none is left."""
    if detail is None or share is None:
        return detail
    return replace(detail, share=share)
