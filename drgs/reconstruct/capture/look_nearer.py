"""Pictures of what is around the object alone, in the place of whole ones that were made small: then the object is larger.

A build makes pictures so small that their longer side has so many pixels, and what is beyond the object takes its part of them: on a table an object
fills a third of a photograph's width. Once masks tell where it is, the photographs are read again, each cut to a window around its mask.

In: the capture, its views as a build has read them, with masks. Out: the same views by windows, whose cameras look through these.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import UInt8
from torch import Tensor

from drgs.reconstruct.capture.load_views.capture import Capture, Pinhole
from drgs.reconstruct.capture.load_views.read_pictures import Window, read_pictures
from drgs.reconstruct.capture.sharpen_masks import sharpen_masks
from drgs.scene.views import Views

MARGIN = 4
"""[pixels of the views] around a mask, and ..."""
MARGIN_SHARE = 12
"""... the longer side of its box over this, on each side: there it is still seen what strays beyond the mask."""
LEAST_GAIN = 1.2
"""By which the median picture must get larger."""


def object_windows(capture: Capture, views: Views, side: int) -> tuple[Window | None, ...] | None:
    """Of each view what to read of its photograph, the longer side `side` pixels at most (None: all of it); None where hardly anything would get larger.

    Args:
        views: of the capture, some may be missing; whole pictures, with masks.
    """
    by_name = {photograph.name: photograph.pinhole for photograph in capture.photographs}
    pinholes = [by_name[camera.name] for camera in views.cameras]
    windows = tuple(_window(pinhole, mask, side) for pinhole, mask in zip(pinholes, views.coverage, strict=True))
    gains = [
        1.0 if window is None else window.width / (window.columns.stop - window.columns.start) * pinhole.width / camera.width
        for window, pinhole, camera in zip(windows, pinholes, views.cameras, strict=True)
    ]
    return windows if float(np.median(gains)) >= LEAST_GAIN else None


def _window(pinhole: Pinhole, mask: UInt8[Tensor, "height width"], side: int) -> Window | None:
    there = [(mask > 0).any(axis).nonzero().flatten() for axis in (1, 0)]
    if not len(there[0]):
        return None
    longer = max(int(places[-1] - places[0]) + 1 for places in there)
    margin = MARGIN + longer / MARGIN_SHARE
    sides = []
    for places, whole, small in zip(there, (pinhole.height, pinhole.width), mask.shape, strict=True):
        first, last = int(places[0]) - margin, int(places[-1]) + 1 + margin
        sides.append(slice(max(0, int(first * whole / small)), min(whole, int(np.ceil(last * whole / small)))))
    rows, columns = sides
    height, width = rows.stop - rows.start, columns.stop - columns.start
    scale = min(1.0, side / max(height, width))
    return Window(rows, columns, max(1, round(width * scale)), max(1, round(height * scale)))


def look_nearer(capture: Capture, views: Views, windows: Sequence[Window | None], has_own_masks: bool, sharpen: bool) -> Views:
    """The views by their windows.

    Args:
        has_own_masks: masks are read again with the photographs; else those of the views are enlarged. sharpen: as of read_pictures.
    """
    by_name = {photograph.name: photograph for photograph in capture.photographs}
    shown = replace(capture, photographs=tuple(by_name[camera.name] for camera in views.cameras))
    small = tuple((camera.height, camera.width) for camera in views.cameras)
    near = read_pictures(shown, None, sharpen and has_own_masks, _windows_or_whole(shown, windows, small))
    cameras = tuple(replace(new, camera_from_world=old.camera_from_world) for new, old in zip(near.cameras, views.cameras, strict=True))
    if has_own_masks:
        return replace(views, cameras=cameras, images_srgb=near.images_srgb, coverage=near.coverage, masks_moved=near.masks_moved)
    pinholes = [photograph.pinhole for photograph in shown.photographs]
    coverage = tuple(
        _enlarged(mask, pinhole, window, camera.height, camera.width)
        for mask, pinhole, window, camera in zip(views.coverage, pinholes, windows, cameras, strict=True)
    )
    found = replace(views, cameras=cameras, images_srgb=near.images_srgb, coverage=coverage)
    return sharpen_masks(found) if sharpen else found


def _windows_or_whole(capture: Capture, windows: Sequence[Window | None], sizes: Sequence[tuple[int, int]]) -> tuple[Window, ...]:
    """The windows, where there is none the whole photograph at the size (rows, columns) that its view has."""
    return tuple(
        Window(slice(0, photograph.pinhole.height), slice(0, photograph.pinhole.width), width, height) if window is None else window
        for photograph, window, (height, width) in zip(capture.photographs, windows, sizes, strict=True)
    )


def _enlarged(
    mask: UInt8[Tensor, "rows columns"], pinhole: Pinhole, window: Window | None, height: int, width: int
) -> UInt8[Tensor, "{height} {width}"]:
    """A view's mask as its window shows it, linear between pixels."""
    if window is None:
        return mask
    y, x = (
        (part.start + (torch.arange(count) + 0.5) * ((part.stop - part.start) / count)) / whole * 2 - 1
        for part, count, whole in ((window.rows, height, pinhole.height), (window.columns, width, pinhole.width))
    )
    grid = torch.stack(torch.meshgrid(y, x, indexing="ij")[::-1], -1)[None].float()
    values = torch.nn.functional.grid_sample(mask[None, None].float(), grid, mode="bilinear", padding_mode="border", align_corners=False)
    return values[0, 0].round().to(torch.uint8)
