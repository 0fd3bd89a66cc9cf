"""How far the photographs of a capture decide what its asset says of a place."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Certainty:
    """Of the mesh as it was captured, one entry a vertex, 0..1: 0 is a guess (never seen, always dark), near 1 the photographs leave no choice.

    0.5: they alone say as much as was known before them, a standard deviation of 0.1 (drgs.reconstruct.fit.evidence.vertex_certainty). Edits and
    poses do not change it. float16.
    """

    shape: Float[Tensor, "vertex"]
    """Of the normal's direction, by shading: outlines and texture may say more."""
    albedo: Float[Tensor, "vertex"]
    """Under the light that was found: its errors are not counted but for a few per cent."""
    roughness: Float[Tensor, "vertex"]
    metallic: Float[Tensor, "vertex"]
    """Of whether the place is metal or not."""
