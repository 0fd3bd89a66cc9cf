"""A progressive frame between passes, and the settings it is made with."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal

from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.render.environment_table import EnvironmentTable
from drgs.render.image_tiles import Window, window_of_tiles
from drgs.render.plan import RenderPlan
from drgs.render.ray_memory import RayMemory
from drgs.render.records import GBuffer
from drgs.render.reproject import History, Reprojected
from drgs.render.sample_rays import SampleCounts, sample_counts
from drgs.render.trace_primary import PrimaryPoints
from drgs.render.tracer import AbstractTracer
from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedScene
from drgs.scene.tone_curve import ToneCurve


@dataclass(frozen=True)
class RenderSettings:
    """How a frame is made."""

    samples_per_pixel: int = 32
    """Light samples behind a finished frame."""
    samples_per_pass: int | None = None
    """Light samples a pass adds; None: 32 on Gaussians, 4 on a mesh, whose passes are its antialiasing as well."""
    counts: SampleCounts | None = None
    """Samples of each strategy a pass; None: 2:1:1. Overrides samples_per_pass."""
    bounces: int = 1
    """Surfaces light may meet on its way from the environment to the visible one; 0: direct light and shadows only."""
    primary: Literal["gaussians", "mesh"] | None = None
    """What the camera sees; None: the Gaussians where the scene has any."""
    denoise: Literal["none", "svgf", "oidn"] = "none"
    """Of what resolve_frame shows; the sums stay as they are."""
    target_error: float | None = None
    """Relative standard error at which a tile of the image gets no more rays (converge.py); None: all get samples_per_pixel."""
    skip: bool = True
    """Leave out what the scene does not need (drgs/render/plan.py)."""
    skip_error: float = 0.0
    """Share of the cosine-weighted sky that may be taken for open without asking, at faces where the mesh provably blocks no more."""
    seed: int = 0
    exposure: float = 0.0
    """[stops]."""
    tone_curve: ToneCurve = "standard"
    background: Literal["transparent", "environment", "blurred"] | tuple[float, float, float] = "transparent"
    """blurred: the environment out of focus; the light stays sharp. A colour is a screen's linear one, which exposure and curve leave alone."""


@dataclass(frozen=True, eq=False)
class FrameState:
    """A frame in the making. Sums run over passes and are weighted by coverage; pixels are flat, row-major."""

    scene: PosedScene
    camera: Camera
    settings: RenderSettings
    tracer: AbstractTracer
    table: EnvironmentTable
    light: Any
    """EnvironmentLight struct."""
    plan: RenderPlan
    fixed: PrimaryPoints | None
    """The points of every pass, when the camera sees Gaussians."""
    seen: Bool[Tensor, "tile"]
    """Tiles that may show a surface."""
    memory: RayMemory
    """Of the first pass's rays."""
    first: PrimaryPoints | None
    """The points of the first pass on a mesh, once known."""
    gbuffer: GBuffer | None
    """Given by the rasteriser; None when the mesh is traced: then `surface` holds running sums."""
    diffuse: Float[Tensor, "pixel 3"]
    specular: Float[Tensor, "pixel 3"]
    weight: Float[Tensor, "pixel"]
    """Passes that found a surface."""
    luminance: Float[Tensor, "pixel"]
    luminance_squared: Float[Tensor, "pixel"]
    scatter: Float[Tensor, "pixel 3"]
    """Sum of the passes' own variance estimates: whole luminance, diffuse, specular."""
    visibility: Float[Tensor, "pixel"]
    surface: Float[Tensor, "pixel 15"]
    """Sums of position, normal, wo, albedo, roughness, metallic, depth; of a mesh."""
    tile_passes: Int[Tensor, "tile"]
    """Passes that each tile has had."""
    active: Bool[Tensor, "tile"]
    """Tiles that get more rays."""
    history: History | None
    """Of the window of the view before a camera's move, until the first pass shows what can be used of it."""
    reprojected: Reprojected | None
    """What can be used of it, in the window."""
    made: tuple[str, ...]
    """Parts that were computed for this frame; the others were taken over from the frame before (invalidate.py)."""
    seconds: dict[str, float]
    """Of each step, summed over passes."""

    @cached_property
    def window(self) -> Window:
        """Around the tiles that may show a surface."""
        return window_of_tiles(self.seen, self.camera.width, self.camera.height)

    @property
    def passes(self) -> int:
        """Passes of the tiles that have had most."""
        return int(self.tile_passes.max())


def samples_a_pass(settings: RenderSettings, mesh: bool) -> SampleCounts:
    """Samples of each strategy that a pass is asked for, before the plan moves any.

    Args:
        mesh: whether the camera sees the mesh.
    """
    return settings.counts or sample_counts(settings.samples_per_pass or (4 if mesh else 32))


def passes_needed(state: FrameState) -> int:
    """Passes that the settings' samples a pixel ask for, in all."""
    total = samples_a_pass(state.settings, state.fixed is None).total
    return max(1, -(-state.settings.samples_per_pixel // total))


def rays_key(settings: RenderSettings, mesh: bool) -> tuple:
    """What of the settings changes the rays that are shot."""
    return (mesh, samples_a_pass(settings, mesh), settings.bounces, settings.skip, settings.skip_error, settings.seed)
