"""Base colour, roughness and metallic of points: the three numbers an edit may set."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

DEFAULT_ALBEDO, DEFAULT_ROUGHNESS, DEFAULT_METALLIC = 0.5, 0.5, 0.0
"""Of points of which a file does not say."""


@dataclass(frozen=True, eq=False)
class Materials:
    """Materials of Gaussians or of mesh vertices, one entry a point."""

    albedo: Float[Tensor, "point 3"]
    """Linear Rec.709 base colour, 0..1."""
    roughness: Float[Tensor, "point"]
    metallic: Float[Tensor, "point"]
