"""What a frame leaves out, and why: facts about the scene in, a RenderPlan out.

Most rules are exact in expectation: they move samples between strategies or drop work whose result is known; `bound` says where one is
not. With `skip` off nothing is left out, and tests compare both. The plan is reported in the frame's metadata.
What one frame takes over from another is invalidate.py's.
"""

from dataclasses import dataclass, replace
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from drgs.maths.constants import F0
from drgs.render.integrate.environment_pool import CANDIDATES
from drgs.render.integrate.sample_rays import sample_counts
from drgs.render.records import FrameInputs, RenderPlan, SampleCounts, Skip
from drgs.scene.environment import Environment
from drgs.scene.materials import Materials
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene, PrimarySurface

EVEN_SKY = 1e-3
"""A sky whose texels differ by no more than this share is sampled as well by the cosine."""
CONCENTRATED = 0.05
"""Spread of a sky (light_spread) below which half of the samples go to it. Measured at 8 samples a pixel, direct light: a dielectric under
lamps (spread 0.026) has half the error, under a dawn (0.11) a quarter more."""
WORTH_CHOOSING = 0.15
"""Spread of a sky below which environment samples choose among several directions (environment_pool.py). Measured over skies of 0.0001 to 0.37
(docs/decisions/0004): from 0.2 on it no longer pays everywhere."""
ROUGH = 0.7
"""From this roughness on the lobe of a dielectric is so broad that cosine samples find it."""

LEAST_DIFFUSE = 0.75
"""Share of the reflected energy from which a place may show light that is kept on the mesh: where it is less, the specular part needs the rays that
it has."""
WORTH_KEEPING = 0.1
"""Share of such places below which kept light is not asked: asking costs 3 % of a moving picture of metal, and brings nothing there."""

MOVING_SHARE, LEAST_MOVING = 1 / 4, 4
"""Rays of a moving picture as a share of those asked for, and at least; no more than were asked for. With a quarter, through the middles of pixels, pictures
of a camera that turns by a degree err less than with all rays through any places (docs/performance.md)."""

PIXEL_MIDDLES = Skip(
    "places of a pixel besides its middle, in a moving picture",
    "one ray through the middle is nearer to the mean over the pixel than one through any other place",
    "outlines and textures finer than a pixel are aliased; none at rest, where passes look through all of it",
)
FEWER_RAYS = Skip(
    "three quarters of a moving picture's rays",
    "the pictures before it and the filter make up for them",
    "the noise of a quarter of the rays where the camera saw nothing before; none at rest, where all rays are traced",
)
EVERY_OTHER = Skip(
    "rays of every other pixel in the first picture after an edit",
    "neighbours on the same surface say what they would bring",
    "the noise of half the rays, and mirror images finer than two pixels are blurred; none from the next picture on",
)
SWIFT_RAYS = Skip(
    "tests that no light ray passes between triangles with a common edge",
    "Embree is a fifth faster without",
    "a ray through an edge may be lost: of a million rays on each of three assets not one; none in the first pass at rest",
)
SPREAD_PLACES = Skip(
    "places of pixels whose places agree",
    "from the fifth pass on, passes look through other pixels nearby instead, whose places differ",
    "exact in the mean, but for the share that a pixel has in what a whole row of tiles may spend",
)
KEPT_LIGHT = Skip(
    "diffuse rays of a moving picture",
    "light kept on the mesh's vertices says what they would bring",
    "a standard error of at most 20 %, and a quarter between the corners of a face; none at rest, where all rays are traced",
)
LENT_SPECULAR = Skip(
    "mirror rays of three in four pixels of rough paint in a moving picture",
    "neighbours on the same surface, whose diffuse light is kept as well, say what they would bring",
    "the noise of fewer rays, and what paint of a roughness of 0.3 and more mirrors is blurred over three pixels; none at rest, where all rays are traced",
)
KEPT_HITS = Skip(
    "rays from surfaces that a moving picture's rays meet",
    "light kept on the mesh's vertices says what these surfaces send",
    "a standard error of at most 20 %, and what they mirror, at most a quarter, is sent to all sides alike; none at rest, where all rays are traced",
)


@dataclass(frozen=True)
class SceneFacts:
    """What plan_frame looks at besides the light; over all surfaces, seen or not."""

    largest_diffuse: float
    """Of (1 - metallic) times the albedo's largest channel."""
    largest_metallic: float
    smallest_roughness: float
    empty_tiles: int = 0
    """Tiles of the image without a surface, of `tiles`."""
    tiles: int = 0
    diffuse_share: float = 1.0
    """Of the mesh's vertices, those that reflect LEAST_DIFFUSE diffusely."""


