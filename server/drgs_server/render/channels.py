"""What each channel shows of a frame: maps as colours for the eye. The page's legends (web/src/stage/channels.ts) say the same in words.

Imported only on the render thread; torch only inside functions.
"""

from typing import TYPE_CHECKING

import numpy as np

from drgs_server.live.messages import LEAST_SHOWN_ERROR, Channel, Settings
from drgs_server.render.interface import Pixels

if TYPE_CHECKING:
    from torch import Tensor

    from drgs.render.progressive.frame_state import FrameState
    from drgs.render.records import Frame

HEAT_SRGB = ((11, 16, 38), (43, 76, 155), (47, 160, 143), (229, 195, 74), (255, 247, 214))
"""From the least shown error to 1, evenly in its logarithm; brighter is more. As --heat in web/src/ui/style.css."""
_MAPS = {"normal": "normal_world", "certainty": "albedo"}
"""Names that the G-buffer has for channels, where they differ. What certainty is shown of wears it as its albedo."""


def channel_pixels(frame: "Frame", settings: Settings) -> Pixels:
    """8-bit picture of the frame's channel."""

    if settings.channel == "depth":
        return depth_pixels(frame.gbuffer.depth, frame.gbuffer.coverage)
    if settings.channel == "final":
        rgba = frame.rgba_srgb
    elif settings.channel == "indirect":
        rgba = _indirect(frame, settings)
    else:
        rgba = _over_nothing(_color(frame, settings), frame.gbuffer.coverage)
    return eight_bit(rgba)


def depth_pixels(depth: "Tensor", coverage: "Tensor", rows: int = 256) -> Pixels:
    """8-bit picture of a whole depth map: near is bright, and the farthest point stays visible before black.

    Args:
        rows: that are worked on at once.
    """
    near, far = _depth_range(depth, coverage)
    parts = zip(depth.split(rows), coverage.split(rows), strict=True)
    return np.concatenate([eight_bit(_over_nothing(_grey(_nearness(part, near, far)), covered)) for part, covered in parts])


def linear_channel(state: "FrameState", channel: Channel) -> "Tensor":
    """(height, width, 4) of the values behind a picture: AbstractPicture.linear."""
    import torch

    from drgs.render.film.resolve_frame import linear_picture, resolve_frame

    if channel == "final":
        return linear_picture(state)
    maps = resolve_frame(state).gbuffer
    values = getattr(maps, _MAPS.get(channel, channel))
    values = (values if values.ndim == 3 else values[..., None]).expand(-1, -1, 3)
    nothing = torch.inf if channel == "depth" else 0.0
    covered = maps.coverage[..., None] > 0
    return torch.cat([torch.where(covered, values, nothing), maps.coverage.clamp(0, 1)[..., None]], -1)


def _over_nothing(color: "Tensor", coverage: "Tensor") -> "Tensor":
    """(height, width, 4) of colours with the coverage as alpha, black where nothing is."""
    import torch

    color = torch.where(coverage[..., None] > 0, color, 0.0)
    return torch.cat([color.clamp(0, 1), coverage.clamp(0, 1)[..., None]], -1)


def eight_bit(rgba: "Tensor") -> Pixels:
    import torch

    return rgba.clamp(0, 1).mul_(255).add_(0.5).to(torch.uint8).cpu().numpy()


def _indirect(frame: "Frame", settings: Settings) -> "Tensor":
    """(height, width, 4) sRGB: the light that other surfaces send, under exposure and tone curve."""
    from drgs.render.film.tonemap import tonemap

    light = frame.radiance.indirect
    assert light is not None, "the frame was made without split_indirect"
    return tonemap(light, frame.gbuffer.coverage, settings.exposure_stops, curve=settings.tone_curve)


def _color(frame: "Frame", settings: Settings) -> "Tensor":
    """(height, width, 3) in 0..1 for showing."""
    from drgs.maths.color import srgb_from_linear

    maps, channel = frame.gbuffer, settings.channel
    if channel == "albedo":
        return srgb_from_linear(maps.albedo.clamp(0, 1))
    if channel == "certainty":
        return maps.albedo
    if channel == "normal":
        return maps.normal_world * 0.5 + 0.5
    if channel in ("roughness", "metallic"):
        return _grey(getattr(maps, channel))
    if channel == "visibility":
        return _grey(frame.radiance.visibility)
    assert channel == "variance", f"there is no picture of {channel!r}"
    return heat(frame.radiance.variance.clamp(min=0).sqrt() * 2.0**settings.exposure_stops)


def _grey(values: "Tensor") -> "Tensor":
    return values[..., None].expand(-1, -1, 3)


def _depth_range(depth: "Tensor", coverage: "Tensor") -> tuple[float, float]:
    seen = depth[coverage > 0.5]
    return (float(seen.min()), float(seen.max())) if len(seen) else (0.0, 1.0)


def _nearness(depth: "Tensor", near: float, far: float) -> "Tensor":
    import torch

    return torch.nan_to_num(1 - 0.9 * (depth - near) / max(far - near, 1e-6), 0.0, 0.0, 0.0)


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
