"""The mesh becomes the surface that the photographs show: shading normals, materials and light by deferred shading, positions from them.

In rounds. First the mesh moves (integrate_normals): its outlines onto the masks', its faces across the normals found so far. Then visibility and
inter-reflection are traced anew, and for the rest of the round each step looks at some pixels of a few photographs: rays find the mesh behind them,
split sum with one mirrored ray shades them, and normals, albedo, roughness and metallic of the vertices and the environment follow the
gradient. Normals are free while they are fitted, so that each vertex answers to its own pixels; the solve makes them a surface again.

Why: surfels place a mesh by where they lie, which is where depth is worst known and outlines are blurred; shading knows normals well and masks
know outlines to a tenth of a pixel (docs/decisions/0003-fitting.md). Sources: Nehab et al. 2005 (positions from normals), Godard et al.
2015 (mirrors from few photographs), Karis 2013 (split sum); docs/sources.md: nehab2005, godard2015, karis2013.

In: Views with masks, a mesh, surfels for the normals to start from, the light of stage 1. Out: FitState; `mesh_from_surface_fit` and its light.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from drgs.reconstruct.fit.cost_in_slices import cost_in_slices
from drgs.reconstruct.fit.fit_loop import FitLoop, FitReport, FitState, StepLoss, run_fit
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.light.mesh_light import LightOf
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.light.turned_light import COARSE, FINE
from drgs.reconstruct.fit.losses import crossed_halves
from drgs.reconstruct.fit.surface.displaced_surface import DisplacedSurface, weights_where_seen
from drgs.reconstruct.fit.surface.moving_surface import MoveSettings, MovingSurface, mesh_from_surface_fit
from drgs.reconstruct.fit.surface.prior_terms import prior_terms
from drgs.reconstruct.fit.surface.shade_surface import SOLID, packed_surface, seen_twice, shade_photographs
from drgs.reconstruct.fit.surfel_parameters import leaves, light_parameters, logits_of_shares, make_optimizer, rate_of_group
from drgs.reconstruct.fit.view_targets import ViewTarget, drawn_view, whole_targets
from drgs.reconstruct.geometry.bake_materials import average_surfels, outward_normals, vertex_weights
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views

NOT_FITTED = ("vertices", "homeward", "to_texture", "texture_weight", "open_share", "metal")
"""Parameters that no gradient moves."""


@dataclass(frozen=True)
class SurfaceRates:
    """Adam's step per group."""

    normals: float = 0.02
    albedo_logits: float = 0.03
    roughness_logits: float = 0.03
    metallic_logits: float = 0.03
    environment: float = 0.02
    vertices: float = 0.0
    """Moved by the solve alone."""
    offsets: float = 0.0
    """[mean edges] Of a DisplacedSurface."""
    homeward: float = 0.0
    """From each vertex to where the surface began, or was moved by a trial."""
    to_texture: float = 0.0
    """From each vertex to where the photographs show its pattern, and how much that is believed."""
    texture_weight: float = 0.0
    open_share: float = 0.0
    """Traced, not fitted."""
    metal: float = 0.0
    """Decided, not fitted."""


@dataclass(frozen=True)
class SurfaceSettings:
    """The surface's fit."""

    rounds: int = 6
    """0: the mesh stays as it was extracted."""
    steps_a_round: int = 100
    rates: SurfaceRates = field(default_factory=SurfaceRates)
    normals_end: float = 0.002
    """What the normals' rate has fallen to after all passes: they have far to go at first, and then each step is one photograph's noise."""
    fall_from: float = 0.5
    """Share of the steps after which rates fall, by a cosine to a twentieth; 1: they do not."""
    moves: MoveSettings = field(default_factory=MoveSettings)
    looks_for_light: bool = False
    """Under which paint is alike on all sides: before the first step (light_from_paint); half-way where it turns with the camera (light_from_turns)."""
    still: bool = False
    """The surface stays where it is, and so do its metal and the light that arrives at it."""
    to_surface_end: float = 0.1
    """Of all passes: the share by which normals return to the surface's own after the last one (MoveSettings.to_surface after the others). Relief
    that is finer than faces is in the normals alone."""
    light_at_end: bool = True
    """After the last move the light that arrives is traced again. A pass that another one follows need not: that begins with a move of its own."""
    weight_bend: float = 0.05
    weight_bend_end: float = 0.0015
    """Of the mean difference of normals along edges, at the start and at the end."""
    weight_smooth: float = 1.0
    weight_smooth_end: float = 0.02
    """Of the mean difference of materials along edges, at the start and at the end: what shading explains is not to become paint first."""
    weight_metal: float = 0.3
    """Of the mean distance of metallic from what the evidence says, times its strength (metal_evidence)."""
    metal_from: float = 0.2
    """Share of the rounds after which evidence is looked at: normals must be right before mirrors can be."""
    weight_white_light: float = 0.002
    """Ten times as much holds each direction's light to grey, whatever the photographs say, and a lamp's colour is missing where metal mirrors it."""
    weight_rough_light: float = 0.002
    pixels_a_step: int = 65_536
    """At most, of all photographs that a step looks at; drawn anew in each step."""
    photographs_a_step: int = 4
    """Of which each gives one in so many of its pixels. What one photograph gets wrong (its light, its shadows) it gets wrong over whole surfaces, and
    turns their normals together; what pixels of several get wrong evens out (decisions/0003, "Several photographs a step")."""
    displaces: bool = False
    """Positions follow what pixels show, and normals them (displaced_surface); outlines and the normals' integral wait for the next move."""
    settle_every: int = 20
    """Steps after which rays are traced against the surface as it was displaced."""
    seed: int = 0

    @property
    def iterations(self) -> int:
        return self.rounds * self.steps_a_round