def scene_facts(scene: PosedScene, empty_tiles: int = 0, tiles: int = 0, primary: PrimarySurface = "gaussians") -> SceneFacts:
    """Facts about the materials of what cameras and rays see: the mesh, and the Gaussians where those are the primary surface."""
    carriers: list[TriangleMesh | Materials] = [scene.mesh]
    if scene.surfels is not None and primary == "gaussians":
        carriers.append(scene.surfels.materials)
    diffuse, metallic, roughness = zip(*map(_extremes, carriers), strict=True)
    return SceneFacts(max(diffuse), max(metallic), min(roughness), empty_tiles, tiles, _diffuse_share(scene.mesh))


_known_extremes: WeakKeyDictionary[TriangleMesh | Materials, tuple[float, float, float]] = WeakKeyDictionary()
"""Every picture of a moving camera asks for them."""


def _extremes(m: TriangleMesh | Materials) -> tuple[float, float, float]:
    """Largest diffuse part, largest metallic, smallest roughness."""
    if m not in _known_extremes:
        diffuse = float(((1 - m.metallic) * _largest_channel(m.albedo)).max())
        _known_extremes[m] = diffuse, float(m.metallic.max()), float(m.roughness.min())
    return _known_extremes[m]


def _largest_channel(albedo: Tensor) -> Tensor:
    red, green, blue = albedo.unbind(-1)  # torch takes twenty times as long for rows of three
    return torch.maximum(torch.maximum(red, green), blue)


_diffuse_shares: WeakKeyDictionary[TriangleMesh, float] = WeakKeyDictionary()


def _diffuse_share(mesh: TriangleMesh) -> float:
    if mesh not in _diffuse_shares:
        base = _largest_channel(mesh.albedo)
        diffuse, specular = (1 - mesh.metallic) * base, F0 * (1 - mesh.metallic) + mesh.metallic * base
        _diffuse_shares[mesh] = float((diffuse >= LEAST_DIFFUSE * (diffuse + specular)).float().mean())
    return _diffuse_shares[mesh]


_spreads: WeakKeyDictionary[Environment, float] = WeakKeyDictionary()


def light_spread(environment: Environment) -> float:
    """Share of the sphere that lights, 0..1: (mean L)^2 / mean L^2 of the largest channel; 1 for an even sky, 1e-4 under a midday sun."""
    if environment not in _spreads:
        radiance = environment.radiance.detach().amax(-1).double()
        height = len(radiance)
        polar = (torch.arange(height, device=radiance.device, dtype=torch.float64) + 0.5) * (torch.pi / height)
        weight = torch.sin(polar) / torch.sin(polar).sum()
        mean, square = (weight @ values.mean(1) for values in (radiance, radiance.square()))
        _spreads[environment] = float(mean * mean / square.clamp(min=1e-300))
    return _spreads[environment]


def samples_per_pass(inputs: FrameInputs) -> SampleCounts:
    """Samples of each strategy that a pass is asked for, before the plan moves any."""
    settings = inputs.settings
    return settings.counts or sample_counts(settings.samples_per_pass or (4 if inputs.primary == "mesh" else 32))


