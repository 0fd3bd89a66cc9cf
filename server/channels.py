"""What each channel shows of a frame: maps as colours for the eye. The page's legends (web/src/channels.ts) say the same in words.

Imported only on the render thread; torch only inside functions.
"""

from typing import TYPE_CHECKING

from server.messages import LEAST_SHOWN_ERROR, Settings
from server.render_session import Pixels

if TYPE_CHECKING:
    from torch import Tensor

    from drgs.render.records import Frame, GBuffer

HEAT_SRGB = ((11, 16, 38), (43, 76, 155), (47, 160, 143), (229, 195, 74), (255, 247, 214))
"""From the least shown error to 1, evenly in its logarithm; brighter is more. As --heat in web/src/style.css."""


def channel_pixels(frame: "Frame", settings: Settings) -> Pixels:
    """8-bit picture of the frame's channel."""
    import torch

    if settings.channel == "final":
        rgba = frame.rgba_srgb
    else:
        coverage = frame.gbuffer.coverage
        color = torch.where(coverage[..., None] > 0, _color(frame, settings), 0.0)
        rgba = torch.cat([color.clamp(0, 1), coverage.clamp(0, 1)[..., None]], -1)
    return eight_bit(rgba)


def eight_bit(rgba: "Tensor") -> Pixels:
    import torch

    return (rgba.clamp(0, 1) * 255 + 0.5).to(torch.uint8).cpu().numpy()


def _color(frame: "Frame", settings: Settings) -> "Tensor":
    """(height, width, 3) in 0..1 for showing."""
    from drgs.maths.color import srgb_from_linear

    maps, channel = frame.gbuffer, settings.channel
    if channel == "albedo":
        return srgb_from_linear(maps.albedo.clamp(0, 1))
    if channel == "normal":
        return maps.normal_world * 0.5 + 0.5
    if channel in ("roughness", "metallic"):
        return _grey(getattr(maps, channel))
    if channel == "visibility":
        return _grey(frame.radiance.visibility)
    if channel == "variance":
        return heat(frame.radiance.variance.clamp(min=0).sqrt() * 2.0**settings.exposure_stops)
    return _grey(_nearness(maps))


def _grey(values: "Tensor") -> "Tensor":
    return values[..., None].expand(-1, -1, 3)


def _nearness(maps: "GBuffer") -> "Tensor":
    """Near is bright; the farthest point stays visible before black."""
    import torch

    depth = maps.depth[maps.coverage > 0.5]
    near, far = (float(depth.min()), float(depth.max())) if len(depth) else (0.0, 1.0)
    return torch.nan_to_num(1 - 0.9 * (maps.depth - near) / max(far - near, 1e-6), 0.0, 0.0, 0.0)


def heat(errors: "Tensor") -> "Tensor":
    """(..., 3) sRGB 0..1 of standard errors, where white is 1: HEAT_SRGB from LEAST_SHOWN_ERROR to 1."""
    import math

    import torch

    stops = torch.tensor(HEAT_SRGB, device=errors.device) / 255
    decades = -math.log10(LEAST_SHOWN_ERROR)
    place = (1 + errors.clamp(min=LEAST_SHOWN_ERROR).log10() / decades).clamp(0, 1) * (len(stops) - 1)
    below = place.floor().long().clamp(max=len(stops) - 2)
    share = (place - below)[..., None]
    return stops[below] * (1 - share) + stops[below + 1] * share
