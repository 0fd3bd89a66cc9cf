"""Metal or paint: the fit begins once more as all metal and as all paint, and goes on from what explains more.

Either of them, under a light that was fitted to it, explains much of what the other one shows. So evidence under one light (metal_evidence) repeats
what was believed when that light was fitted. Where light turns with the camera it calls all of a teapot metal under a light that was fitted with metal,
and all paint under one that was fitted with paint; where light stands still and cameras stand in a ring above the teapot, its chrome lid mirrors the
ceiling alone, and is beige paint below a dark ceiling. Here each belief gets a light of its own: materials, normals and light follow the
photographs for some steps with everything held to be of one kind; then evidence is asked under that light, for objects are made of both, what it is
sure of begins anew, and as many steps follow. The beginning that leaves clearly less error (CLEARLY) is kept, with its light; where light stands still
only if the fit as it was, gone on with for as many steps, does not leave clearly less still (BEHIND): an object of several things has some of each kind. Where
neither is kept, the fit goes on as it was; under light that turns as paint.

In: the state of a fit on the mesh (fit_surface), photographs. Out: that state, its surface where it was.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.maths.constants import F0
from drgs.reconstruct.fit.evidence.metal_evidence import FEWEST_VIEWS, ViewSums
from drgs.reconstruct.fit.fit_loop import FitReport, FitState
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.losses import crossed_squares
from drgs.reconstruct.fit.surface.fit_surface import NOT_FITTED, SurfaceSettings, fit_surface
from drgs.reconstruct.fit.surface.moving_surface import MovingSurface, mesh_from_surface_fit
from drgs.reconstruct.fit.surface.shade_surface import SOLID, packed_surface, seen_twice, shade_photographs
from drgs.reconstruct.fit.surfel_parameters import leaves, logits_of_shares, make_optimizer
from drgs.reconstruct.fit.view_targets import ViewTarget, whole_targets
from drgs.scene.views import Views

KINDS = (1.0, 0.0)
"""Metallic of the beginnings: metal, paint."""
CLEARLY = 0.85
"""Share of the other one's error that a beginning leaves, at most, where it is believed. Metal's over paint's in drafts: a metal teapot 0.72 from a ring of cameras
above it, 0.64 under light that turns; metal and paint together 0.82; a painted bunny 1.24 to 1.36, and 1.44. Between lie an eagle, 0.93, whose bronze comes out as dark
paint where it begins as paint, a microphone, 0.99, a mug, 1.01, and bricks, 1.08. Under light that turns, before a camera far away, what mirrors it is any function of
where it faces, and paint a soft one: what soft ones explain nearly as well is paint."""
BEHIND = 1.1
"""Share of the error of the fit as it was, after as many steps, that a kept beginning leaves, at most. Metal's in drafts: metal teapots 0.97 and 1.00; things of several
materials on a plate 1.17, an eagle 1.15; paint's of a painted bunny 1.07."""
BEGUN = 0.95
"""What metallic begins with, of its kind: at the very ends there is no gradient."""
SURE = 0.5
"""Of evidence, -1..1."""
PIXELS = 4_096
"""Of each photograph, at most, by which errors are compared: of a quarter of a million in all their mean is known to a few thousandths, and both beginnings are asked at the same ones."""
PIXELS_A_STEP = 16_384
"""Of all photographs that a step looks at, at most: as many as a draft has. Finer presets, with four times as many, would take as much longer."""
MOST_STEPS = 25
"""Until evidence is asked, and after: what a draft has, too."""
ALBEDO = (0.05, 0.95)
"""That a place may begin with."""


@dataclass(frozen=True, eq=False)
class TriedKinds:
    """What the beginnings came to."""

    parameters: dict[str, Tensor]
    """Of the surface, from the better one; as they were given, where neither is."""
    errors: tuple[float, float]
    """Mean squared error of all photographs (display values): begun as metal, begun as paint."""
    gone_on: float | None = None
    """That of the fit as it was after as many steps; None where it was not asked."""


def try_kinds(
    views: Views,
    parameters: dict[str, Tensor],
    faces: Int[Tensor, "face 3"],
    settings: SurfaceSettings,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    most_steps: int = MOST_STEPS,
) -> TriedKinds | None:
    """The fit gone on with from the beginning that explains the photographs better, or as it was; None: should_stop(), asked before each step, said so.

    Args:
        parameters: of a surface's fit. settings: of a pass; each beginning has as many steps as it, half of them as it began. report: is told of all of them.
        most_steps: in each half.
    """
    few = min(settings.pixels_a_step, PIXELS_A_STEP)
    own = replace(settings, rounds=1, steps_a_round=_half(settings, most_steps), still=True, fall_from=1.0, pixels_a_step=few)
    targets = whole_targets(views, faces.device)
    given = {name: value.detach() for name, value in parameters.items()}
    here = MovingSurface(views, faces, _state(given, own))  # nothing moves
    sums = here.sums(targets)

    def surface_of(state: FitState) -> MovingSurface:
        return MovingSurface(views, faces, state, here)

    def fitted(state: FitState, own: SurfaceSettings, before: int) -> bool:
        """After `before` steps of all; False: should_stop() said so."""

        def tell(r: FitReport) -> None:
            if report is not None:
                report(replace(r, iteration=before + r.iteration, iterations=iterations(settings, most_steps)))

        fit_surface(views, mesh_from_surface_fit(state, faces), state, own, tell, should_stop, here)
        return state.iteration >= own.iterations

    ends: list[tuple[dict[str, Tensor], float]] = []
    for number, kind in enumerate(KINDS):
        state = _state(begun_as(kind, sums, given), own)
        for half in range(2):
            if half:
                found = surface_of(state).look_for_metal(targets, own.moves)
                state = _state(as_evidence_says(found, state.parameters), own)
            if not fitted(state, own, (2 * number + half) * own.iterations):
                return None
        ends.append(({name: value.detach() for name, value in state.parameters.items()}, _error(surface_of(state), state, targets, own)))
    (metal, metal_error), (paint, paint_error) = ends
    better, gone_on = better_kind(metal_error, paint_error, here.light_turns), None
    if better is not None and not here.light_turns:
        long = replace(own, steps_a_round=2 * own.steps_a_round)
        state = _state({name: value.clone() for name, value in given.items()}, long)
        if not fitted(state, long, 2 * len(KINDS) * own.iterations):
            return None
        gone_on = _error(surface_of(state), state, targets, own)
        if not is_believed(min(metal_error, paint_error), gone_on):
            better = None
    return TriedKinds({"metal": metal, "paint": paint, None: given}[better], (metal_error, paint_error), gone_on)