def plan_frame(
    environment: Environment,
    intensity: float,
    counts: SampleCounts,
    bounces: int,
    skip: bool,
    facts: SceneFacts | None = None,
    skip_error: float = 0.0,
    counts_given: bool = False,
    moving: bool = False,
    spread_places: bool = False,
) -> RenderPlan:
    """The plan for a scene's light and a frame's settings.

    Args:
        counts: samples a pass of each strategy as asked for.
        skip: False leaves nothing out.
        facts: None: nothing is known of the surfaces.
        skip_error: share of the sky that rays may be spared without proof (RenderSettings).
        counts_given: `counts` are what somebody asked for by name: each of these samples stays one direction.
        moving: a first pass by itself is shown while the camera moves.
        spread_places: passes may look through more places of some pixels than of others.
    """
    if not skip:
        return RenderPlan(counts, False, bounces, ())
    skips = []
    darkest, brightest = (float(x) for x in environment.radiance.detach().aminmax())
    if brightest * intensity <= 0:
        skips.append(Skip("light rays", "the sky is black", "exact"))
        return RenderPlan(SampleCounts(0, 0, 0), False, 0, tuple(skips))
    if facts is not None and facts.empty_tiles:
        why = f"nothing can be seen in {facts.empty_tiles} of {facts.tiles} tiles of the picture"
        skips.append(Skip("rays through empty tiles", why, "exact"))
    if counts.environment > 0 and brightest - darkest <= EVEN_SKY * brightest:
        skips.append(Skip("environment samples", "the sky is even: they go to the other strategies", "exact in the mean"))
        ggx = counts.ggx + counts.environment // 2
        counts = SampleCounts(counts.total - ggx, ggx, 0)
    elif counts.environment > 0 and (spread := light_spread(environment)) < CONCENTRATED:
        environment_samples = max(counts.environment, counts.total // 2)
        ggx = min(counts.ggx, (counts.total - environment_samples + 1) // 2)
        why = f"the light comes from {100 * spread:.2g} % of the sky"
        skips.append(Skip("part of the cosine and GGX samples", f"{why}: they go to the environment", "exact in the mean"))
        counts = SampleCounts(counts.total - environment_samples - ggx, ggx, environment_samples)
    if facts is not None and facts.largest_diffuse <= 0 and counts.cosine > 0 and counts.total > counts.cosine:
        skips.append(Skip("cosine samples", "no surface has a diffuse part: they go to the other strategies", "exact in the mean"))
        counts = SampleCounts(0, counts.ggx + counts.cosine, counts.environment)
    if facts is not None and facts.largest_metallic <= 0 and facts.smallest_roughness >= ROUGH and counts.ggx > 0 and counts.cosine > 0:
        skips.append(Skip("GGX samples", "every surface is rough and no metal: cosine samples find its lobe", "exact in the mean"))
        counts = SampleCounts(counts.cosine + counts.ggx, 0, counts.environment)
    by_material = counts.ggx > 0 and counts.cosine + counts.environment > 0
    if by_material:
        skips.append(
            Skip("samples of strategies that a point's material hardly needs", "they go to its other strategies", "exact in the mean")
        )
    skips += [_rays_above_horizons(skip_error), SWIFT_RAYS, *([SPREAD_PLACES] if spread_places else [])]
    candidates = 1
    if counts.environment > 0 and not counts_given and (spread := light_spread(environment)) < WORTH_CHOOSING:
        candidates = CANDIDATES
        why = (
            f"the light comes from {100 * spread:.2g} % of the sky: an environment sample takes one of {candidates} directions, by its BRDF"
        )
        skips.append(Skip("rays to lamps that a point hardly reflects", why, "exact in the mean"))
    kept_light = moving and facts is not None and facts.diffuse_share >= WORTH_KEEPING
    if moving:
        fewer = moving_counts(counts).total < counts.total
        skips += [PIXEL_MIDDLES, *([FEWER_RAYS] if fewer else []), *([KEPT_LIGHT, LENT_SPECULAR] if kept_light else [])]
        skips += [KEPT_HITS] if kept_light and bounces == 1 else []
    return RenderPlan(counts, by_material, bounces, tuple(skips), candidates, moving, kept_light, True, spread_places)


def _rays_above_horizons(skip_error: float) -> Skip:
    why = "horizons of faces, the asset's or found as rays pay for them"
    if skip_error <= 0:
        return Skip("tracing of rays that leave above all the mesh has there", why, "exact")
    bound = f"at most {100 * skip_error:g} % of the cosine-weighted sky at a point taken for open"
    return Skip("tracing of rays that leave above nearly all the mesh has there", why, bound)


def at_rest(plan: RenderPlan) -> RenderPlan:
    """The same for passes that trace all their rays."""
    skips = tuple(skip for skip in plan.skips if skip not in (PIXEL_MIDDLES, FEWER_RAYS, KEPT_LIGHT, LENT_SPECULAR, KEPT_HITS, EVERY_OTHER))
    return replace(plan, moving=False, every_other=False, kept_light=False, skips=skips)


def after_edit(plan: RenderPlan) -> RenderPlan:
    """The same with rays in every other pixel of a first pass that is shown by itself."""
    return replace(plan, every_other=True, skips=(*plan.skips, EVERY_OTHER)) if plan.counts.total > 0 else plan


def moving_counts(counts: SampleCounts) -> SampleCounts:
    """Of a moving picture, where a pass at rest has `counts`; a strategy that has samples keeps at least one."""
    total = min(counts.total, max(LEAST_MOVING, int(MOVING_SHARE * counts.total)))
    share = total / max(1, counts.total)
    ggx, environment = (min(count, max(1, int(share * count))) for count in (counts.ggx, counts.environment))
    if counts.cosine > 0:
        return SampleCounts(total - ggx - environment, ggx, environment)
    return SampleCounts(0, total - environment, environment)
