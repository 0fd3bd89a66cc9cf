"""What passes between render steps, on one page, in the order of a ray.

A frame is asked for (RenderSettings, FrameInputs) and planned (RenderPlan); the camera sees surfaces (GBuffer, ShadingPoints, RayStarts, PrimaryPoints);
rays leave them and meet others (Rays, Hits, TracedRays); what they bring is summed at their points (ShadedPoints); what an earlier camera saw
helps (History, Reprojected); sums become a picture (Radiance, Frame). A frame between two passes is progressive/frame_state.py's.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.exchange.pictures import encode_png
from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedScene, PrimarySurface
from drgs.scene.tone_curve import ToneCurve

DenoiseMethod = Literal["none", "svgf", "oidn"]

# ---- what is asked for ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class SampleCounts:
    """Samples a point of each strategy; 16/8/8 is the published split for 32."""

    cosine: int = 16
    ggx: int = 8
    environment: int = 8

    @property
    def total(self) -> int:
        return self.cosine + self.ggx + self.environment


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
    split_indirect: bool = False
    """Sum the light that comes from other surfaces once more by itself (Radiance.indirect)."""
    primary: PrimarySurface | None = None
    """What the camera sees; None: what the scene prefers (PosedScene.primary)."""
    denoise: DenoiseMethod = "none"
    """Of what resolve_frame shows; the sums stay as they are."""
    target_error: float | None = None
    """Relative standard error at which a tile of the image gets no more rays (converge.py); None: all get samples_per_pixel."""
    skip: bool = True
    """Leave out what the scene does not need (drgs/render/integrate/plan.py)."""
    skip_error: float = 0.0
    """Share of the cosine-weighted sky that may be taken for open without asking, at faces where the mesh provably blocks no more."""
    keep_light: bool = False
    """A denoised picture of one pass after a camera's move is a moving one: a mesh is seen through the middles of pixels, by a quarter of the
    rays, and diffuse light is read that is kept on it (progressive/kept_light); the next pass begins anew with all rays. For whoever shows
    pictures to somebody who moves."""
    seed: int = 0
    exposure: float = 0.0
    """[stops]."""
    tone_curve: ToneCurve = "standard"
    background: Literal["transparent", "environment", "blurred"] | tuple[float, float, float] = "transparent"
    """blurred: the environment out of focus; the light stays sharp. A colour is a screen's linear one, which exposure and curve leave alone."""


@dataclass(frozen=True, eq=False)
class FrameInputs:
    """All that a frame depends on. What a change of one of them makes old is invalidate.py's."""

    scene: PosedScene
    camera: Camera
    settings: RenderSettings
    band: slice | None = None
    """Rows of the image that the frame holds, from a tile's edge to a tile's edge; None: all of them. Its maps, sums and tiles are those of
    these rows alone, while pixels keep their numbers in the image, which seed their random numbers."""

    @property
    def rows(self) -> slice:
        """Of the image that the frame holds."""
        return slice(0, self.camera.height) if self.band is None else self.band

    @property
    def height(self) -> int:
        """Rows that the frame holds [pixels]."""
        return self.rows.stop - self.rows.start

    @property
    def first_pixel(self) -> int:
        """Number in the image of the frame's first pixel."""
        return self.rows.start * self.camera.width

    @property
    def primary(self) -> PrimarySurface:
        """What the camera sees."""
        return self.settings.primary or self.scene.primary


@dataclass(frozen=True)
class Skip:
    """One thing left out."""

    what: str
    why: str
    bound: str
    """Of the difference it makes."""


@dataclass(frozen=True)
class RenderPlan:
    """How a frame's samples are spent. Written by plan_frame, read by refine_frame."""

    counts: SampleCounts
    """Samples a pass before points share them out by material."""
    by_material: bool
    bounces: int
    skips: tuple[Skip, ...]
    candidates: int = 1
    """Directions that each environment sample chooses among (environment_pool.py)."""
    moving: bool = False
    """A first pass by itself is shown while the camera moves (plan.PIXEL_MIDDLES, plan.FEWER_RAYS)."""
    kept_light: bool = False
    """It may read light that is kept on the mesh."""
    swift: bool = False
    """Light rays behind a first pass take the tree that tests no edges (plan.SWIFT_RAYS)."""
    spread_places: bool = False
    """Passes look through more places of some pixels of a tile and fewer of others (spread_places.py)."""
    every_other: bool = False
    """A first pass by itself is shown after an edit, and has rays in every other pixel (plan.EVERY_OTHER)."""


