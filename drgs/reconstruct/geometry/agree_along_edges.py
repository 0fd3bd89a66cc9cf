"""Wishes of single vertices, made to agree with their surroundings' by a sparse linear solve."""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.sparse import csr_matrix, diags
from torch import Tensor

from drgs.reconstruct.geometry.symmetric_systems import factored


def agree_along_edges(
    joined: Int[Tensor, "edge 2"], weight: Float[Tensor, "vertex"], wish: Float[Tensor, "vertex"], together: float | Float[Tensor, "edge"]
) -> Float[Tensor, "vertex"]:
    """The values s that minimise sum weight (s - wish)^2 + sum_edges together (s_i - s_j)^2.

    Args:
        joined: vertices that are to agree, of a mesh's edges or any other.
        weight: at least one above 0 in each part that hangs together, else the solve is singular.
    """
    count = len(weight)
    start, end = joined.cpu().numpy().T
    row = np.arange(len(start))
    difference = csr_matrix(
        (np.concatenate([np.ones(len(start)), -np.ones(len(start))]), (np.tile(row, 2), np.concatenate([start, end]))),
        shape=(len(start), count),
    )
    strength, wanted = (values.cpu().double().numpy() for values in (weight, wish))
    held = together.cpu().double().numpy() if isinstance(together, Tensor) else np.full(len(start), together)
    matrix = (diags(strength) + difference.T @ diags(held) @ difference).tocsc()
    return torch.from_numpy(factored(matrix).solve(strength * wanted)).to(wish)
