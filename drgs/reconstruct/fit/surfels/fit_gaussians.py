"""Stage 1: surfels, a rough material and the light, from posed photographs.

Each step draws one view: surfels are blended into maps (normal, diffuse albedo, F0, roughness, residual), the maps are shaded by split sum under
a learned HDR environment, all in linear light, and compared with the photo in display space. Reflections therefore pull at normals, so
that mirror-like surfaces get a surface and not a fog of colours. Sources: Huang et al. 2024 (surfels, normal consistency), Yao et al.
2025 (deferred reflection), Kerbl et al. 2023 (densification); docs/sources.md. Faults of the published recipes that are avoided here:
half-pixel shift of reflection rays, raw instead of normalised maps, shading in display space, LDR environment, hard material reset.

In: Views. Out: Gaussians at rest, Environment. Knows nothing of meshes or of the Monte Carlo renderer.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch
from jaxtyping import Float, Float64
from torch import Tensor

from drgs.reconstruct.capture.exposures import with_gains_of_fit
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.fit.densify import DensifySettings, ScreenGradientStats, densify, reset_opacity
from drgs.reconstruct.fit.fit_loop import FitLoop, FitReport, FitState, StepLoss, run_fit
from drgs.reconstruct.fit.light.environment_pyramid import BACKGROUND_ROWS, ENVIRONMENT_PYRAMID, background_image, environment_table
from drgs.reconstruct.fit.light.ground_layer import before_ground, ground_logits
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.losses import (
    display_image,
    edge_aware_smoothness,
    mask_loss,
    rough_light,
    structural_dissimilarity,
    white_light,
)
from drgs.reconstruct.fit.normal_consistency import normal_consistency
from drgs.reconstruct.fit.surfel_parameters import (
    INITIAL_LIGHT,
    LearningRates,
    gaussians_from_parameters,
    initial_parameters,
    make_optimizer,
    residual_sh,
)
from drgs.reconstruct.fit.surfels.render_stage_one import StageOneMaps, render_stage_one
from drgs.reconstruct.fit.surfels.surfel_shadows import shadows_of_surfels
from drgs.reconstruct.fit.view_targets import ViewTarget, drawn_view, view_targets, windowed
from drgs.render.visible.rasterize.near_plane import near_plane
from drgs.scene.camera import Camera
from drgs.scene.gaussians import Gaussians
from drgs.scene.ground import Ground
from drgs.scene.views import Views


@dataclass(frozen=True)
class FitSettings:
    """Stage 1."""

    iterations: int = 2000
    half_size_share: float = 0.4
    """Share of the iterations at half the image size, where a step costs a quarter."""
    most_pixels: int = 160_000
    """Larger photographs are reduced to this many: the surface's fit sees what is finer."""
    rates: LearningRates = field(default_factory=LearningRates)
    densify: DensifySettings = field(default_factory=DensifySettings)
    sh_degree: int = 3
    sh_start: float = 0.5
    """Share of the iterations before the residual may depend on the view (one degree each tenth after)."""
    weight_dissimilarity: float = 0.2
    weight_mask: float = 0.1
    weight_coverage: float = 0.02
    """Without masks: the mean coverage of what is compared costs this much, so that what the background shows as well is not the object's."""
    weight_coverage_on_ground: float = 0.06
    """The same where the ground is known: it explains its shadows, too."""
    weight_normal: float = 0.05
    weight_normal_smooth: float = 0.02
    weight_residual: float = 0.1
    """Radiance that only the residual explains costs this share of the error that it removes."""
    weight_white_light: float = 0.02
    weight_rough_light: float = 0.002
    looks_at_shadows: int = 3
    """Times that the surfels' shape is looked at for the shadows that it casts, where light turns with the camera."""
    seed: int = 0


def start_fit(
    points: InitialPoints, settings: FitSettings, device: torch.device, has_masks: bool = True, ground: Ground | None = None
) -> FitState:
    """Surfels on the initial points under a uniform light; without masks, before a grey background, and above the ground where there is one."""
    parameters = initial_parameters(points, device, settings.seed)
    for rows in ENVIRONMENT_PYRAMID:
        value = math.log(INITIAL_LIGHT) if rows == ENVIRONMENT_PYRAMID[0] else 0.0
        parameters[f"environment_{rows}"] = torch.full((1, 3, rows, 2 * rows), value, device=device, requires_grad=True)
    if not has_masks:
        parameters["background"] = torch.zeros(1, 3, BACKGROUND_ROWS, 2 * BACKGROUND_ROWS, device=device, requires_grad=True)
    if ground is not None:
        parameters["ground"] = ground_logits(ground).to(device).requires_grad_(True)
    return FitState(
        parameters,
        make_optimizer(parameters, settings.rates, points.bounds_radius),
        torch.Generator().manual_seed(settings.seed),
        screen_gradients=ScreenGradientStats.zeros(len(points.points_world), device),
    )


