"""A frame between two passes, in sections: what it is made of, what rays meet, what the camera sees, and what has been summed."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.render.integrate.environment_table import EnvironmentTable
from drgs.render.integrate.plan import moving_counts, samples_per_pass
from drgs.render.intersect.ray_memory import RayMemory
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.progressive.frame_sums import FrameSums
from drgs.render.progressive.invalidate import Part
from drgs.render.progressive.kept_light.kept_light import KeptLight
from drgs.render.progressive.quick_picture import QuickPicture
from drgs.render.records import FrameInputs, GBuffer, History, PrimaryPoints, RenderPlan, Reprojected
from drgs.render.visible.image_tiles import Window, window_of_tiles


@dataclass(frozen=True, eq=False)
class TracedScene:
    """What rays meet, and the light that they find."""

    tracer: AbstractTracer
    environment_table: EnvironmentTable
    environment_light: Any
    """EnvironmentLight struct: the table with its turn and strength."""


@dataclass(frozen=True, eq=False)
class GaussianView:
    """What the camera sees of Gaussians: the same points in every pass."""

    gbuffer: GBuffer
    primary_points: PrimaryPoints


@dataclass(frozen=True, eq=False)
class MeshView:
    """What the camera sees of a mesh: each pass looks through another place of the pixel."""

    first_primary_points: PrimaryPoints | None = None
    """Of the first pass over all covered tiles, once it is made: the next frame may start with them."""


@dataclass(frozen=True, eq=False)
class Tiles:
    """How far each tile of the image is."""

    covered: Bool[Tensor, "tile"]
    """May show a surface; at least one does."""
    passes: Int[Tensor, "tile"]
    """That it has had."""
    active: Bool[Tensor, "tile"]
    """Gets more rays."""


@dataclass(frozen=True, eq=False)
class FrameState:
    """A frame in the making. Written by start_frame and refine_frame, read by refine_frame and resolve_frame; each pass makes a new one."""

    inputs: FrameInputs
    traced: TracedScene
    plan: RenderPlan
    view: GaussianView | MeshView
    tiles: Tiles
    sums: FrameSums
    rates: Int[Tensor, "pixel"] | None
    """int32, quarters of a place a pass that pixels have since the last look (spread_places.py); None: a place in each."""
    first_rays: RayMemory
    """What the first pass's rays met."""
    history: History | None
    """Of the window of the view before a camera's move, until the first pass shows what can be used of it."""
    reprojected: Reprojected | None
    """What can be used of it, in the window."""
    kept_light: KeptLight | None
    """Diffuse light on the mesh that moving pictures read; None until the camera moves."""
    quick_picture: QuickPicture | None
    """What the one pass so far shows, if that is a quick picture's; the frame's sums stay empty."""
    computed_parts: tuple[Part, ...]
    """For this frame; the others were taken over from the frame before (invalidate.py)."""
    seconds: dict[str, float]
    """Of each step, summed over passes."""

    @property
    def is_quick(self) -> bool:
        """Whether the one pass so far is a quick picture: the next pass begins anew, with a moving one as history."""
        return self.quick_picture is not None

    @property
    def kept_samples(self) -> Float[Tensor, "pixel"] | None:
        """Rays behind the kept light that a moving picture shows, 0 where it shows none; None where it was not asked."""
        kept = None if self.quick_picture is None else self.quick_picture.kept_samples
        return None if kept is None else self.window.pad(kept).flatten()

    @property
    def rays_a_pass(self) -> int:
        """Of each pixel; in the mean over pixels, where passes look through some more often (spread_places.py) and first pictures after an edit trace every other one."""
        total = samples_per_pass(self.inputs).total
        if self.quick_picture is None:
            return total
        return max(1, total // 2) if self.quick_picture.of_edit else moving_counts(self.plan.counts).total

    @cached_property
    def window(self) -> Window:
        """Around the tiles that may show a surface."""
        inputs = self.inputs
        return window_of_tiles(self.tiles.covered, inputs.camera.width, inputs.height, inputs.rows.start)

    def in_window(self, values: Tensor) -> Tensor:
        """(rows, columns, ...) of the window: one of the flat sums."""
        return self.window.crop(values.unflatten(0, (self.inputs.height, self.inputs.camera.width)))

    @property
    def places_in_window(self) -> Float[Tensor, "rows columns"]:
        """That were looked through, of each pixel."""
        return self.in_window(self.sums.places)

    @property
    def passes(self) -> int:
        """Passes of the tiles that have had most."""
        return int(self.tiles.passes.max())

    @property
    def samples(self) -> int:
        """Rays a pixel of the tiles that have had most passes."""
        return self.passes * self.rays_a_pass


def with_settings(state: FrameState, **settings: Any) -> FrameState:
    """The same sums under other settings of RenderSettings; start_frame instead finds out whether the sums still hold."""
    return replace(state, inputs=replace(state.inputs, settings=replace(state.inputs.settings, **settings)))


def with_seconds(state: FrameState, seconds: dict[str, float]) -> FrameState:
    """The same with the time of steps booked."""
    booked = dict(state.seconds)
    for step, duration in seconds.items():
        booked[step] = booked.get(step, 0.0) + duration
    return replace(state, seconds=booked)


def passes_needed(state: FrameState) -> int:
    """Passes that the settings' samples a pixel ask for, in all."""
    return max(1, -(-state.inputs.settings.samples_per_pixel // samples_per_pass(state.inputs).total))
