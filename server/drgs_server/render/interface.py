"""The door between the service and the renderer: what the stream asks of one loaded asset. All of it runs on the render thread.

`drgs_renderer.py` implements it with drgs; tests do with a painter of flat colours. Nothing here imports torch.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from drgs.scene.edits import Edit
from drgs_server.live.messages import CameraMessage, Settings, StartView
from drgs_worker.jobs.start_view import FOV_Y_DEGREES, start_view

Pixels: TypeAlias = np.ndarray
"""(height, width, 4) uint8, sRGB, straight alpha."""
LinearPixels: TypeAlias = np.ndarray
"""(height, width, 4) float32: linear values and coverage."""
Layers: TypeAlias = dict[str, np.ndarray]
"""Name in the EXR -> (height, width) float32."""
Positions: TypeAlias = np.ndarray
"""(vertex, 3) little-endian float32 [world units]."""
Rotation: TypeAlias = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
"""Rows."""
LINEAR_CHANNELS = ("final", "albedo", "roughness", "metallic", "normal", "depth", "certainty")
"""Of which there are values to work with, not only a picture to look at."""


@dataclass(frozen=True)
class Bounds:
    """Of the object at rest [world units]."""

    minimum: tuple[float, float, float]
    maximum: tuple[float, float, float]


@dataclass(frozen=True)
class Picked:
    """The surface under a pixel."""

    position: tuple[float, float, float]
    normal: tuple[float, float, float]
    albedo: tuple[float, float, float]
    roughness: float
    metallic: float
    region: int | None = None
    """Patch of material, as selections number them."""
    rest: tuple[float, float, float] | None = None
    """Where this place lies on the object at rest, up to the size of a face."""


@dataclass(frozen=True)
class Explanation:
    """Of a picture."""

    seconds: dict[str, float]
    """Spent on each step."""
    skipped: tuple[tuple[str, str, str], ...]
    """What was left out, why, and a bound of the difference it makes."""


class AbstractPicture(ABC):
    """One camera's view of one pose, getting better with every refinement."""

    width: int
    height: int
    samples: int
    """Rays a pixel so far."""
    samples_target: int
    notes: tuple[str, ...] = ()
    """What was skipped or reduced, and why."""

    @abstractmethod
    def refine(self) -> None:
        """Add the smallest useful number of samples."""

    @abstractmethod
    def resolve(self) -> Pixels:
        """What there is so far."""

    @abstractmethod
    def linear(self) -> LinearPixels:
        """The values behind it, for one of LINEAR_CHANNELS. `final`: radiance before exposure and tone curve, multiplied with its coverage.
        Others: as they are, with the coverage; 0 where nothing is, depth +inf."""

    @abstractmethod
    def pick(self, x: float, y: float) -> Picked | None:
        """At shares of width and height; None where nothing is hit."""

    @abstractmethod
    def explain(self) -> Explanation:
        """What it cost, and what was left out."""


class AbstractStill(ABC):
    """One finished picture in the making, in memory that hardly grows with its size."""

    @abstractmethod
    def work(self) -> bool:
        """A slice of the work, some hundredths of a second; False once there is nothing left."""

    @abstractmethod
    def picture(self) -> Pixels | LinearPixels | Layers:
        """What was asked for, once the work is done."""


class AbstractPose(ABC):
    """The asset under one list of edits."""

    @abstractmethod
    def begin(
        self, camera: CameraMessage, settings: Settings, width: int, height: int, previous: AbstractPicture | None
    ) -> AbstractPicture:
        """A picture without samples. What it shares with `previous` (same camera, same geometry) is not computed again."""

    @abstractmethod
    def still(self, camera: CameraMessage, settings: Settings, width: int, height: int, linear: bool) -> AbstractStill:
        """A picture that is rendered once, to the samples that the settings ask for: the pixels of an AbstractPicture's, to the bit.

        Args:
            linear: the values behind it (AbstractPicture.linear), not the picture.

        Raises:
            ValueError: a sentence, when the asset does not hold what the channel shows.
        """

    @abstractmethod
    def vertices(self) -> Positions:
        """Of the posed mesh. For any thread."""

    @abstractmethod
    def layers(self, camera: CameraMessage, settings: Settings, width: int, height: int) -> AbstractStill:
        """The values behind every channel that the asset has, as Layers: R G B A albedo.{R,G,B} normal.{X,Y,Z} depth.Z roughness.Y metallic.Y
        visibility.Y indirect.{R,G,B} variance.Y, and certainty.{R,G,B} and surfels.{R,G,B,A} where it has them."""


class AbstractLoadedAsset(ABC):
    """An asset in memory."""

    bounds: Bounds
    start_view: StartView
    light_camera: Rotation | None
    """Of ServerHello."""

    @abstractmethod
    def pose(self, edits: Sequence[Edit], previous: AbstractPose | None, go_on: Callable[[], None] | None = None) -> AbstractPose:
        """Apply edits. What it shares with `previous` (same geometry) is kept.

        Args:
            go_on: called between two steps of what may take long; what it raises ends the work.

        Raises:
            ValueError: a sentence, when an edit cannot be applied.
        """

    @abstractmethod
    def keep(self, edits: Sequence[Edit], path: Path) -> None:
        """Write what was made of these edits, which were posed a moment ago, so that `recall` finds it after a restart.

        Raises:
            OSError: it cannot be written.
        """

    @abstractmethod
    def recall(self, edits: Sequence[Edit], path: Path) -> bool:
        """Let `pose` go on from what `keep` has written, where that is of the first of these edits; returns whether it is."""

    @abstractmethod
    def simulation_bytes(self) -> int:
        """Of the frames of its simulations that are in memory."""

    @abstractmethod
    def forget_simulations(self) -> None:
        """All but the one asked for last leave memory."""


class AbstractRenderer(ABC):
    """Loads assets."""

    @abstractmethod
    def load(self, folder: Path, environments: Path) -> AbstractLoadedAsset:
        """
        Args:
            environments: folder of the files that environment edits name.

        Raises:
            ValueError: the folder holds no readable asset.
        """

    @abstractmethod
    def environment_bytes(self) -> int:
        """Of the environments that are in memory."""

    @abstractmethod
    def forget_environments(self) -> None:
        """Those that no pose holds leave memory."""

    @abstractmethod
    def prepare(self) -> None:
        """What takes long the first time, so that whoever opens an asset need not wait for it. Runs on a thread of its own."""


def view_of_bounds(bounds: Bounds) -> StartView:
    """The camera of `drgs_worker.jobs.start_view` as a message."""
    matrix = start_view(bounds.minimum, bounds.maximum).tolist()
    return StartView.model_validate({"world_from_camera": matrix, "fov_y_degrees": FOV_Y_DEGREES})
