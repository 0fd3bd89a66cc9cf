"""Photographs at the size at which they were taken, one at a time, as targets beside those of the fits, which saw smaller ones.

In: the capture, its views and targets as the fits saw them. Out: on demand, the target of one photograph again, larger: the same camera, exposure and
mask, which nobody knows better than the fits.
"""

from dataclasses import replace

import torch

from drgs.reconstruct.capture.load_views.capture import Capture, camera_of, resize_pinhole
from drgs.reconstruct.capture.load_views.read_pictures import read_pictures
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
            pinhole = photograph.pinhole
            scale = min(1.0, self._side / max(pinhole.width, pinhole.height))
            width, height = max(1, round(pinhole.width * scale)), max(1, round(pinhole.height * scale))
            larger = width > view.width
            cameras.append(camera_of(photograph.camera_from_world, resize_pinhole(pinhole, width, height), view.name) if larger else view)
        return tuple(cameras)

    def target(self, number: int) -> ViewTarget:
        """Of the view with this number; the fits' own where the photograph is no larger.

        Raises:
            ValueError: its file is damaged, or gone.
        """
        small, photograph = self._targets[number], self._photographs[number]
        if min(self._side, max(photograph.pinhole.width, photograph.pinhole.height)) <= max(small.camera.width, small.camera.height):
            return small
        large = read_pictures(replace(self._capture, photographs=(photograph,)), self._side)
        size = large.coverage[0].shape
        coverage = self._views.coverage[number][None, None].float()
        mask = torch.nn.functional.interpolate(coverage, size, mode="bilinear", align_corners=False)[0, 0].round().to(torch.uint8)
        gains = None if self._views.gains is None else (self._views.gains[number],)
        tints = None if self._views.tints is None else (self._views.tints[number],)
        return view_targets(replace(large, coverage=(mask,), gains=gains, tints=tints), 1.0, small.mask.device)[0]
