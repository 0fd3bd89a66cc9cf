"""(I + strength L)^-1 of values at a mesh's vertices, L the graph's Laplacian: the steps of positions are taken in what it makes of them.

A noisy gradient moves each vertex by itself and crumples a mesh; its diffused form moves neighbours together, and what is as wide as the surface at once
(Nicolet et al. 2021; docs/sources.md: nicolet2021). A polynomial of I + strength L (Chebyshev's iteration), so that it is linear and its own transpose.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.sparse import csr_matrix, diags
from torch import Tensor

from drgs.reconstruct.geometry.mesh_edges import MeshEdges

DEGREE = 12
"""Of the polynomial: how often values are passed on to neighbours. At strength 1 a sphere's are right to half a hundredth of the largest."""


class Diffusion:
    """Final. Of one mesh's edges."""

    def __init__(self, edges: MeshEdges, count: int, strength: float) -> None:
        """
        Args:
            count: of vertices.
        """
        start, end = edges.vertices.cpu().numpy().T
        ends = (np.concatenate([start, end]), np.concatenate([end, start]))
        neighbours = csr_matrix((np.ones(2 * len(start), dtype=np.float32), ends), shape=(count, count))
        number = np.asarray(neighbours.sum(1), dtype=np.float32).ravel()
        self._matrix = (diags(1 + strength * number) - strength * neighbours).tocsr().astype(np.float32)
        self._largest = 1 + 2 * strength * float(number.max(initial=0))

    def __call__(self, values: Float[Tensor, "vertex"]) -> Float[Tensor, "vertex"]:
        """Differentiable."""
        return _Diffuse.apply(values, self)

    def of(self, values: np.ndarray) -> np.ndarray:
        """(vertex,)."""
        middle, half = (self._largest + 1) / 2, (self._largest - 1) / 2
        found, left = np.zeros_like(values), values.copy()
        step, along = 1 / middle, left
        for k in range(DEGREE):
            if k:
                back = (half * step) ** 2 * (0.5 if k == 1 else 0.25)
                step = 1 / (middle - back / step)
                along = left + np.float32(back) * along
            found += np.float32(step) * along
            left = left - np.float32(step) * (self._matrix @ along)
        return found


class _Diffuse(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, values: Tensor, diffusion: Diffusion) -> Tensor:
        ctx.diffusion = diffusion
        return torch.from_numpy(diffusion.of(values.detach().cpu().numpy())).to(values)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None]:
        return torch.from_numpy(ctx.diffusion.of(upstream.cpu().numpy())).to(upstream), None
