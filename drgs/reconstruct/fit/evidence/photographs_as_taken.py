"""Photographs at the size at which they were taken, one at a time, as targets beside those of the fits, which saw smaller ones.

In: the capture, its views and targets as the fits saw them. Out: on demand, the target of one photograph again, larger: the same camera, exposure and
mask, which nobody knows better than the fits.
"""

from dataclasses import replace

import torch

from drgs.reconstruct.capture.load_views.capture import Capture, Photograph, camera_of
from drgs.reconstruct.capture.load_views.read_pictures import Window, read_pictures
from drgs.reconstruct.fit.view_targets import ViewTarget, view_targets
from drgs.scene.camera import Camera
from drgs.scene.views import Views


class PhotographsAsTaken:
    """Final. Reads a photograph when it is asked for, so that all of them never lie in memory together."""

    def __init__(self, capture: Capture, views: Views, targets: list[ViewTarget], side: int) -> None:
        """
        Args:
            views: of the capture; some of its photographs may be missing. targets: of view_targets(views, 1, ...). side: the longer one is at most this [pixels].
        """
        by_name = {photograph.name: photograph for photograph in capture.photographs}
        self._capture, self._views, self._targets, self._side = capture, views, targets, side
        self._photographs = [by_name[camera.name] for camera in views.cameras]

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Of the targets that are given."""
        cameras = []
        for photograph, view in zip(self._photographs, self._views.cameras, strict=True):
            window = self._window(photograph, view)
            seen = camera_of(photograph.camera_from_world, window.of_pinhole(photograph.pinhole), view.name)
            cameras.append(seen if window.width > view.width else view)
        return tuple(cameras)

    def _window(self, photograph: Photograph, view: Camera) -> Window:
        """The part of the photograph that the view shows (look_nearer), as large as it may be."""
        pinhole, intrinsics = photograph.pinhole, view.intrinsics.double()
        scales = float(intrinsics[0, 0]) / pinhole.fx, float(intrinsics[1, 1]) / pinhole.fy
        left, top = (
            round(whole - float(intrinsics[axis, 2]) / scale)
            for axis, whole, scale in ((0, pinhole.cx, scales[0]), (1, pinhole.cy, scales[1]))
        )
        width, height = round(view.width / scales[0]), round(view.height / scales[1])
        rows, columns = slice(max(0, top), min(pinhole.height, top + height)), slice(max(0, left), min(pinhole.width, left + width))
        width, height = columns.stop - columns.start, rows.stop - rows.start
        scale = min(1.0, self._side / max(width, height))
        return Window(rows, columns, max(1, round(width * scale)), max(1, round(height * scale)))

    def target(self, number: int) -> ViewTarget:
        """Of the view with this number; the fits' own where the photograph is no larger.

        Raises:
            ValueError: its file is damaged, or gone.
        """
        small, photograph = self._targets[number], self._photographs[number]
        window = self._window(photograph, self._views.cameras[number])
        if max(window.width, window.height) <= max(small.camera.width, small.camera.height):
            return small
        large = read_pictures(replace(self._capture, photographs=(photograph,)), None, windows=[window])
        size = large.coverage[0].shape
        coverage = self._views.coverage[number][None, None].float()
        mask = torch.nn.functional.interpolate(coverage, size, mode="bilinear", align_corners=False)[0, 0].round().to(torch.uint8)
        gains = None if self._views.gains is None else (self._views.gains[number],)
        tints = None if self._views.tints is None else (self._views.tints[number],)
        return view_targets(replace(large, coverage=(mask,), gains=gains, tints=tints), 1.0, small.mask.device)[0]
