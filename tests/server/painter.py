"""A renderer that paints: red is the number of edits, green the exposure, blue the samples. Loading and posing cost nothing."""

import threading
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drgs.scene.edits import DeformEdit, Edit
from server.messages import CameraMessage, Settings
from server.render_session import (
    AbstractLoadedAsset,
    AbstractPicture,
    AbstractPose,
    AbstractRenderer,
    Bounds,
    Explanation,
    LinearPixels,
    Picked,
    Pixels,
    view_of_bounds,
)

BOUNDS = Bounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


class Painter(AbstractRenderer):
    def __init__(self, pass_seconds: float = 0.0) -> None:
        self.pass_seconds = pass_seconds
        self.pose_seconds = 0.0
        self.loads = 0
        self.prepared = 0
        self.begun: list[tuple[int, int]] = []
        self.threads: set[str] = set()

    def load(self, folder: Path, environments: Path) -> "PaintedAsset":
        self.loads += 1
        return PaintedAsset(self)

    def prepare(self) -> None:
        self.prepared += 1


class PaintedAsset(AbstractLoadedAsset):
    def __init__(self, painter: Painter) -> None:
        self.painter = painter
        self.bounds = BOUNDS
        self.start_view = view_of_bounds(BOUNDS)

    def pose(self, edits: Sequence[Edit], previous: AbstractPose | None) -> "PaintedPose":
        if any(isinstance(edit, DeformEdit) for edit in edits):
            raise ValueError("This asset is made of stone.")
        time.sleep(self.painter.pose_seconds)
        return PaintedPose(self.painter, len(edits))


class PaintedPose(AbstractPose):
    def __init__(self, painter: Painter, edit_count: int) -> None:
        self.painter = painter
        self.edit_count = edit_count

    def begin(self, camera: CameraMessage, settings: Settings, width: int, height: int, previous: AbstractPicture | None) -> "Painting":
        self.painter.begun.append((width, height))
        return Painting(self, settings, width, height)


class Painting(AbstractPicture):
    def __init__(self, pose: PaintedPose, settings: Settings, width: int, height: int) -> None:
        self.pose, self.settings, self.width, self.height = pose, settings, width, height
        self.samples, self.samples_target = 0, settings.spp_target

    def refine(self) -> None:
        self.pose.painter.threads.add(threading.current_thread().name)
        time.sleep(self.pose.painter.pass_seconds)
        self.samples = min(self.samples + 4, self.samples_target)

    def resolve(self) -> Pixels:
        pixels = np.empty((self.height, self.width, 4), np.uint8)
        alpha = 0 if self.settings.background == "transparent" else 255
        pixels[:] = (self.pose.edit_count, int(128 + 10 * self.settings.exposure_stops), min(self.samples, 255), alpha)
        return pixels

    def linear(self) -> LinearPixels:
        pixels = np.empty((self.height, self.width, 4), np.float32)
        transparent = self.settings.background == "transparent"
        pixels[:] = (self.pose.edit_count, 0.25, min(self.samples, 255), 0.5 if transparent else 1.0)
        return pixels

    def explain(self) -> Explanation:
        return Explanation({"paint": 0.25}, (("shadows", "painters do not know them", "none"),))

    def pick(self, x: float, y: float) -> Picked | None:
        return Picked((x, y, 0.0), (0.0, 0.0, 1.0), (0.5, 0.5, 0.5), 0.5, 0.0) if x < 0.5 else None