def start_surface(
    gaussians: Gaussians, mesh: TriangleMesh, stage_one: dict[str, Tensor], settings: SurfaceSettings, radius: float
) -> FitState:
    """Normals and materials of the surfels around each vertex, the light of stage 1."""
    weights = vertex_weights(mesh.vertices, mesh.normals, gaussians)
    normals = torch.nn.functional.normalize(average_surfels(outward_normals(gaussians, mesh), *weights), dim=-1)
    parameters = {
        "normals": normals,
        "albedo_logits": logits_of_shares(average_surfels(gaussians.albedo, *weights)),
        "roughness_logits": logits_of_shares(average_surfels(gaussians.roughness, *weights)),
        "metallic_logits": logits_of_shares(average_surfels(gaussians.metallic, *weights)),
        "vertices": mesh.vertices,
        "homeward": torch.zeros_like(mesh.vertices),
        "to_texture": torch.zeros_like(mesh.vertices),
        "texture_weight": torch.zeros_like(mesh.roughness),
        "open_share": torch.ones_like(mesh.vertices),
        "metal": torch.zeros_like(mesh.roughness),
        "offsets": torch.zeros_like(mesh.roughness),
    } | light_parameters(stage_one)
    values = leaves(parameters, frozen=NOT_FITTED)
    return FitState(values, make_optimizer(values, settings.rates, radius), torch.Generator().manual_seed(settings.seed + 2))


def fit_surface(
    views: Views,
    mesh: TriangleMesh,
    state: FitState,
    settings: SurfaceSettings,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    same_place: MovingSurface | None = None,
) -> FitState:
    """Run (or go on with) the surface's fit; see run_fit.

    Args:
        mesh: whose faces the state's vertices have. same_place: of MovingSurface.
    """
    steps = _Steps(views, mesh.faces, state, settings, same_place)

    def rates(iteration: int) -> dict[str, float]:
        late = max(0.0, (iteration / settings.iterations - settings.fall_from) / max(1 - settings.fall_from, 1e-9))
        share = 0.525 + 0.475 * math.cos(math.pi * late)
        # Of these settings, not of those that the optimizer was made with: each pass has its own.
        return {group["name"]: rate_of_group(group["name"], settings.rates) * share for group in state.optimizer.param_groups}

    fit = FitLoop(state, settings.iterations, len(views.cameras), steps.step, rates, steps.damp_steps, steps.end_round)
    return run_fit(fit, report, should_stop)


