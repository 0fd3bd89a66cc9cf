"""A picture over REST: rendered once, band after band, so that its size costs little more than its own pixels.

Imported only on the render thread; torch only inside functions.
"""

from typing import TYPE_CHECKING

import numpy as np

from drgs_server.live.messages import Settings
from drgs_server.render.channels import channel_pixels, depth_pixels, eight_bit, linear_channel
from drgs_server.render.interface import AbstractStill, LinearPixels, Pixels

if TYPE_CHECKING:
    from collections.abc import Iterator

    from torch import Tensor

    from drgs.render.render_bands import Band
    from drgs.scene.camera import Camera
    from drgs.scene.posed_scene import PosedScene

SLICE_SECONDS = 0.06
"""Viewers' pictures come in between."""


class Still(AbstractStill):
    """Final."""

    def __init__(self, bands: "Iterator[Band | None]", height: int, width: int, settings: Settings, linear: bool) -> None:
        """
        Args:
            bands: of the picture, each rendered as `settings` say.
        """
        import torch

        self._bands = bands
        self._settings = settings
        self._linear = linear
        # How near a point is shown follows from the nearest and the farthest of all: depths are kept until the last band is there.
        self._depth: Tensor | None = None
        self._coverage: Tensor | None = None
        if settings.channel == "depth" and not linear:
            self._depth, self._coverage = torch.empty(height, width), torch.empty(height, width)
        else:
            self._pixels = np.empty((height, width, 4), np.float32 if linear else np.uint8)

    def work(self) -> bool:
        from drgs.render.film.resolve_frame import resolve_frame

        try:
            band = next(self._bands)
        except StopIteration:
            return False
        if band is None:
            return True
        if self._linear:
            self._pixels[band.rows] = linear_channel(band.state, self._settings.channel)[band.within].cpu().numpy()
            return True
        frame = resolve_frame(band.state)
        if self._depth is not None and self._coverage is not None:
            self._depth[band.rows], self._coverage[band.rows] = frame.gbuffer.depth[band.within], frame.gbuffer.coverage[band.within]
        else:
            self._pixels[band.rows] = channel_pixels(frame, self._settings)[band.within]
        return True

    def picture(self) -> Pixels | LinearPixels:
        if self._depth is not None and self._coverage is not None:
            return depth_pixels(self._depth, self._coverage)
        return self._pixels


class SurfelStill(AbstractStill):
    """Final. The surfels themselves."""

    def __init__(self, scene: "PosedScene", camera: "Camera") -> None:
        from drgs.render.render_bands import band_rows

        self._scene, self._camera = scene, camera
        self._left = band_rows(camera.width, camera.height)
        self._pixels = np.zeros((camera.height, camera.width, 4), np.uint8)
        if scene.surfels is None:
            self._left.clear()

    def work(self) -> bool:
        from drgs.render.visible.draw_surfels import draw_surfels

        if not self._left or self._scene.surfels is None:
            return False
        rows = self._left.pop(0)
        self._pixels[rows] = eight_bit(draw_surfels(self._scene.surfels, self._camera, rows))
        return True

    def picture(self) -> Pixels:
        return self._pixels