def fit_gaussians(
    views: Views,
    state: FitState,
    settings: FitSettings,
    radius: float,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
    center: Float[Tensor, "3"] | None = None,
) -> FitState:
    """Run (or go on with) stage 1; see run_fit.

    Args:
        radius: of the object's bounding sphere [world units]; scales learning rates and the near plane. center: of that sphere, by which surfels cast
            shadows where the light turns with the camera; None: they cast none.
    """
    steps = _Steps(views, state, settings, radius, center if views.light_from_world is not None else None)
    fit = FitLoop(state, settings.iterations, len(views.cameras), steps.step, steps.rates, steps.gather_gradients, steps.divide)
    return run_fit(fit, report, should_stop)


class _Steps:
    """Final. Stage 1's part of the fit loop."""

    def __init__(self, views: Views, state: FitState, settings: FitSettings, radius: float, center: Tensor | None) -> None:
        self.views, self.state, self.radius = views if state.exposures is None else _exposed(views, state.exposures), state, radius
        on_ground = replace(settings, weight_coverage=settings.weight_coverage_on_ground)
        self.settings = settings if views.ground is None else on_ground
        self.center = center
        """Of the bounding sphere, where surfels cast shadows."""
        self.targets: list[ViewTarget] = []
        self.target_factor = 0.0
        """Size of the targets as a share of the photographs'."""

    def rates(self, iteration: int) -> dict[str, float]:
        rates, progress = self.settings.rates, self._progress(iteration)
        return {
            "centers": self.radius * rates.centers ** (1 - progress) * rates.centers_end**progress,
            "quats": rates.quats ** (1 - progress) * rates.quats_end**progress,
        }

    def step(self, iteration: int) -> StepLoss:
        progress, parameters = self._progress(iteration), self.state.parameters
        target = self._drawn_target(iteration)
        environment = environment_table(parameters)
        tables = filter_environment(environment)
        share = open_share(self.state, tables, target.light_from_world)
        maps = render_stage_one(
            parameters, tables, target.camera, near_plane(self.radius), self._sh_degree(progress), target.light_from_world, share
        )
        image = displayed(maps, target, parameters, self.views.ground)
        terms = stage_one_terms(maps, image, target, environment, self.settings, self.views.has_masks, normal_share(progress))
        return StepLoss(terms, target.whole or target.camera, squared_error(image, target))

    def gather_gradients(self, loss: StepLoss) -> None:
        centers, gradients = self.state.parameters["centers"], self.state.screen_gradients
        assert gradients is not None and centers.grad is not None
        with torch.no_grad():
            gradients.add(centers, centers.grad, loss.camera)

    def divide(self, done: int) -> None:
        plan, state, progress = self.settings.densify, self.state, self._progress(done - 1)
        if done % plan.every == 0 and plan.start <= progress <= plan.stop:
            assert state.screen_gradients is not None
            state.screen_gradients = densify(state.optimizer, state.parameters, state.screen_gradients, plan, self.radius, state.generator)
        if plan.reset_every and done % plan.reset_every == 0 and progress <= plan.stop:
            reset_opacity(state.optimizer, state.parameters)
        if self.center is not None:
            self._look_at_shadows(done)

    def _look_at_shadows(self, done: int) -> None:
        centers, every = self.state.parameters["centers"], max(1, self.settings.iterations // (self.settings.looks_at_shadows + 1))
        assert self.center is not None
        if done % every == 0 and done < self.settings.iterations:
            found = shadows_of_surfels(self.state.parameters, self.views.cameras, self.center, self.radius)
            self.state.shadows = found or self.state.shadows
        if self.state.shadows is not None and len(self.state.shadows.nearest) != len(centers):
            self.state.shadows = self.state.shadows.of_surfels(centers)

    def _progress(self, iteration: int) -> float:
        return iteration / self.settings.iterations

    def _drawn_target(self, iteration: int) -> ViewTarget:
        half_size = iteration < int(self.settings.half_size_share * self.settings.iterations)
        factor = (0.5 if half_size else 1.0) * size_factor(self.views.cameras, self.settings.most_pixels)
        if factor != self.target_factor:
            if iteration and not half_size and self.state.exposures is None:
                self._look_at_exposures()
            self.targets = [windowed(target) for target in view_targets(self.views, factor, self.state.parameters["centers"].device)]
            self.target_factor = factor
        return self.targets[drawn_view(iteration, len(self.targets), self.settings.seed)]

    def _look_at_exposures(self) -> None:
        """Tints, and better gains, for the second half, before radiance may depend on the view and explain them as well."""
        degree = self._sh_degree(self._progress(self.state.iteration))
        found = with_gains_of_fit(self.views, drawn_object(self.state, self.radius, degree), finds_gains=False)
        count = len(found.cameras)
        gains = torch.tensor(found.gains or (1.0,) * count, dtype=torch.float64)
        tints = torch.tensor(found.tints or ((1.0, 1.0, 1.0),) * count, dtype=torch.float64)
        self.state.exposures = torch.cat([gains[:, None], tints], 1)
        self.views = _exposed(self.views, self.state.exposures)

    def _sh_degree(self, progress: float) -> int:
        if progress < self.settings.sh_start:
            return 0
        return min(self.settings.sh_degree, int((progress - self.settings.sh_start) * 10) + 1)


def _exposed(views: Views, exposures: Float64[Tensor, "view 4"]) -> Views:
    """With the gains and tints that a fit found."""
    gains, *tints = (tuple(column) for column in exposures.T.tolist())
    return replace(views, gains=gains, tints=tuple(zip(*tints, strict=True)))


def open_share(
    state: FitState, tables: Float[Tensor, "texel 3"], light_from_world: Float[Tensor, "3 3"] | None
) -> Float[Tensor, "surfel 3"] | None:
    """As render_stage_one takes it; None: surfels cast no shadows (yet)."""
    if state.shadows is None or light_from_world is None:
        return None
    return state.shadows.share(torch.sigmoid(state.parameters["albedo_logits"].detach()), tables, light_from_world)


def drawn_object(
    state: FitState, radius: float, sh_degree: int
) -> Callable[[ViewTarget], tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]]:
    """What a view's camera sees of the surfels: linear radiance where they cover all, and coverage."""
    parameters = state.parameters
    tables = filter_environment(environment_table(parameters)).detach()

    @torch.no_grad()
    def drawn(target: ViewTarget) -> tuple[Float[Tensor, "height width 3"], Float[Tensor, "height width"]]:
        camera, turn = target.camera.to(tables.device), target.light_from_world
        turn = None if turn is None else turn.to(tables.device)
        maps = render_stage_one(parameters, tables, camera, near_plane(radius), sh_degree, turn, open_share(state, tables, turn))
        return maps.radiance_linear, maps.coverage

    return drawn


