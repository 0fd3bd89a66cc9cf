"""What a frame leaves out, and why: facts about the scene in, a RenderPlan out.

Every rule here is exact in expectation: it moves samples between strategies or drops work whose result is known. With
`skip` off nothing is left out, and a test compares both. The plan is reported in the frame's metadata.
"""

from dataclasses import dataclass

from drgs.render.sample_rays import SampleCounts
from drgs.scene.environment import Environment

EVEN_SKY = 1e-3
"""A sky whose texels differ by no more than this share is sampled as well by the cosine."""


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


def plan_frame(environment: Environment, intensity: float, counts: SampleCounts, bounces: int, skip: bool) -> RenderPlan:
    """The plan for a scene's light and a frame's settings.

    Args:
        counts: samples a pass of each strategy as asked for.
        skip: False leaves nothing out.
    """
    if not skip:
        return RenderPlan(counts, False, bounces, ())
    skips = []
    darkest, brightest = (float(x) for x in environment.radiance.detach().aminmax())
    if brightest * intensity <= 0:
        skips.append(Skip("light rays", "the sky is black", "exact"))
        return RenderPlan(SampleCounts(0, 0, 0), False, 0, tuple(skips))
    if counts.environment > 0 and brightest - darkest <= EVEN_SKY * brightest:
        skips.append(Skip("environment samples", "the sky is even: they go to the other strategies", "exact in the mean"))
        ggx = counts.ggx + counts.environment // 2
        counts = SampleCounts(counts.total - ggx, ggx, 0)
    by_material = counts.cosine > 0 and counts.ggx > 0
    if by_material:
        skips.append(
            Skip("samples of strategies that a point's material hardly needs", "they go to its other strategies", "exact in the mean")
        )
    return RenderPlan(counts, by_material, bounces, tuple(skips))
