"""How ours is traced in every table and figure: some rays a pixel and, as in drgs2026, a cross-bilateral filter after them."""

from drgs.maths.constants import STILL_BOUNCES
from drgs.render.records import RenderSettings


def traced_settings(samples_per_pixel: int, bounces: int = STILL_BOUNCES) -> RenderSettings:
    """Of a picture of ours; a truth that is traced has no filter."""
    return RenderSettings(samples_per_pixel, bounces=bounces, denoise="svgf")
