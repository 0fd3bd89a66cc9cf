"""Where each Gaussian sits on the mesh, so that a moved mesh can carry it."""

from dataclasses import dataclass

from jaxtyping import Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Binding:
    """Closest face of each surfel, barycentric weights inside it, signed distance along its unit normal."""

    face: Int[Tensor, "surfel"]
    """int32 index into the mesh's faces."""
    barycentric: Float[Tensor, "surfel 3"]
    normal_offset: Float[Tensor, "surfel"]
    """[world units], positive outside."""
