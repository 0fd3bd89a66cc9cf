"""The tone curves of render/tonemap.py as their sources write them, in torch; slow, and of any precision."""

import torch
from torch import Tensor

from drgs.render.film.tonemap import (
    ACES_FROM_LINEAR,
    AGX_CONTRAST,
    AGX_FROM_REC2020,
    AGX_STOPS,
    LINEAR_FROM_ACES,
    LINEAR_FROM_REC2020,
    REC2020_FROM_AGX,
    REC2020_FROM_LINEAR,
)
from drgs.scene.tone_curve import ToneCurve


def apply_tone_curve(radiance_linear: Tensor, curve: ToneCurve) -> Tensor:
    """(..., 3) a screen's linear light, of exposed radiance (..., 3); not clipped where the curve does not clip."""
    return _CURVES[curve](radiance_linear)


def _through(rows: tuple[tuple[float, ...], ...], color: Tensor) -> Tensor:
    return color @ torch.tensor(rows, dtype=color.dtype, device=color.device).T


def _filmic(color: Tensor) -> Tensor:
    v = _through(ACES_FROM_LINEAR, color / 0.6)
    fitted = (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)
    return _through(LINEAR_FROM_ACES, fitted)


def _agx(color: Tensor) -> Tensor:
    v = _through(AGX_FROM_REC2020, _through(REC2020_FROM_LINEAR, color)).clamp(min=1e-10)
    x = ((v.log2() - AGX_STOPS[0]) / (AGX_STOPS[1] - AGX_STOPS[0])).clamp(0, 1)
    fitted = sum(factor * x**power for power, factor in enumerate(AGX_CONTRAST))
    assert isinstance(fitted, Tensor)
    return _through(LINEAR_FROM_REC2020, _through(REC2020_FROM_AGX, fitted).clamp(min=0) ** 2.2)


def _neutral(color: Tensor) -> Tensor:
    start, desaturation = 0.8 - 0.04, 0.15
    least = color.amin(-1, keepdim=True)
    color = color - torch.where(least < 0.08, least - 6.25 * least**2, 0.04)
    peak = color.amax(-1, keepdim=True)
    d = 1 - start
    compressed = 1 - d * d / (peak + d - start)
    whiteness = 1 - 1 / (desaturation * (peak - compressed) + 1)
    return torch.where(peak < start, color, torch.lerp(color * compressed / peak, compressed.expand_as(color), whiteness))


_CURVES = {"standard": lambda color: color, "filmic": _filmic, "agx": _agx, "neutral": _neutral}