def better_kind(metal_error: float, paint_error: float, light_turns: bool) -> Literal["metal", "paint"] | None:
    """Which beginning is kept; None: neither.

    Args:
        metal_error, paint_error: of TriedKinds.
    """
    if metal_error < CLEARLY * paint_error:
        return "metal"
    return "paint" if light_turns or paint_error < CLEARLY * metal_error else None


def is_believed(error: float, gone_on: float) -> bool:
    """Whether the better beginning is kept that leaves such an error, where the fit as it was leaves `gone_on`."""
    return error <= BEHIND * gone_on


def iterations(settings: SurfaceSettings, most_steps: int = MOST_STEPS) -> int:
    """Steps of both beginnings and of the fit as it was together, at most."""
    return 2 * (len(KINDS) + 1) * _half(settings, most_steps)


def _half(settings: SurfaceSettings, most_steps: int) -> int:
    """Steps until evidence is asked, and after."""
    return max(1, min(settings.iterations // 2, most_steps))


def begun_as(kind: float, sums: ViewSums, parameters: dict[str, Tensor]) -> dict[str, Tensor]:
    """The parameters with everything of one kind, held to be so, and with the albedo that explains the photographs best under the light as it is.

    Args:
        kind: 1 for metal, 0 for paint. sums: of view_sums; places that few views show keep their albedo.
    """
    albedo = sums.reflectance() if kind else diffuse_albedo(sums)
    known = (sums.views >= FEWEST_VIEWS)[:, None]
    albedo = torch.where(known, albedo.clamp(*ALBEDO), torch.sigmoid(parameters["albedo_logits"].detach()))
    metallic = torch.full_like(parameters["metallic_logits"], BEGUN if kind else 1 - BEGUN)
    belief = torch.full_like(parameters["metal"], 2 * kind - 1)
    return parameters | {"albedo_logits": logits_of_shares(albedo), "metallic_logits": logits_of_shares(metallic), "metal": belief}


@torch.no_grad()
def as_evidence_says(sums: ViewSums, parameters: dict[str, Tensor]) -> dict[str, Tensor]:
    """The parameters with what evidence is sure of begun anew where it was of the other kind: by gradients it would be half of each for long.

    Args:
        sums: of view_sums.
    """
    evidence, metallic = parameters["metal"], torch.sigmoid(parameters["metallic_logits"])
    changed = (evidence.abs() > SURE) & ((evidence > 0) != (metallic > 0.5))
    metal, paint = (begun_as(kind, sums, parameters) for kind in KINDS)

    def chosen(name: str) -> Tensor:
        shape = (-1, *[1] * (parameters[name].ndim - 1))
        begun = torch.where((evidence > 0).view(shape), metal[name], paint[name])
        return torch.where(changed.view(shape), begun, parameters[name])

    return parameters | {name: chosen(name) for name in ("albedo_logits", "metallic_logits")}


def diffuse_albedo(sums: ViewSums) -> Float[Tensor, "vertex 3"]:
    """Of the paint that explains the photographs best."""
    return ((sums.pe - sums.eb - F0 * sums.ea) / sums.ee.clamp(min=1e-12)).clamp(0, 1)


def _state(parameters: dict[str, Tensor], settings: SurfaceSettings) -> FitState:
    values = leaves(parameters, frozen=NOT_FITTED)
    return FitState(values, make_optimizer(values, settings.rates, 1.0), torch.Generator().manual_seed(settings.seed + 2))


@torch.no_grad()
def _error(surface: MovingSurface, state: FitState, targets: list[ViewTarget], settings: SurfaceSettings) -> float:
    """Mean squared error (display values) over the pixels that mask and mesh fill, without the noise of mirrored rays."""
    parameters = state.parameters
    packed = packed_surface(parameters)
    light_of = surface.light_of(filter_environment(environment_table(parameters)))
    generator = torch.Generator().manual_seed(settings.seed)
    total, count = 0.0, 0
    for target in targets:
        solid = (target.mask.flatten() > SOLID).nonzero().squeeze(1)
        solid = solid[:: max(1, len(solid) // PIXELS)]
        twice = seen_twice(target, solid, surface.tracer, generator, packed[:, :3])
        first, second, photo = shade_photographs([twice], [target], surface.tracer, packed, light_of, generator)
        total += float(crossed_squares(first, second, photo).sum())
        count += len(photo)
    return total / max(count, 1)
