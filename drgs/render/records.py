"""What passes between render steps, on one page."""

from dataclasses import dataclass, field

from jaxtyping import Bool, Float, Int
from torch import Tensor


@dataclass(frozen=True, eq=False)
class GBuffer:
    """What the camera sees, one entry a pixel. Written by rasterize_gbuffer or trace_primary, read by sample_rays, shade, denoise.

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


@dataclass(frozen=True, eq=False)
class Frame:
    """A finished picture."""

    rgba_srgb: Float[Tensor, "height width 4"]
    """Straight alpha, sRGB, 0..1."""
    radiance_linear: Float[Tensor, "height width 3"]
    gbuffer: GBuffer
    radiance: Radiance
    metadata: dict = field(default_factory=dict)
    """Plain JSON: samples, seconds per step, what was skipped and why."""
