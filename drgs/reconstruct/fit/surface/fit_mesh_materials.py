"""Stage 2 on the mesh: albedo, roughness, metallic and the HDR light, by Monte Carlo integration of the full rendering equation on the mesh.

Each step looks at some pixels of one photograph: rays find the mesh behind them, two independent sets of directions are sampled from cosine,
GGX and environment distributions under the balance heuristic, visibility and the light of what is met are traced, and both estimates are
compared with the photo:

    L = L1(PBR, photo) + priors                                                                                               (Eq. 6)

Value and derivative come from different sets, 1/2 [l'(A) dB + l'(B) dA]: with one set for both, the gradient of any loss that is not linear
leans towards low variance, that is to rough and dim. Source: the paper's stage 2 with the parameters of Gu et al. 2025 where it is silent;
independent halves after Nicolet et al. 2023 (docs/sources.md: gu2025irgs, nicolet2023). Exact densities and one definition of F0 throughout.

In rounds: between two the surface follows the normals, which this estimate knows better than split sum does (moving_surface). Light that turns with the
camera is looked for once more before the first one (light_from_turns): the last passes of the surface left it to gradients.

In: the state of fit_surface. Out: the same, further.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor

from drgs.reconstruct.fit.cost_in_slices import cost_in_slices
from drgs.reconstruct.fit.fit_loop import FitLoop, FitReport, FitState, StepLoss, cosine_rates, run_fit
from drgs.reconstruct.fit.light.environment_pyramid import ENVIRONMENT_PYRAMID, environment_table
from drgs.reconstruct.fit.light.ground_light import environment_with_ground, ground_light
from drgs.reconstruct.fit.light.mesh_light import MeshLight, at_corners, light_of_rays
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.losses import crossed_halves, display_image
from drgs.reconstruct.fit.surface.fit_surface import NOT_FITTED, SurfaceRates
from drgs.reconstruct.fit.surface.moving_surface import MoveSettings, MovingSurface, mesh_from_surface_fit
from drgs.reconstruct.fit.surface.prior_terms import prior_terms
from drgs.reconstruct.fit.surface.shade_surface import SOLID, SeenPlaces, packed_surface, photo_of, seen_twice
from drgs.reconstruct.fit.surfel_parameters import leaves, make_optimizer
from drgs.reconstruct.fit.view_targets import ViewTarget, drawn_view, whole_targets
from drgs.reconstruct.geometry.average_around import averaged
from drgs.reconstruct.geometry.integrate_normals import IntegrationSettings
from drgs.render.integrate.environment_table import EnvironmentTable, build_environment_table
from drgs.render.integrate.integrate_samples import integrate_samples
from drgs.render.integrate.sample_rays import sample_rays
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import Rays, SampleCounts, ShadingPoints
from drgs.scene.environment import Environment
from drgs.scene.views import Views

LIGHT_STEPS = 60
"""Of light_without_ground."""


@dataclass(frozen=True)
class MeshMaterialSettings:
    """Stage 2."""

    iterations: int = 300
    rounds: int = 2
    """After each the surface follows its normals, but not after the last one."""
    moves: MoveSettings = field(default_factory=lambda: MoveSettings(IntegrationSettings(home=0.01), to_surface=0.5))
    """Homes hold floors whose height no normal tells: else they drift with every move."""
    points_a_step: int = 4096
    samples: SampleCounts = field(default_factory=lambda: SampleCounts(4, 12, 16))
    """Rays a point in each of two sets: cosine, GGX, environment (the paper: 256, 128, 128 in one); shared out anew by each point's material (split_at).
    Pixels differ more than rays do: half as many rays at twice as many points find more (decisions/0003, "Many points, few rays")."""
    rates: SurfaceRates = field(default_factory=lambda: SurfaceRates(normals=0.0007))
    normals_end: float = 0.00007
    """What the normals' rate has fallen to in the end: mirrors show its noise."""
    gradient_rings: int = 1
    """Edges over which the normals' gradients are averaged; 0: they are not."""
    weight_bend: float = 0.0015
    weight_smooth: float = 0.05
    weight_metal: float = 0.3
    times_light: int = 0
    """That light which turns with the camera is looked for before the first step: each time what the object sends to itself, and its gloss, are of the light
    before. Not in fits of a few steps, which everything else needs to follow the light."""
    weight_white_light: float = 0.002
    """Ten times as much holds each direction's light to grey, whatever the photographs say, and a lamp's colour is missing where metal mirrors it."""
    weight_rough_light: float = 0.002
    seed: int = 0


def start_mesh_materials(surface: FitState, settings: MeshMaterialSettings, radius: float) -> FitState:
    """The surface as it was fitted, at home where it is, with this stage's rates."""
    home = {"homeward": torch.zeros_like(surface.parameters["homeward"])}
    values = leaves(surface.parameters | home, frozen=NOT_FITTED)
    return FitState(values, make_optimizer(values, settings.rates, radius), torch.Generator().manual_seed(settings.seed + 1))


