"""Stage 2: albedo, roughness, metallic and the HDR light, by Monte Carlo integration of the full rendering equation.

Each step draws one view, picks some of its pixels, samples rays there from cosine, GGX and environment distributions under the balance
heuristic, traces visibility and indirect light, and compares with the photo:

    L = weight_splat L_c (surfels' own radiance) + L1(PBR, photo) + weight_white_light (incident light is white) + regularisers      (Eq. 6)

Gradients reach materials, environment and, at a small rate, geometry. Source: the paper's stage 2 with the parameters of Gu et al. 2025
and GOGS where it is silent (docs/sources.md: gu2025irgs, gogs2025); exact densities and one definition of F0 throughout.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reconstruct.fit.fit_loop import FitLoop, FitReport, FitState, StepLoss, cosine_rates, run_fit
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.losses import display_image, edge_aware_smoothness, mask_loss, rough_light, white_light
from drgs.reconstruct.fit.normal_consistency import normal_consistency
from drgs.reconstruct.fit.surfel_parameters import (
    gaussians_from_parameters,
    leaves,
    light_parameters,
    make_optimizer,
    parameters_from_gaussians,
)
from drgs.reconstruct.fit.surfels.incident_light import AbstractIncidentLight, build_incident_light
from drgs.reconstruct.fit.surfels.render_stage_two import StageTwoMaps, points_at, render_stage_two
from drgs.reconstruct.fit.view_targets import ViewTarget, drawn_view, view_targets
from drgs.reconstruct.geometry.bake_materials import bake_outgoing_radiance, outward_normals
from drgs.render.integrate.environment_table import build_environment_table
from drgs.render.integrate.integrate_samples import integrate_samples
from drgs.render.integrate.sample_rays import sample_rays
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import Rays, SampleCounts, ShadingPoints
from drgs.render.visible.lift_points import lift_points
from drgs.render.visible.rasterize.near_plane import near_plane
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views


@dataclass(frozen=True)
class MaterialRates:
    """Adam's step per group; centres in units of the object's radius. Geometry moves a little (freezing it costs quality)."""

    centers: float = 1e-5
    log_scales: float = 1e-3
    quats: float = 1e-3
    opacity_logits: float = 5e-3
    sh: float = 0.0025
    albedo_logits: float = 0.03
    roughness_logits: float = 0.03
    metallic_logits: float = 0.03
    environment: float = 0.02


@dataclass(frozen=True)
class MaterialSettings:
    """Stage 2."""

    iterations: int = 300
    points_a_step: int = 1024
    samples: SampleCounts = field(default_factory=lambda: SampleCounts(64, 32, 32))
    """Rays a point: cosine, GGX, environment (the paper: 256, 128, 128)."""
    indirect: str = "mesh"
    """What indirect light is traced against: mesh or surfels."""
    rates: MaterialRates = field(default_factory=MaterialRates)
    weight_splat: float = 0.3
    weight_mask: float = 0.1
    weight_normal: float = 0.05
    weight_white_light: float = 0.02
    weight_rough_light: float = 0.002
    weight_smooth: float = 0.2
    """Of the edge-aware smoothness of albedo, roughness and metallic: materials change where the photo does."""
    weight_metallic_prior: float = 0.01
    """Of m (1 - m) in the second half: most matter is metal or is not."""
    refresh_every: int = 100
    """Iterations between updates of the radiance that rays meet."""
    seed: int = 0


def start_materials(
    gaussians: Gaussians, stage_one: dict[str, Tensor], mesh: TriangleMesh, settings: MaterialSettings, radius: float
) -> FitState:
    """Materials, light and geometry from stage 1; the surfels' own radiance becomes the whole of what stage 1 draws."""
    environment = Environment(environment_table(stage_one).detach())
    normals = outward_normals(gaussians, mesh)
    turned = (rotation_from_quat_wxyz(gaussians.quats_wxyz)[:, :, 2] * normals).sum(-1) < 0
    w, x, y, z = gaussians.quats_wxyz.unbind(-1)
    over = torch.stack([-x, w, z, -y], -1)  # half a turn about t_u: the same disc, its normal outward
    quats = torch.where(turned[:, None], over, gaussians.quats_wxyz)
    radiance_sh = bake_outgoing_radiance(gaussians, gaussians.sh, normals, environment)
    parameters = leaves(parameters_from_gaussians(gaussians) | {"quats": quats, "sh": radiance_sh} | light_parameters(stage_one))
    return FitState(parameters, make_optimizer(parameters, settings.rates, radius), torch.Generator().manual_seed(settings.seed + 1))


def gaussians_from_materials(state: FitState) -> Gaussians:
    """Surfels as an asset holds them."""
    return gaussians_from_parameters(state.parameters, state.parameters["sh"])


def trace_samples(
    points: ShadingPoints, rays: Rays, light: AbstractIncidentLight, tracer: AbstractTracer
) -> tuple[Float[Tensor, "point sample"], Float[Tensor, "point sample 3"]]:
    """(point, sample) transmittance and (point, sample, 3) hit radiance; carries no gradient."""
    starts = lift_points(points, tracer)
    usable = (rays.weight > 0) & ((rays.direction_world * starts.surface_normal_world[:, None]).sum(-1) > 0)
    transmittance, hit_radiance = torch.zeros_like(rays.weight), torch.zeros_like(rays.direction_world)
    origins = starts.origin_world[:, None].expand_as(rays.direction_world)[usable]
    transmittance[usable], hit_radiance[usable] = light.incident(origins, rays.direction_world[usable])
    return transmittance, hit_radiance


