"""Pixels as files hold them (8-bit sRGB and alpha, straight) and as they may be averaged (linear, premultiplied), by tables."""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy import ndarray

from drgs.maths.color import linear_from_srgb, srgb_from_linear

_LINEAR_OF_BYTE = linear_from_srgb(torch.arange(256) / 255).numpy().astype(np.float32)
_BYTE_STEPS = 8192
_BYTE_OF_LINEAR = (srgb_from_linear(torch.linspace(0, 1, _BYTE_STEPS).double()) * 255).round().numpy().astype(np.uint8)


def premultiplied(color_srgb: UInt8[ndarray, "*pixels"], alpha_share: Float[ndarray, "*pixels"]) -> Float[ndarray, "*pixels"]:
    """Linear light of one channel times alpha (0..1)."""
    return _LINEAR_OF_BYTE[color_srgb] * alpha_share


def straight(light: Float[ndarray, "*pixels 3"], alpha_share: Float[ndarray, "*pixels"]) -> UInt8[ndarray, "*pixels 3"]:
    """8-bit sRGB of premultiplied linear light; black where alpha is zero."""
    linear = light / np.maximum(alpha_share, 1e-6)[..., None]
    return _BYTE_OF_LINEAR[np.clip(linear * (_BYTE_STEPS - 1) + 0.5, 0, _BYTE_STEPS - 1).astype(np.int32)]
