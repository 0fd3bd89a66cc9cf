"""Linear radiance to pictures: exposure, background, sRGB, straight alpha; 8-bit PNG files."""

from pathlib import Path

import numpy as np
import torch
from PIL import Image
from torch import Tensor

from drgs.maths.color import srgb_from_linear


def tonemap(radiance_linear: Tensor, coverage: Tensor, exposure: float = 0.0, background_linear: Tensor | None = None) -> Tensor:
    """(height, width, 4) sRGB in [0, 1] with straight alpha.

    Args:
        radiance_linear: (height, width, 3), alpha-normalised.
        coverage: (height, width), 0..1.
        exposure: [stops]; scales object and background alike.
        background_linear: (3,) or (height, width, 3) radiance behind the object; None leaves it transparent.
    """
    alpha = coverage.clamp(0, 1)[..., None]
    if background_linear is None:
        color = torch.where(alpha > 0, radiance_linear, torch.zeros_like(radiance_linear))
    else:
        color = torch.where(alpha > 0, radiance_linear, 0.0) * alpha + background_linear.to(radiance_linear) * (1 - alpha)
        alpha = torch.ones_like(alpha)
    srgb = srgb_from_linear((color * 2.0**exposure).clamp(min=0)).clamp(0, 1)
    return torch.cat([srgb, alpha], -1)


def write_png(path: Path | str, rgba_srgb: Tensor) -> None:
    """An 8-bit RGBA file, rounded to nearest."""
    pixels = (rgba_srgb.detach().cpu().clamp(0, 1) * 255 + 0.5).to(torch.uint8).numpy()
    Image.fromarray(np.ascontiguousarray(pixels), "RGBA").save(path)