def fit_materials(
    views: Views,
    mesh: TriangleMesh,
    state: FitState,
    settings: MaterialSettings,
    radius: float,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> FitState:
    """Run (or go on with) stage 2; see run_fit. Rates fall by a cosine: the estimate is noisy."""
    steps = _Steps(views, mesh, state, settings, radius)

    def rates(iteration: int) -> dict[str, float]:
        return cosine_rates(state.optimizer, iteration, settings.iterations)

    fit = FitLoop(state, settings.iterations, len(views.cameras), steps.step, rates, after_step=steps.refresh_light)
    return run_fit(fit, report, should_stop)


class _Steps:
    """Final. Stage 2's part of the fit loop."""

    def __init__(self, views: Views, mesh: TriangleMesh, state: FitState, settings: MaterialSettings, radius: float) -> None:
        self.views, self.mesh, self.state, self.settings, self.radius = views, mesh, state, settings, radius
        self.targets = view_targets(views, 1.0, mesh.vertices.device)
        self.tracer = build_tracer(mesh)
        self.light = build_incident_light(settings.indirect, mesh, gaussians_from_materials(state))

    def step(self, iteration: int) -> StepLoss:
        target = self.targets[drawn_view(iteration, len(self.targets), self.settings.seed)]
        maps = render_stage_two(self.state.parameters, target.camera, near_plane(self.radius))
        environment = environment_table(self.state.parameters)
        terms: dict[str, Tensor] = {}
        squared_error = None
        pixels = self._drawn_pixels(maps, target)
        if len(pixels):
            points = points_at(maps, target.camera, pixels)
            shown = display_image(
                self._radiance(points, environment, iteration),
                target.mask.flatten()[pixels],
                target.saturation.reshape(-1, 3)[pixels],
                target.ceiling,
            )
            photo = target.photo.reshape(-1, 3)[pixels]
            terms["traced"] = (shown - photo).abs().mean()
            squared_error = float(((shown.detach().clamp(0, 1) - photo) ** 2).mean())
        terms |= self._map_terms(maps, target, environment, iteration)
        return StepLoss(terms, target.camera, squared_error)

    def refresh_light(self, done: int) -> None:
        """Surfels have other colours by now: so has what rays meet."""
        if done % self.settings.refresh_every == 0 and done < self.settings.iterations:
            self.light = build_incident_light(self.settings.indirect, self.mesh, gaussians_from_materials(self.state))

    def _drawn_pixels(self, maps: StageTwoMaps, target: ViewTarget) -> Int[Tensor, "pixel"]:
        """(pixel,) flat indices of pixels that surfels and mask fill; none where none are."""
        solid = ((maps.coverage.detach() > 0.5) & (target.mask > 0.5)).flatten().nonzero().squeeze(1)
        if len(solid) == 0:
            return solid
        chosen = torch.randint(len(solid), (min(self.settings.points_a_step, len(solid)),), generator=self.state.generator)
        return solid[chosen.to(solid.device)]

    def _radiance(self, points: ShadingPoints, environment: Float[Tensor, "rows columns 3"], iteration: int) -> Float[Tensor, "point 3"]:
        """(point, 3) linear radiance towards the camera; gradients reach materials, normals and the light."""
        with torch.no_grad():
            table = build_environment_table(Environment(environment.detach()))
            rays = sample_rays(points, table, self.settings.samples, self.settings.seed * 1_000_003 + iteration)
            transmittance, hit_radiance = trace_samples(points, rays, self.light, self.tracer)
        return integrate_samples(points, rays, transmittance, hit_radiance, environment)

    def _map_terms(
        self, maps: StageTwoMaps, target: ViewTarget, environment: Float[Tensor, "rows columns 3"], iteration: int
    ) -> dict[str, Tensor]:
        """Weighted loss terms that look at the whole view."""
        settings, box = self.settings, target.box
        photo = target.photo[box]
        splat = display_image(maps.splat_radiance[box], maps.coverage[box], target.saturation[box], target.ceiling)
        terms = {"splat": settings.weight_splat * (splat - photo).abs().mean()}
        if self.views.has_masks:
            terms["mask"] = settings.weight_mask * mask_loss(maps.coverage, target.mask)
        terms["normal"] = settings.weight_normal * normal_consistency(maps.normal_world, maps.depth, maps.coverage, target.camera)
        terms["white_light"] = settings.weight_white_light * white_light(environment)
        terms["rough_light"] = settings.weight_rough_light * rough_light(environment)
        smooth = torch.cat([maps.albedo[box], maps.roughness[box][..., None], maps.metallic[box][..., None]], -1)
        terms["smooth"] = settings.weight_smooth * edge_aware_smoothness(smooth, photo, maps.coverage[box])
        if 2 * iteration > settings.iterations:
            metallic = torch.sigmoid(self.state.parameters["metallic_logits"])
            terms["metallic_prior"] = settings.weight_metallic_prior * (metallic * (1 - metallic)).mean()
        return terms