# ---- what the camera sees ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class GBuffer:
    """What the camera sees, one entry a pixel. Written by rasterize_gbuffer or trace_primary, read by shading_points, denoise.

    Maps are alpha-normalised (sum w f / sum w): coverage is applied once, when compositing.
    """

    coverage: Float[Tensor, "height width"]
    """Accumulated opacity, 0..1; the other maps mean nothing where it is 0."""
    depth: Float[Tensor, "height width"]
    """Distance along the viewing axis [world units]; +inf where nothing is hit."""
    position_world: Float[Tensor, "height width 3"]
    """The point that is shaded."""
    normal_world: Float[Tensor, "height width 3"]
    """Unit shading normal, facing the camera."""
    wo_world: Float[Tensor, "height width 3"]
    """Unit direction from the point to the camera."""
    albedo: Float[Tensor, "height width 3"]
    roughness: Float[Tensor, "height width"]
    metallic: Float[Tensor, "height width"]


@dataclass(frozen=True, eq=False)
class ShadingPoints:
    """The points of a G-buffer that get light, packed. Every estimator works on these."""

    position_world: Float[Tensor, "point 3"]
    normal_world: Float[Tensor, "point 3"]
    wo_world: Float[Tensor, "point 3"]
    albedo: Float[Tensor, "point 3"]
    roughness: Float[Tensor, "point"]
    metallic: Float[Tensor, "point"]
    pixel: Int[Tensor, "point"]
    """Row-major pixel index; seeds the random numbers, so an image does not depend on batching."""


@dataclass(frozen=True, eq=False)
class RayStarts:
    """Where the rays of shading points leave from. Written by trace_primary or lift_points, read by the integrators."""

    origin_world: Float[Tensor, "point 3"]
    """On the outer side of the mesh, the tracer's lift away from it."""
    surface_normal_world: Float[Tensor, "point 3"]
    """Unit normal of the triangle itself: light from below it is blocked by the surface, whatever the shading normal says."""
    face: Int[Tensor, "point"] | None = None
    """That triangle; -1 where a point stands on none."""


@dataclass(frozen=True, eq=False)
class PrimaryPoints:
    """The covered pixels of one pass. Written by trace_primary, or by start_frame of a rasterised G-buffer; read by refine_frame."""

    points: ShadingPoints
    starts: RayStarts
    depth: Float[Tensor, "point"]
    """Along the viewing axis [world units]."""
    barycentric: Float[Tensor, "point 2"] | None = None
    """In the starts' triangles, where the camera sees the mesh."""
    ray: Int[Tensor, "point"] | None = None
    """Which of the listed camera rays found each point, where a list named their rounds."""


# ---- what rays meet ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Rays:
    """Sampled directions at shading points, several a point, grouped by strategy: cosine, GGX, environment."""

    origin_world: Float[Tensor, "point 3"]
    """Shading position lifted off the surface along the normal."""
    direction_world: Float[Tensor, "point sample 3"]
    weight: Float[Tensor, "point sample"]
    """Balance heuristic: 1 / sum_k n_k p_k(direction); 0 where the sample is void (below the horizon)."""


@dataclass(frozen=True, eq=False)
class Hits:
    """First surfaces that rays meet; one entry a ray, rays flattened."""

    hit: Bool[Tensor, "ray"]
    distance: Float[Tensor, "ray"]
    """[world units]; +inf where nothing is hit."""
    face: Int[Tensor, "ray"]
    """int32; -1 where nothing is hit."""
    barycentric: Float[Tensor, "ray 2"]
    """Weights of the face's second and third vertex."""


@dataclass(frozen=True, eq=False)
class TracedRays:
    """The rays of one estimate, from starts that must still be the same when they are used again (ray_memory.py)."""

    direction_world: Float[Tensor, "ray 3"]
    """NaN for rays that were not traced."""
    hit: Bool[Tensor, "ray"]
    face: Int[Tensor, "ray"] | None
    """None where only visibility was asked for."""
    barycentric: Float[Tensor, "ray 2"] | None


