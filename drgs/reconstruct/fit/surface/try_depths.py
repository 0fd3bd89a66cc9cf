"""The surface moves to where photographs are explained better: it is tried at several depths, shaded anew there, and compared.

Shading alone cannot say how deep a place lies: on a hollow that the hull filled, paint that varies from place to place explains most of a
picture, and so do wrong normals. But paint and normals are one for all views, and from a wrong depth each view sees them elsewhere. So a trial moves the
surface along its normals, gives normals and materials a few steps to explain the photographs from there, and asks of each place what error is
left. First all of it moves, a little inward and a little outward: where that explains much worse, the surface was right. The other places are loose; they
are tried at more depths while the right ones stand still. Each wishes for the depth of least error, as firmly as the error rises around it;
wishes are made to agree with their surroundings', and a last trial decides: what is not explained better there stays where it was.

Nothing here asks what a place is made of. On the bunny, moves by a fortieth of the radius left 1.27 times the error or more at all of 196 right
places, 4.8 times in the median, and 0.73 to 1.4 times at those that lay 0.02 to 0.04 too far out, white plain paint (docs/decisions/0003-fitting.md).

In: the state of a fit on the mesh (fit_surface), photographs. Out: that state, its surface moved.
Source: plane sweeping (Collins 1996) and space carving (Kutulakos and Seitz 2000), with the whole fit in place of the comparison of colours
(docs/sources.md: collins1996, kutulakos2000).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.reconstruct.fit.cost_in_slices import cost_in_slices
from drgs.reconstruct.fit.fit_loop import FitLoop, FitReport, FitState, StepLoss, run_fit
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.light.mesh_light import MeshLight
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.losses import crossed_halves, crossed_squares
from drgs.reconstruct.fit.surface.fit_surface import NOT_FITTED, SurfaceRates
from drgs.reconstruct.fit.surface.moving_surface import MovingSurface, mesh_from_surface_fit
from drgs.reconstruct.fit.surface.prior_terms import prior_terms
from drgs.reconstruct.fit.surface.shade_surface import (
    SOLID,
    SeenPlaces,
    joined,
    packed_surface,
    seen_places,
    shade_photographs,
    steep_enough,
)
from drgs.reconstruct.fit.surfel_parameters import leaves, make_optimizer, rate_of_group
from drgs.reconstruct.fit.view_targets import drawn_view, whole_targets
from drgs.reconstruct.geometry.agree_along_edges import agree_along_edges
from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix, rings_as_wide_as
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.reconstruct.geometry.thickness import thickness
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.mesh import vertex_normals
from drgs.scene.views import Views

BARE = 0.005
"""Coverage below which a pixel shows none of the object."""
AROUND_MASK = 8
"""[pixels] around the mask in which the object must not be seen."""
FOREIGN_ERROR = 0.05
"""Squared error (display values) of a pixel of the background in which the object is seen."""
NOISE = 1e-4
"""Squared error (display values) that is always there."""
REACH = 0.35
"""Share of the object's thickness that a trial may sink it by."""
FEWEST = 0.1
"""Pixels at a vertex, averaged around, below which nothing is known of it."""
UNIT = 0.01
"""Of the radius: curvatures are of the relative error over depths in this unit."""


