"""Pixels to picture files. JPEG while things move (about 1 ms for 800x800), PNG for the last, lossless frame, EXR for further work."""

import io

import numpy as np
import simplejpeg
from PIL import Image

from drgs.exchange.exr import encode_exr
from drgs_server.render.interface import LinearPixels, Pixels

MOVING_QUALITY = 80
STILL_QUALITY = 92
GREY = 119
"""Behind transparent pixels where the format has no alpha, 8-bit sRGB: middle grey (18 % linear)."""


def has_alpha(pixels: Pixels) -> bool:
    """Whether any pixel is not opaque."""
    return bool((pixels[..., 3] < 255).any())


def flatten(pixels: Pixels) -> np.ndarray:
    """(height, width, 3) uint8 over grey."""
    if not has_alpha(pixels):
        return np.ascontiguousarray(pixels[..., :3])
    alpha = pixels[..., 3:].astype(np.float32) / 255
    return np.ascontiguousarray((pixels[..., :3] * alpha + GREY * (1 - alpha) + 0.5).astype(np.uint8))


def encode_jpeg(pixels: Pixels, moving: bool) -> bytes:
    """Moving: small and quick. Still: full colour resolution."""
    if moving:
        return simplejpeg.encode_jpeg(flatten(pixels), quality=MOVING_QUALITY, colorspace="RGB", colorsubsampling="420", fastdct=True)
    return simplejpeg.encode_jpeg(flatten(pixels), quality=STILL_QUALITY, colorspace="RGB", colorsubsampling="444", fastdct=False)


def encode_png(pixels: Pixels) -> bytes:
    """RGBA where a pixel is not opaque, else RGB. Fast rather than small."""
    stream = io.BytesIO()
    Image.fromarray(pixels if has_alpha(pixels) else np.ascontiguousarray(pixels[..., :3])).save(stream, "PNG", compress_level=1)
    return stream.getvalue()


def encode_exr_still(pixels: LinearPixels, exposure_stops: float) -> bytes:
    """Channels R G B, and A where a pixel is not opaque; the exposure scales R, G and B."""
    channels = {name: pixels[..., k] * np.float32(2.0**exposure_stops) for k, name in enumerate("RGB")}
    return encode_exr(channels | ({"A": pixels[..., 3]} if (pixels[..., 3] < 1).any() else {}))
