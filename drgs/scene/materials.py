"""Base colour, roughness and metallic of points: the three numbers an edit may set."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Materials:
    """Materials of Gaussians or of mesh vertices, one entry a point."""

    albedo: Float[Tensor, "point 3"]
    """Linear Rec.709 base colour, 0..1."""
    roughness: Float[Tensor, "point"]
    metallic: Float[Tensor, "point"]