@dataclass(frozen=True)
class TrialSettings:
    """Where the surface is tried, and how it is decided. Depths are shares of the object's radius, inward."""

    screen: tuple[float, ...] = (-0.02, 0.02)
    """Depths at which the whole surface is tried: where that explains much worse it is right ..."""
    loose: float = 1.3
    """... namely with so many times the error. The others are loose."""
    depths: tuple[float, ...] = (-0.02, -0.008, 0.008, 0.02, 0.035, 0.055, 0.08)
    """At which loose places are tried. None goes to the first or the last of them: there is no minimum (agreed_depth)."""
    steps: int = 50
    """Of normals and materials at each depth."""
    rates: SurfaceRates = field(
        default_factory=lambda: SurfaceRates(
            normals=0.005, albedo_logits=0.01, roughness_logits=0.01, metallic_logits=0.01, environment=0.0
        )
    )
    weight_bend: float = 0.0015
    weight_smooth: float = 0.02
    pixels: int = 16_000
    """Of each photograph."""
    share_rays: int = 16
    """A vertex, for the irradiance that arrives there."""
    spread: float = 0.02
    """Of the radius: how far around errors are averaged, the width of a Gaussian. Less, and plain paint gets pits (still_life's plate, with half of it)."""
    wish: float = 0.95
    """Share of the error that is left at the best depth, at most: else a place wishes to stay."""
    decisive: float = 0.7
    """Below this share a place is the more certain of its depth the less is left, however flat the error is around it."""
    most_curved: float = 1.0
    """Curvature beyond which a place is no more certain of its depth."""
    right: float = 0.3
    """The same of places that were found right."""
    hold: float = 0.02
    """Of every place, as a curvature: plain paint in plain light may be anywhere."""
    together: float = 0.1
    """Weight of moves being equal within `spread`, against a curvature of 1."""
    still: float = 0.003
    """Lesser moves are for normals to make ..."""
    moved: float = 0.006
    """... and from here on a move is made as it was wished for."""
    better: float = 0.97
    """Share of the error that is left where a move is kept, at most."""

    @property
    def iterations(self) -> int:
        """Steps of all trials together: where it is twice, the screening, the depths and the last one."""
        return (len(self.screen) + len(self.depths) + 3) * self.steps


@dataclass(frozen=True, eq=False)
class TriedDepths:
    """What trials found."""

    parameters: dict[str, Tensor]
    """Of the surface where it is now."""
    depth: Float[Tensor, "vertex"]
    """By which it moved inward [world units]."""
    ratios: Float[Tensor, "vertex depth"]
    """Error of the loose places at settings.depths over that where they were; nan where not known."""
    loose: Bool[Tensor, "vertex"]