class _Steps:
    """Final. The surface's part of the fit loop."""

    def __init__(
        self, views: Views, faces: Tensor, state: FitState, settings: SurfaceSettings, same_place: MovingSurface | None = None
    ) -> None:
        self.state, self.settings, self.faces = state, settings, faces
        self.targets = whole_targets(views, faces.device)
        # A surface that stays has divided faces, whose many vertices would take seconds to trace finely, or is only compared.
        self.surface = MovingSurface(views, faces, state, same_place, COARSE if settings.still else FINE)
        self.displaced = DisplacedSurface(self.surface, state, settings.moves) if settings.displaces else None
        # What photographs say of light that turns (light_from_turns) they say by normals, which a move has returned to the surface's own.
        self._light_at = settings.iterations // 2 if self.surface.light_turns else 0

    def damp_steps(self, _: StepLoss) -> None:
        """Between gradients and the step by them."""
        if self.displaced is not None:
            self.displaced.damp_steps(self.state.optimizer)

    def end_round(self, done: int) -> None:
        if self.displaced is not None:
            if done % self.settings.settle_every == 0 or done == self.settings.iterations:
                self.displaced.settle()
            if done == self.settings.iterations:
                self.surface.relight(self.settings.moves.share_rays)
            return
        if not self.settings.still and done % self.settings.steps_a_round == 0:
            self.move_surface(self.settings.light_at_end or done < self.settings.iterations)

    def move_surface(self, relight: bool = True) -> None:
        """Where normals and outlines say, and what is metal there."""
        self.surface.move(self.settings.moves, relight)
        if self.state.iteration > self.settings.metal_from * self.settings.iterations:
            self.surface.look_for_metal(self.targets, self.settings.moves)

    def step(self, iteration: int) -> StepLoss:
        if iteration == 0 and not self.settings.still and not self.settings.displaces:
            self.surface.look_for_texture(self.settings.moves)
            self.move_surface()
        if self.settings.looks_for_light and not self.settings.still and iteration == self._light_at:
            self.surface.look_for_light(self.targets, self.settings.moves)
        several = self.settings.photographs_a_step
        drawn = (drawn_view(iteration * several + k, len(self.targets), self.settings.seed) for k in range(several))
        targets = [self.targets[number] for number in drawn]
        parameters = self.state.parameters
        environment = environment_table(parameters)
        positions, shown = None, parameters
        if self.displaced is not None:
            positions = self.displaced.positions()
            shown = parameters | {"normals": self.displaced.normals(positions)}
        surface = packed_surface(shown)
        terms: dict[str, Tensor] = {}
        shaded, squared_error = self._shaded(targets, environment, surface, positions)
        if squared_error is not None:
            terms["shaded"] = shaded
        settings, progress = self.settings, iteration / self.settings.iterations
        bend = settings.weight_bend ** (1 - progress) * settings.weight_bend_end**progress
        smooth = settings.weight_smooth ** (1 - progress) * settings.weight_smooth_end**progress
        terms |= prior_terms(
            self.surface.edges, environment, surface, parameters["metal"], bend, smooth, settings.weight_metal,
            settings.weight_white_light, settings.weight_rough_light,
        )  # fmt: skip
        return StepLoss(terms, targets[0].camera, squared_error)

    def _shaded(
        self, targets: list[ViewTarget], environment: Tensor, surface: Tensor, positions: Tensor | None
    ) -> tuple[Tensor, float | None]:
        """The mean error of pixels that masks and mesh fill, in display space, by two estimates of their colours, and the squared one of the
        first; None where there is no such pixel.

        Args:
            surface: of packed_surface. positions: of the displaced surface; None: it lies where the tracer's does.
        """
        # Of six million rays at a bunny's vertices 85 slipped through an edge: nothing beside a step's noise.
        tracer = self.surface.tracer.swift.with_materials(mesh_from_surface_fit(self.state, self.faces))
        tables = filter_environment(environment)
        _ = self.surface.sky  # traced once, before threads ask for it
        chosen = [self._some_pixels(target, len(targets)) for target in targets]

        def cost(first: int, last: int, leaves: tuple[Tensor, ...], generator: torch.Generator) -> tuple[Tensor, Tensor]:
            if first == last:  # fewer photographs than threads
                return leaves[0].sum() * 0, torch.zeros(2, device=surface.device)
            # Light that turns is found here, by the thread that needs it.
            light_of = self.surface.light_of(leaves[0], leaves[1][:, :3].contiguous())
            return _cost_of_pixels(chosen[first:last], targets[first:last], tracer, light_of, leaves[1:], generator)

        leaves = (tables, surface) if positions is None else (tables, surface, positions)
        total, (squared, count) = cost_in_slices(len(targets), leaves, cost, self.state.generator)
        return (total / count, float(squared / count)) if count else (total, None)

    def _some_pixels(self, target: ViewTarget, several: int) -> Tensor:
        """One in `several` of a photograph's solid pixels (flat), or fewer, one out of each so many that follow each other."""
        solid = (target.mask.flatten() > SOLID).nonzero().squeeze(1)
        wanted = -(-min(len(solid), self.settings.pixels_a_step) // several)
        if wanted == len(solid):
            return solid
        edges = torch.arange(wanted + 1) * len(solid) // wanted
        inside = torch.rand(wanted, dtype=torch.float64, generator=self.state.generator) * (edges[1:] - edges[:-1])
        return solid[(edges[:-1] + inside.long()).to(solid.device)]


def _cost_of_pixels(
    chosen: list[Tensor],
    targets: list[ViewTarget],
    tracer: AbstractTracer,
    light_of: LightOf,
    leaves: tuple[Tensor, ...],
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """Of the `chosen` pixels (flat) of each photograph the error, summed; the squared one and the number of channels that were compared.

    Args:
        leaves: packed_surface and, of a displaced surface, positions.
    """
    surface, *positions = leaves
    normals = surface.detach()[:, :3].contiguous()
    compared = [seen_twice(target, pixels, tracer, generator, normals) for pixels, target in zip(chosen, targets, strict=True)]
    if positions:
        compared = [replace(seen, weights=weights_where_seen(seen, tracer.mesh.vertices, positions[0])) for seen in compared]
    first, second, photo = shade_photographs(compared, targets, tracer, surface, light_of, generator)
    count = photo.numel()
    error = crossed_halves(first, second, photo) * count if count else surface.sum() * 0
    return error, torch.stack([(first.detach().clamp(0, 1) - photo).square().sum(), surface.new_tensor(count)])