# ---- what they bring -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class ShadedPoints:
    """One estimate of the light that shading points send to the camera. Written by the integrators, summed by refine_frame."""

    diffuse: Float[Tensor, "point 3"]
    specular: Float[Tensor, "point 3"]
    variance: Float[Tensor, "point 3"]
    """Of the luminance of this one estimate, from the scatter of its samples within each strategy: whole, diffuse, specular."""
    visibility: Float[Tensor, "point"]
    """Open share of the cosine-weighted sky, 0..1."""
    indirect: Float[Tensor, "point 3"] | None = None
    """The part of diffuse + specular that other surfaces send; None unless asked for (RenderSettings.split_indirect)."""
    indirect_diffuse: Float[Tensor, "point 3"] | None = None
    """The diffuse part of that."""


@dataclass(frozen=True, eq=False)
class Radiance:
    """Linear outgoing radiance per pixel with what denoising and progress need."""

    diffuse: Float[Tensor, "height width 3"]
    specular: Float[Tensor, "height width 3"]
    variance: Float[Tensor, "height width"]
    """Of the mean luminance."""
    visibility: Float[Tensor, "height width"]
    """Share of cosine-weighted sky that is open, 0..1."""
    samples: int
    """Rays a pixel behind the mean."""
    diffuse_variance: Float[Tensor, "height width"] | None = None
    """Of the mean diffuse luminance, from the scatter of samples; what the denoiser goes by."""
    specular_variance: Float[Tensor, "height width"] | None = None
    indirect: Float[Tensor, "height width 3"] | None = None
    """The part of diffuse + specular that other surfaces send, as the samples have it (neither denoised nor with history); None unless
    asked for."""


@dataclass(frozen=True, eq=False)
class DemodulatedLight:
    """Radiance over the reflectance that textures carry. Written by demodulate_albedo, read by denoisers and history."""

    diffuse: Float[Tensor, "height width 3"]
    specular: Float[Tensor, "height width 3"]
    variance: Float[Tensor, "height width 2"]
    """Of the diffuse and specular luminance above."""


# ---- what was seen before the camera moved -------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class History:
    """A picture before the camera moved. Written by remember, read by reproject."""

    camera: Camera
    gbuffer: GBuffer
    light: DemodulatedLight
    samples: Float[Tensor, "height width 2"]
    """Behind the diffuse and the specular part."""


@dataclass(frozen=True, eq=False)
class Reprojected:
    """History in the pixels of the present view. Written by reproject, read by blend_history."""

    light: DemodulatedLight
    samples: Float[Tensor, "height width 2"]
    """0 where history was rejected."""


# ---- the picture ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Frame:
    """A finished picture."""

    rgba_srgb: Float[Tensor, "height width 4"]
    """Straight alpha, sRGB, 0..1."""
    radiance_linear: Float[Tensor, "height width 3"]
    surface_in_window: GBuffer
    """Of the part of the image that shows something, or of all of it."""
    light_in_window: Radiance
    pad_fn: Callable[[Tensor, float], Tensor]
    """From a map of that part, and what stands around it, to one of the whole image. Most who show a picture never ask for its maps."""
    metadata: dict = field(default_factory=dict)
    """Plain JSON: samples, seconds per step, what was skipped and why."""

    @cached_property
    def gbuffer(self) -> GBuffer:
        """The whole image's."""
        maps = {name: self.pad_fn(values, torch.inf if name == "depth" else 0.0) for name, values in vars(self.surface_in_window).items()}
        return GBuffer(**maps)

    @cached_property
    def radiance(self) -> Radiance:
        """The whole image's."""
        light = self.light_in_window
        maps: dict[str, Any] = {name: self.pad_fn(values, 0.0) for name, values in vars(light).items() if isinstance(values, Tensor)}
        return replace(light, **maps)

    def __repr__(self) -> str:
        return f"Frame of {self.rgba_srgb.shape[1]}x{self.rgba_srgb.shape[0]} pixels"

    def _repr_png_(self) -> bytes:
        """What notebooks show of it: the picture alone."""
        return encode_png((self.rgba_srgb.clamp(0, 1) * 255).round().byte().cpu().numpy())
