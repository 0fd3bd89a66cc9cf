"""How sharp a picture is, as one number that may be compared with that of other pictures of the same thing.

In: brightness. Out: the variance of its Laplacian, which blur lowers and contrast raises. Source: Pech-Pacheco et al. 2000 (docs/sources.md: pech2000).
"""

import numpy as np
from jaxtyping import Bool, Float32
from numpy import ndarray


def laplacian_variance(luma: Float32[ndarray, "height width"], inside: Bool[ndarray, "height width"] | None = None) -> float:
    """Variance of the Laplacian [squared shades]; 0 where there is too little to look at.

    Args:
        inside: pixels that count; None: all.
    """
    laplacian = luma[:-2, 1:-1] + luma[2:, 1:-1] + luma[1:-1, :-2] + luma[1:-1, 2:] - 4 * luma[1:-1, 1:-1]
    if inside is not None:
        laplacian = laplacian[inside[1:-1, 1:-1]]
    return float(np.var(laplacian)) if laplacian.size else 0.0