def try_depths(
    views: Views,
    parameters: dict[str, Tensor],
    faces: Int[Tensor, "face 3"],
    settings: TrialSettings,
    radius: float,
    seed: int,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> TriedDepths | None:
    """Where trials explain the photographs better; None: should_stop(), asked before each step, said so.

    Args:
        parameters: of a surface's fit. radius: of the object's bounding sphere [world units]. report: is told of the steps of all trials.
    """
    trials = Trials(views, faces, settings, seed, report, should_stop)
    edges, count = trials.edges, len(parameters["vertices"])
    around = averaging_matrix(edges, count)
    rings = rings_as_wide_as(settings.spread * radius, edges, parameters["vertices"])
    outward = averaged(around, vertex_normals(parameters["vertices"], faces), 2 * rings)
    inward = -torch.nn.functional.normalize(outward, dim=-1)

    def smoothed(values: Tensor) -> Tensor:
        return averaged(around, values.float().view(count, -1), rings).squeeze(1)

    first = trials.settled(parameters)
    # Once more where it is, so that all that is compared had as many steps.
    here = trials.settled(first.parameters)
    most = REACH * thickness(here.tracer, torch.arange(count, device=inward.device), inward)

    def tried(depth: Tensor, only: Tensor | None = None) -> tuple[dict[str, Tensor], Tensor]:
        """The surface settled there, and the ratio of its errors to those here."""
        moved = trials.settled(_sunk(first.parameters, depth, inward, faces), here, only)
        return moved.parameters, error_ratio(smoothed(moved.errors), smoothed(here.errors))

    def reached(share: float, where: Tensor) -> Tensor:
        return smoothed(where * torch.minimum(torch.full_like(most, share * radius), most))

    screened = torch.stack([tried(reached(share, torch.ones_like(most)))[1] for share in settings.screen], 1)
    loose = smoothed(screened.nan_to_num(nan=math.inf).amin(1) < settings.loose) > 0.5
    if not loose.any() and not trials.stopped:
        nothing = torch.zeros_like(most)
        return TriedDepths(here.parameters, nothing, torch.full((count, len(settings.depths)), math.nan, device=most.device), loose)
    only = smoothed(smoothed(loose)) > 0
    ratios = torch.stack([tried(reached(share, loose.to(most)), only)[1] for share in settings.depths], 1)

    depth = torch.minimum(
        agreed_depth(
            ratios, loose, settings, lambda weight, wish: agree_along_edges(edges.vertices, weight, wish, settings.together * rings)
        )
        * radius,
        most,
    )
    after, ratio = tried(depth, only)
    kept = smoothed((ratio < settings.better) & (depth != 0)) > 0.5
    share = smoothed(kept)  # slopes between what goes and what stays
    depth = share * depth
    result = _sunk(here.parameters, depth, inward, faces)
    for name in ("normals", "albedo_logits", "roughness_logits", "metallic_logits"):
        weight = share.view(count, *[1] * (result[name].ndim - 1))
        result[name] = weight * after[name] + (1 - weight) * result[name]
    return None if trials.stopped else TriedDepths(result, depth, ratios, loose)


def error_ratio(there: Float[Tensor, "vertex 2"], before: Float[Tensor, "vertex 2"]) -> Float[Tensor, "vertex"]:
    """Mean error of one trial over that of another; nan where either compares next to nothing.

    Args:
        there, before: sums of squared errors, and numbers of pixels, averaged around.
    """
    known = torch.minimum(there[:, 1], before[:, 1]) > FEWEST
    error, base = ((sums[:, 0] / sums[:, 1].clamp(min=1e-9)).clamp(min=0) + NOISE for sums in (there, before))
    return torch.where(known, error / base, torch.full_like(error, math.nan))


def preferred_depth(
    depths: Float[Tensor, "depth"], ratios: Float[Tensor, "vertex depth"]
) -> tuple[Float[Tensor, "vertex"], Float[Tensor, "vertex"]]:
    """(vertex,) depth of least error, by the parabola through the best of the depths and those beside it, and (vertex,) its curvature over UNIT.

    Args:
        depths: in rising order [of the radius]. ratios: relative errors there; curvature is 0 where one is nan.
    """
    known = ~torch.isnan(ratios).any(1)
    ratios = ratios.nan_to_num(nan=1.0)
    middle = ratios.argmin(1).clamp(1, len(depths) - 2)
    beside = torch.stack([middle - 1, middle, middle + 1], 1)
    x, y = depths[beside] / UNIT, ratios.gather(1, beside)
    below, above = (x[:, 1] - x[:, 0]), (x[:, 2] - x[:, 1])
    left, right = (y[:, 1] - y[:, 0]) / below, (y[:, 2] - y[:, 1]) / above
    curvature = ((right - left) / (below + above)).clamp(min=1e-6)
    slope = (left * above + right * below) / (below + above)  # at the middle
    best = (x[:, 1] - slope / (2 * curvature)).clamp(x[:, 0], x[:, 2]) * UNIT
    return best, torch.where(known, curvature, torch.zeros_like(curvature))


def agreed_depth(ratios: Tensor, loose: Tensor, settings: TrialSettings, agree: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """(vertex,) how far each place should sink [of the radius], in agreement with its surroundings.

    A place that is explained best at the end of what was tried wishes to stay: there is no minimum. On metal it mirrors something else from there;
    of such places of the teapot 22 % would get better, of those explained best in between 93 to 98 %.
    """
    depths, order = torch.tensor((0.0, *settings.depths)).to(ratios).sort()
    with_here = torch.cat([torch.ones_like(ratios[:, :1]), ratios], 1)[:, order]
    wish, curvature = preferred_depth(depths, with_here)
    left = with_here.nan_to_num(nan=1.0).amin(1)
    curvature = torch.maximum(curvature, 1 - left / settings.decisive)
    best = with_here.nan_to_num(nan=1.0).argmin(1)
    wishes = loose & (left < settings.wish) & (best > 0) & (best < len(depths) - 1)
    wish = torch.where(wishes, wish, torch.zeros_like(wish))
    certain = torch.where(loose, curvature.clamp(max=settings.most_curved), torch.full_like(curvature, settings.right))
    agreed = agree(certain + settings.hold, wish * certain / (certain + settings.hold))
    firm = ((agreed.abs() - settings.still) / (settings.moved - settings.still)).clamp(0, 1)
    return agreed * firm * firm * (3 - 2 * firm)


def _sunk(parameters: dict[str, Tensor], depth: Tensor, inward: Tensor, faces: Tensor) -> dict[str, Tensor]:
    """The same with vertices moved by `depth` (vertex,), and normals turned as the surface turns."""
    vertices = parameters["vertices"] + depth[:, None] * inward
    turned = vertex_normals(vertices, faces) - vertex_normals(parameters["vertices"], faces)
    normals = torch.nn.functional.normalize(parameters["normals"], dim=-1) + turned
    return parameters | {"vertices": vertices, "normals": torch.nn.functional.normalize(normals, dim=-1)}


@dataclass(frozen=True, eq=False)
class Settled:
    """A surface after some steps of normals and materials where it stands."""

    parameters: dict[str, Tensor]
    tracer: AbstractTracer
    errors: Float[Tensor, "vertex 2"]
    """Sum of the squared errors of the pixels at each vertex, and their number."""
    nearest: list[Tensor]
    """Of each photograph: (pixel,) the vertex that it sees; -1 for none."""


class Trials:
    """Final. The photographs, the same pixels of each in all trials."""

    def __init__(
        self,
        views: Views,
        faces: Tensor,
        settings: TrialSettings,
        seed: int,
        report: Callable[[FitReport], None] | None,
        should_stop: Callable[[], bool] | None,
    ) -> None:
        self.edges, self.stopped = mesh_edges(faces), False
        self._views, self._faces, self._settings, self._seed = views, faces, settings, seed
        self._report, self._should_stop, self._done = report, should_stop, 0
        self._targets = whole_targets(views, faces.device)
        generator = torch.Generator().manual_seed(seed)
        self._solid: list[Tensor] = []
        self._bare: list[Tensor] = []
        for target in self._targets:
            near = torch.nn.functional.max_pool2d(target.mask[None], 2 * AROUND_MASK + 1, 1, AROUND_MASK)[0] > BARE
            solid, bare = (shown.flatten().nonzero().squeeze(1) for shown in (target.mask > SOLID, near & (target.mask < BARE)))
            share = settings.pixels / max(len(solid), 1)
            for chosen, all_pixels in ((self._solid, solid), (self._bare, bare)):
                chosen.append(all_pixels[(torch.rand(len(all_pixels), generator=generator) < share).to(faces.device)])

    def settled(self, parameters: dict[str, Tensor], beside: Settled | None = None, only: Tensor | None = None) -> Settled:
        """The surface with normals and materials that explain the photographs from where it is.

        Args:
            beside: what it is compared with. only: (vertex,) of those places alone: pixels that see none of them, neither here nor there, are left out.
        """
        settings = self._settings
        values = leaves({name: value.detach().clone() for name, value in parameters.items()}, frozen=NOT_FITTED)
        state = FitState(values, make_optimizer(values, settings.rates, 1.0), torch.Generator().manual_seed(self._seed + 1))
        surface = MovingSurface(self._views, self._faces, state)
        surface.relight(settings.share_rays)
        environment = environment_table(values).detach()
        light_of = surface.light_of(filter_environment(environment))
        seen, nearest = self._seen(surface.tracer, beside, only)

        def compared(index: int, packed: Tensor) -> SeenPlaces:
            return seen[index][steep_enough(seen[index], packed[:, :3])]

        def shown(
            index: int, places: SeenPlaces, tracer: AbstractTracer, packed: Tensor, light: MeshLight, generator: torch.Generator
        ) -> tuple[Tensor, Tensor, Tensor]:
            """Two estimates of the colours of a view's places, and the photograph's colours."""
            return shade_photographs([joined([places, places])], [self._targets[index]], tracer, packed, lambda _: light, generator)

        def materials_of_now() -> AbstractTracer:
            return surface.tracer.with_materials(mesh_from_surface_fit(state, self._faces))

        def step(iteration: int) -> StepLoss:
            index = drawn_view(iteration, len(self._targets), self._seed)
            packed = packed_surface(values)
            terms = prior_terms(
                self.edges, environment, packed, values["metal"], settings.weight_bend, settings.weight_smooth, 0.0, 0.0, 0.0
            )
            tracer, light = materials_of_now(), light_of(self._targets[index])
            with torch.no_grad():
                places = compared(index, packed)

            def cost(start: int, end: int, leaves: tuple[Tensor, ...], generator: torch.Generator) -> tuple[Tensor, Tensor]:
                some = places[torch.arange(start, end, device=places.pixels.device)]
                first, second, photo = shown(index, some, tracer, leaves[0], light, generator)
                squared = (first.detach().clamp(0, 1) - photo).square().sum()
                return crossed_halves(first, second, photo) * photo.numel() if len(some.pixels) else leaves[0].sum() * 0, squared[None]

            squared_error, count = None, 3 * len(places.pixels)
            if count:
                total, squares = cost_in_slices(len(places.pixels), (packed,), cost, state.generator)
                terms["shaded"], squared_error = total / count, float(squares) / count
            return StepLoss(terms, self._targets[index].camera, squared_error)

        def rates(iteration: int) -> dict[str, float]:
            late = max(0.0, 2 * iteration / settings.steps - 1)
            share = 0.525 + 0.475 * math.cos(math.pi * late)
            return {group["name"]: rate_of_group(group["name"], settings.rates) * share for group in state.optimizer.param_groups}

        run_fit(FitLoop(state, settings.steps, len(self._targets), step, rates), self._tell, self._stops)
        self._done += settings.steps
        errors = torch.zeros(len(values["vertices"]), 2, device=self._faces.device)
        with torch.no_grad():
            packed, tracer = packed_surface(values), materials_of_now()
            for index, target in enumerate(self._targets):
                if self.stopped:
                    break
                places = compared(index, packed)
                first, second, photo = shown(index, places, tracer, packed, light_of(target), state.generator)
                # A square would count the noise of mirrored rays, which hollows have and what fills them has not.
                error = crossed_squares(first, second, photo)
                errors.index_add_(0, places.nearest, torch.stack([error, torch.ones_like(error)], 1))
                foreign = seen_places(target, self._bare[index], surface.tracer).nearest
                wrong = torch.tensor([FOREIGN_ERROR, 1.0], device=errors.device)
                errors.index_add_(0, foreign, wrong.expand(len(foreign), 2))
        return Settled({name: value.detach() for name, value in values.items()}, surface.tracer, errors, nearest)

    def _seen(self, tracer: AbstractTracer, beside: Settled | None, only: Tensor | None) -> tuple[list[SeenPlaces], list[Tensor]]:
        """Of each photograph, the places that are compared, and `Settled.nearest`."""
        every, nearest = [], []
        for index, (target, solid) in enumerate(zip(self._targets, self._solid, strict=True)):
            seen = seen_places(target, solid, tracer)
            at = torch.full_like(target.mask, -1, dtype=torch.long).flatten()
            at[seen.pixels] = seen.nearest
            if beside is not None and only is not None:
                before = beside.nearest[index][torch.searchsorted(solid, seen.pixels)]
                seen = seen[only[seen.nearest] | ((before >= 0) & only[before.clamp(min=0)])]
            every.append(seen)
            nearest.append(at[solid])
        return every, nearest

    def _tell(self, r: FitReport) -> None:
        if self._report is not None:
            self._report(replace(r, iteration=self._done + r.iteration, iterations=self._settings.iterations))

    def _stops(self) -> bool:
        self.stopped = self.stopped or (self._should_stop is not None and self._should_stop())
        return self.stopped