def size_factor(cameras: tuple[Camera, ...], most_pixels: int) -> float:
    """By which photographs are reduced, so that the largest has so many; 1 where it is small enough."""
    return min(1.0, math.sqrt(most_pixels / max(camera.width * camera.height for camera in cameras)))


def normal_share(progress: float) -> float:
    """Of the normals' full weight: none in the first fiftieth of the fit, all of it after 0.12."""
    return min(1.0, max(0.0, (progress - 0.02) * 10))


def displayed(
    maps: StageOneMaps, target: ViewTarget, parameters: dict[str, Tensor] | None = None, ground: Ground | None = None
) -> Float[Tensor, "height width 3"]:
    """(rows, columns, 3) sRGB within the target's box, on black or before the surroundings among the parameters."""
    box = target.box
    image = display_image(maps.radiance_linear[box], maps.coverage[box], target.saturation[box], target.ceiling)
    if parameters is None or "background" not in parameters:
        return image
    behind = background_image(parameters["background"], target.camera)
    if ground is not None:
        behind = before_ground(parameters["ground"], ground, target.camera, behind)
    # Where the photograph certainly does not show the object it is left out of the comparison, black.
    return image + ((1 - maps.coverage[box]) * target.mask[box])[..., None] * behind[box]


def squared_error(image: Float[Tensor, "height width 3"], target: ViewTarget) -> float:
    """Mean over the whole photograph, display space, of an image within the target's box."""
    with torch.no_grad():
        return float(((image.clamp(0, 1) - target.photo[target.box]) ** 2).sum() * target.share / target.photo.numel())


def stage_one_terms(
    maps: StageOneMaps,
    image: Float[Tensor, "height width 3"],
    target: ViewTarget,
    environment: Float[Tensor, "rows columns 3"],
    settings: FitSettings,
    has_masks: bool,
    normal_weight_share: float = 1.0,
) -> dict[str, Tensor]:
    """Weighted loss terms of one view; `image` is what `displayed` gave."""
    box = target.box
    photo = target.photo[box]
    terms = {"difference": (1 - settings.weight_dissimilarity) * (image - photo).abs().mean()}
    if settings.weight_dissimilarity > 0:
        terms["dissimilarity"] = settings.weight_dissimilarity * structural_dissimilarity(image, photo)
    if has_masks:
        terms["mask"] = settings.weight_mask * target.share * mask_loss(maps.coverage, target.mask)
    elif settings.weight_coverage > 0:
        terms["coverage"] = settings.weight_coverage * maps.coverage.mean()
    if normal_weight_share > 0:
        consistency = normal_consistency(maps.normal_world, maps.depth, maps.coverage, target.camera)
        terms["normal"] = settings.weight_normal * normal_weight_share * consistency
    terms["white_light"] = settings.weight_white_light * white_light(environment)
    terms["rough_light"] = settings.weight_rough_light * rough_light(environment)
    terms["residual"] = settings.weight_residual * maps.residual.abs().sum() / image.numel()
    if settings.weight_normal_smooth > 0:
        terms["normal_smooth"] = settings.weight_normal_smooth * edge_aware_smoothness(maps.normal_world[box], photo, maps.coverage[box])
    return terms


def gaussians_from_state(state: FitState) -> Gaussians:
    """Surfels as an asset holds them, but for `sh`, which is the residual alone (bake_outgoing_radiance makes it the whole)."""
    return gaussians_from_parameters(state.parameters, residual_sh(state.parameters))