def fit_mesh_materials(
    views: Views,
    faces: Tensor,
    state: FitState,
    settings: MeshMaterialSettings,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> FitState:
    """Run (or go on with) stage 2; see run_fit. Rates fall by a cosine: the estimate is noisy."""
    steps = _Steps(views, faces, state, settings)

    def rates(iteration: int) -> dict[str, float]:
        start, end = settings.rates.normals, settings.normals_end
        left = 0.5 + 0.5 * math.cos(math.pi * iteration / settings.iterations)
        return cosine_rates(state.optimizer, iteration, settings.iterations) | {"normals": end + (start - end) * left}

    return run_fit(
        FitLoop(state, settings.iterations, len(views.cameras), steps.step, rates, steps.share_gradients, steps.end_round),
        report,
        should_stop,
    )


def light_without_ground(
    views: Views, faces: Tensor, state: FitState, middle: Tensor, settings: MeshMaterialSettings, radius: float
) -> Tensor:
    """(128, 256, 3) radiance of the environment that explains the photographs best where nothing but it is around the object as it was fitted: for
    pictures of the object alone. It begins as what was fitted, with the ground as the object's middle sees it.

    Args:
        views: with the ground that `state` was fitted above. middle: of the object [world units]. settings: those of the fit. radius: of start_mesh_materials.
    """
    assert views.ground is not None
    only_light = SurfaceRates(
        normals=0.0, albedo_logits=0.0, roughness_logits=0.0, metallic_logits=0.0, environment=settings.rates.environment
    )
    own = replace(settings, iterations=LIGHT_STEPS, rounds=1, times_light=0, rates=only_light, normals_end=0.0)
    values = {name: value.detach().clone() for name, value in state.parameters.items()}  # the fit's stay what they are
    start = start_mesh_materials(replace(state, parameters=values), own, radius)
    known = environment_table(start.parameters).detach()
    shown = environment_with_ground(known, ground_light(views.ground, known.device), middle.to(known.device))
    with torch.no_grad():
        start.parameters[f"environment_{ENVIRONMENT_PYRAMID[-1]}"] += (shown.clamp(min=1e-3) / known).log().permute(2, 0, 1)[None]
    return environment_table(fit_mesh_materials(replace(views, ground=None), faces, start, own).parameters).detach()


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What rays of a step meet."""

    tracer: AbstractTracer
    """With the materials of now. A swift one: some ten rays in a million slip through an edge, nothing beside a step's noise."""
    light: MeshLight
    table: EnvironmentTable
    """Of the light, for drawing from it."""


class _Steps:
    """Final. Stage 2's part of the fit loop."""

    def __init__(self, views: Views, faces: Tensor, state: FitState, settings: MeshMaterialSettings) -> None:
        self.state, self.settings, self.faces = state, settings, faces
        self.targets = whole_targets(views, faces.device)
        self.solid = [(target.mask.flatten() > SOLID).nonzero().squeeze(1) for target in self.targets]
        self.surface = MovingSurface(views, faces, state)

    @torch.no_grad()
    def share_gradients(self, _: StepLoss) -> None:
        """Of normals, with neighbours that face the same way: a step's few rays at few places make noise, which moves would make shape of and mirrors
        show (Nicolet et al. 2021; docs/sources.md: nicolet2021)."""
        normals = self.state.parameters["normals"]
        if self.settings.gradient_rings and normals.grad is not None:
            normals.grad = averaged(self.surface.around(), normals.grad, self.settings.gradient_rings)

    def end_round(self, done: int) -> None:
        total, rounds = self.settings.iterations, self.settings.rounds
        if done < total and done * rounds // total > (done - 1) * rounds // total:
            self.surface.move(self.settings.moves)
            # Under light that stands still the last pass has said it: asked again, places that see nothing but other metal are called paint
            # (decisions/0003, "Fewer trials, more of stage 2"). Light that turns was found anew before the first step.
            if self.surface.light_turns:
                self.surface.look_for_metal(self.targets, self.settings.moves)

    def step(self, iteration: int) -> StepLoss:
        parameters, settings = self.state.parameters, self.settings
        if iteration == 0 and self.surface.light_turns:
            for _ in range(settings.times_light):
                self.surface.look_for_light(self.targets, settings.moves)
        view = drawn_view(iteration, len(self.targets), settings.seed)
        target = self.targets[view]
        environment = environment_table(parameters)
        surface = packed_surface(parameters)
        terms: dict[str, Tensor] = {}
        traced, squared_error = self._traced(target, self._drawn(self.solid[view]), environment, surface, iteration)
        if squared_error is not None:
            terms["traced"] = traced
        terms |= prior_terms(
            self.surface.edges, environment, surface, parameters["metal"], settings.weight_bend, settings.weight_smooth,
            settings.weight_metal, settings.weight_white_light, settings.weight_rough_light,
        )  # fmt: skip
        return StepLoss(terms, target.camera, squared_error)

    def _drawn(self, solid: Tensor) -> Tensor:
        """Some of the view's pixels, flat, in their order: rays that leave from near each other find what they need in the cache."""
        most = min(self.settings.points_a_step, len(solid))
        return solid[torch.randint(max(1, len(solid)), (most,), generator=self.state.generator).sort().values.to(solid.device)]

    def _traced(
        self, target: ViewTarget, pixels: Tensor, environment: Tensor, surface: Tensor, iteration: int
    ) -> tuple[Tensor, float | None]:
        """The mean error of `pixels` by two estimates of their colours, and the squared one of these estimates' mean; None where no pixel sees the mesh.

        Args:
            surface: of packed_surface.
        """
        with torch.no_grad():
            tracer = self.surface.tracer.swift.with_materials(mesh_from_surface_fit(self.state, self.faces))
            around = Surroundings(
                tracer,
                self.surface.light_of(filter_environment(environment.detach()))(target),
                build_environment_table(Environment(environment.detach())),
            )
        cost = partial(_cost_of_pixels, pixels, target, around, self.settings, iteration)
        total, (squared, count) = cost_in_slices(len(pixels), (environment, surface), cost, self.state.generator)
        return (total / count, float(squared / count)) if count else (total, None)


def _cost_of_pixels(
    pixels: Tensor, target: ViewTarget, around: Surroundings, settings: MeshMaterialSettings, iteration: int, first: int, last: int,
    leaves: tuple[Tensor, ...], generator: torch.Generator,
) -> tuple[Tensor, Tensor]:  # fmt: skip
    """SliceCost of some of the `pixels`: the error, summed; the squared one and the number of channels that were compared.

    Args:
        leaves: the light's radiance and packed_surface.
    """
    environment, surface = leaves
    twice = seen_twice(target, pixels[first:last], around.tracer, generator)
    photo = photo_of(twice, target)
    if not len(photo):
        return environment.sum() * 0, environment.new_zeros(2)
    radiance = _radiance(twice, surface, environment, target, around, settings, iteration)
    shown = display_image(radiance, torch.ones_like(photo[:, 0]), photo, target.ceiling)
    (one, other), photo = shown.chunk(2), photo.chunk(2)[0]
    mean, count = 0.5 * (one + other).detach(), photo.numel()
    squared = (mean.clamp(0, 1) - photo).square().sum()
    return crossed_halves(one, other, photo) * count, torch.stack([squared, squared.new_tensor(count)])


def _radiance(
    seen: SeenPlaces,
    surface: Tensor,
    environment: Tensor,
    target: ViewTarget,
    around: Surroundings,
    settings: MeshMaterialSettings,
    draw: int,
) -> Tensor:
    """(place, 3), each by rays of its own; gradients reach materials, normals and the light.

    Args:
        seen: of seen_twice.
    """
    tracer, turn = around.tracer, target.light_from_world
    here = at_corners(surface, seen.corners, seen.weights)
    points = ShadingPoints(
        position_world=at_corners(tracer.mesh.vertices, seen.corners, seen.weights),
        normal_world=torch.nn.functional.normalize(here[:, :3], dim=-1),
        wo_world=seen.wo,
        albedo=here[:, 3:6].contiguous(),
        roughness=here[:, 6].contiguous(),
        metallic=here[:, 7].contiguous(),
        # By which rays are drawn: a pixel's second place has others than its first.
        pixel=torch.cat([half.pixels + k * target.mask.numel() for k, half in enumerate(seen.halves())]).int(),
    )
    turned = in_light(points, turn)
    with torch.no_grad():
        rays = sample_rays(turned, around.table, settings.samples, settings.seed * 1_000_003 + draw, by_material=True)
        face_normal = tracer.face_normals.index_select(0, seen.face)
        starts = points.position_world + tracer.lift * face_normal
        transmittance, met = light_of_rays(tracer, starts, face_normal, in_world(rays, turn).direction_world, rays.weight, around.light)
    return integrate_samples(turned, rays, transmittance, met, environment)


def in_light(points: ShadingPoints, light_from_world: Tensor | None) -> ShadingPoints:
    """The same points with directions as the light's table has them: shading asks of normal and view nothing but their angles to each other
    and to the light. Positions stay."""
    if light_from_world is None:
        return points
    return replace(points, normal_world=points.normal_world @ light_from_world.T, wo_world=points.wo_world @ light_from_world.T)


def in_world(rays: Rays, light_from_world: Tensor | None) -> Rays:
    """The same rays with directions in the world, of ones that were sampled in_light."""
    return rays if light_from_world is None else replace(rays, direction_world=rays.direction_world @ light_from_world)
