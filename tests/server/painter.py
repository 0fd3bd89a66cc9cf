"""A renderer that paints: red is the number of edits, green the exposure, blue the samples. Loading and posing cost nothing."""

import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from drgs.scene.edits import DeformEdit, Edit, SimulateEdit
from drgs_server.live.messages import CameraMessage, Settings
from drgs_server.render.interface import (
    AbstractLoadedAsset,
    AbstractPicture,
    AbstractPose,
    AbstractRenderer,
    AbstractStill,
    Bounds,
    Explanation,
    Layers,
    LinearPixels,
    Picked,
    Pixels,
    Positions,
    view_of_bounds,
)

BOUNDS = Bounds((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


class Painter(AbstractRenderer):
    def __init__(self, pass_seconds: float = 0.0) -> None:
        self.pass_seconds = pass_seconds
        self.pose_seconds = 0.0
        self.simulation_seconds = 0.0
        self.loads = 0
        self.recalled: list[int] = []
        """How many edits of a long log were known from a file, each time that one was opened."""
        self.light_bytes = 0
        self.frame_bytes = 0
        self.prepared = 0
        self.stills = 0
        self.slices = 0
        """Of work on stills."""
        self.begun: list[tuple[int, int]] = []
        self.threads: set[str] = set()

    def load(self, folder: Path, environments: Path) -> "PaintedAsset":
        self.loads += 1
        return PaintedAsset(self)

    def environment_bytes(self) -> int:
        return self.light_bytes

    def forget_environments(self) -> None:
        self.light_bytes = 0

    def prepare(self) -> None:
        self.prepared += 1


class PaintedAsset(AbstractLoadedAsset):
    def __init__(self, painter: Painter) -> None:
        self.painter = painter
        self.bounds = BOUNDS
        self.start_view = view_of_bounds(BOUNDS)
        self.light_camera = None

    def pose(self, edits: Sequence[Edit], previous: AbstractPose | None, go_on: Callable[[], None] | None = None) -> "PaintedPose":
        if any(isinstance(edit, DeformEdit) for edit in edits):
            raise ValueError("This asset is made of stone.")
        time.sleep(self.painter.pose_seconds)
        if go_on is not None and any(isinstance(edit, SimulateEdit) for edit in edits):
            began = time.monotonic()
            while time.monotonic() - began < self.painter.simulation_seconds:
                go_on()
                time.sleep(0.01)
        return PaintedPose(self.painter, len(edits))

    def keep(self, edits: Sequence[Edit], path: Path) -> None:
        path.write_text(str(len(edits)))

    def recall(self, edits: Sequence[Edit], path: Path) -> bool:
        known = path.is_file() and int(path.read_text()) <= len(edits)
        self.painter.recalled.append(int(path.read_text()) if known else 0)
        return known

    def simulation_bytes(self) -> int:
        return self.painter.frame_bytes

    def forget_simulations(self) -> None:
        self.painter.frame_bytes = 0


class PaintedPose(AbstractPose):
    def __init__(self, painter: Painter, edit_count: int) -> None:
        self.painter = painter
        self.edit_count = edit_count

    def begin(self, camera: CameraMessage, settings: Settings, width: int, height: int, previous: AbstractPicture | None) -> "Painting":
        self.painter.begun.append((width, height))
        return Painting(self, settings, width, height)

    def still(self, camera: CameraMessage, settings: Settings, width: int, height: int, linear: bool) -> "PaintedStill":
        self.painter.stills += 1
        return PaintedStill(Painting(self, settings, width, height), linear)

    def vertices(self) -> Positions:
        return np.full((4, 3), self.edit_count, "<f4")

    def layers(self, camera: CameraMessage, settings: Settings, width: int, height: int) -> "PaintedLayers":
        self.painter.stills += 1
        return PaintedLayers(Painting(self, settings, width, height), True)


class PaintedStill(AbstractStill):
    def __init__(self, painting: "Painting", linear: bool) -> None:
        self.painting, self.linear = painting, linear

    def work(self) -> bool:
        if self.painting.samples >= self.painting.samples_target:
            return False
        self.painting.refine()
        self.painting.pose.painter.slices += 1
        return True

    def picture(self) -> Pixels | LinearPixels | Layers:
        return self.painting.linear() if self.linear else self.painting.resolve()


class PaintedLayers(PaintedStill):
    def picture(self) -> Layers:
        pixels = self.painting.linear()
        return {name: np.ascontiguousarray(pixels[..., k]) for k, name in enumerate("RGBA")}


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
