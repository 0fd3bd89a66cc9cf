"""Stage 2: albedo, roughness, metallic and the HDR light, by Monte Carlo integration of the full rendering equation.

Each step draws one view, picks some of its pixels, samples rays there from cosine, GGX and environment distributions under the balance
heuristic, traces visibility and indirect light, and compares with the photo:

    L = weight_splat L_c (surfels' own radiance) + L1(PBR, photo) + weight_white_light (incident light is white) + regularisers      (Eq. 6)

Gradients reach materials, environment and, at a small rate, geometry. Source: the paper's stage 2 with the parameters of Gu et al. 2025
and GOGS where it is silent (docs/sources.md: gu2025irgs, gogs2025); exact densities and one definition of F0 throughout.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from drgs.build.bake_materials import bake_outgoing_radiance, outward_normals
from drgs.build.fit_gaussians import FitReport, drawn_view, environment_table, pick_box, view_targets
from drgs.build.incident_light import AbstractIncidentLight, build_incident_light
from drgs.build.losses import display_image, edge_aware_smoothness, mask_loss, normal_consistency, rough_light, white_light
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.maths.spherical_harmonics import evaluate_sh
from drgs.render.environment_table import build_environment_table
from drgs.render.integrate_samples import integrate_samples
from drgs.render.lift_points import lift_points
from drgs.render.rasterize_gbuffer import RasterSettings, face_camera, facing_normals, rasterize
from drgs.render.records import Rays, ShadingPoints
from drgs.render.sample_rays import SampleCounts, sample_rays
from drgs.render.trace_rays import build_tracer
from drgs.scene.camera import Camera, pixel_rays_world
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


@dataclass(eq=False)
class MaterialState:
    """Everything a checkpoint must hold."""

    parameters: dict[str, Tensor]
    optimizer: torch.optim.Adam
    iteration: int
    generator: torch.Generator


def _logit(x: Tensor) -> Tensor:
    return torch.logit(x.clamp(0.005, 0.995))


def start_materials(
    gaussians: Gaussians, stage_one: dict[str, Tensor], mesh: TriangleMesh, settings: MaterialSettings, radius: float
) -> MaterialState:
    """Materials, light and geometry from stage 1; the surfels' own radiance becomes the whole of what stage 1 draws."""
    environment = Environment(environment_table(stage_one).detach())
    normals = outward_normals(gaussians, mesh)
    turned = (rotation_from_quat_wxyz(gaussians.quats_wxyz)[:, :, 2] * normals).sum(-1) < 0
    w, x, y, z = gaussians.quats_wxyz.unbind(-1)
    over = torch.stack([-x, w, z, -y], -1)  # half a turn about t_u: the same disc, its normal outward
    quats = torch.where(turned[:, None], over, gaussians.quats_wxyz)
    radiance_sh = bake_outgoing_radiance(gaussians, gaussians.sh, normals, environment)
    parameters = {
        "centers": gaussians.centers,
        "log_scales": gaussians.log_scales,
        "quats": quats,
        "opacity_logits": gaussians.opacity_logits,
        "sh": radiance_sh,
        "albedo_logits": _logit(gaussians.albedo),
        "roughness_logits": _logit(gaussians.roughness),
        "metallic_logits": _logit(gaussians.metallic),
    } | {name: value for name, value in stage_one.items() if name.startswith("environment_")}
    # Row-major like a checkpoint's: sums round by memory layout, and a resumed fit must end with the same bits.
    copies = {name: value.detach().clone(memory_format=torch.contiguous_format) for name, value in parameters.items()}
    parameters = {name: value.requires_grad_(True) for name, value in copies.items()}
    groups = []
    for name, value in parameters.items():
        rate = getattr(settings.rates, "environment" if name.startswith("environment") else name) * (radius if name == "centers" else 1.0)
        groups.append({"params": [value], "lr": rate, "name": name, "full_rate": rate})
    optimizer = torch.optim.Adam(groups, eps=1e-15, fused=True)
    return MaterialState(parameters, optimizer, 0, torch.Generator().manual_seed(settings.seed + 1))


def gaussians_from_materials(state: MaterialState) -> Gaussians:
    """Surfels as an asset holds them."""
    p = {name: value.detach() for name, value in state.parameters.items()}
    return Gaussians(
        p["centers"], p["log_scales"], torch.nn.functional.normalize(p["quats"], dim=-1), p["opacity_logits"], p["sh"],
        torch.sigmoid(p["albedo_logits"]), torch.sigmoid(p["roughness_logits"]), torch.sigmoid(p["metallic_logits"]),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class StageTwoMaps:
    """A view's maps, divided by coverage."""

    splat_radiance: Tensor
    coverage: Tensor
    depth: Tensor
    normal_world: Tensor
    albedo: Tensor
    roughness: Tensor
    metallic: Tensor


def render_stage_two(parameters: dict[str, Tensor], camera: Camera, near: float) -> StageTwoMaps:
    """Blend and normalise; differentiable."""
    rotation = rotation_from_quat_wxyz(parameters["quats"])
    centers = parameters["centers"]
    with torch.no_grad():
        to_surfel = torch.nn.functional.normalize(centers - camera.center_world, dim=-1)
    radiance = (evaluate_sh(parameters["sh"], to_surfel) + 0.5).clamp(min=0)
    features = torch.cat(
        [
            facing_normals(rotation[:, :, 2], centers, camera),
            torch.sigmoid(parameters["albedo_logits"]),
            torch.sigmoid(parameters["roughness_logits"])[:, None],
            torch.sigmoid(parameters["metallic_logits"])[:, None],
            radiance,
        ],
        1,
    )
    tangents = rotation[:, :, :2] * parameters["log_scales"].exp()[:, None, :]
    maps = rasterize(centers, tangents, torch.sigmoid(parameters["opacity_logits"]), features, camera, RasterSettings(near=near))
    inverse = 1 / maps.coverage.clamp(min=0.02)
    normalised = (maps.features * inverse).permute(1, 2, 0)
    return StageTwoMaps(
        splat_radiance=normalised[..., 8:11],
        coverage=maps.coverage,
        depth=maps.depth_sum * inverse + maps.depth_origin,
        normal_world=face_camera(normalised[..., :3], -pixel_rays_world(camera)[1]),
        albedo=normalised[..., 3:6],
        roughness=normalised[..., 6],
        metallic=normalised[..., 7],
    )


def points_at(maps: StageTwoMaps, camera: Camera, pixels: Tensor) -> ShadingPoints:
    """Shading points of the pixels (flat indices); gradients reach normal and materials."""
    origin, directions = pixel_rays_world(camera)
    direction = directions.reshape(-1, 3)[pixels]
    distance = maps.depth.reshape(-1)[pixels] / (direction @ camera.camera_from_world[2, :3])
    return ShadingPoints(
        position_world=(origin + direction * distance[:, None]).detach(),
        normal_world=maps.normal_world.reshape(-1, 3)[pixels],
        wo_world=-direction,
        albedo=maps.albedo.reshape(-1, 3)[pixels],
        roughness=maps.roughness.reshape(-1)[pixels],
        metallic=maps.metallic.reshape(-1)[pixels],
        pixel=pixels.int(),
    )


def trace_samples(points: ShadingPoints, rays: Rays, light: AbstractIncidentLight, tracer) -> tuple[Tensor, Tensor]:
    """(point, sample) openness and (point, sample, 3) radiance met; carries no gradient."""
    starts = lift_points(points, tracer)
    usable = (rays.weight > 0) & ((rays.direction_world * starts.surface_normal_world[:, None]).sum(-1) > 0)
    openness, met = torch.zeros_like(rays.weight), torch.zeros_like(rays.direction_world)
    origins = starts.origin_world[:, None].expand_as(rays.direction_world)[usable]
    openness[usable], met[usable] = light.incident(origins, rays.direction_world[usable])
    return openness, met


def fit_materials(
    views: Views,
    mesh: TriangleMesh,
    state: MaterialState,
    settings: MaterialSettings,
    radius: float,
    report: Callable[[FitReport, MaterialState], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> MaterialState:
    """Run (or go on with) stage 2 until settings.iterations, or until should_stop() says so."""
    parameters, optimizer = state.parameters, state.optimizer
    device = parameters["centers"].device
    targets = view_targets(views, 1.0, device)
    tracer = build_tracer(mesh)
    light = build_incident_light(settings.indirect, mesh, gaussians_from_materials(state))
    recent: list[float] = []
    started = time.monotonic()
    while state.iteration < settings.iterations:
        if should_stop is not None and should_stop():
            break
        if state.iteration and state.iteration % settings.refresh_every == 0:
            light = build_incident_light(settings.indirect, mesh, gaussians_from_materials(state))
        for group in optimizer.param_groups:  # cosine fall to a tenth: the estimate is noisy
            group["lr"] = group["full_rate"] * (0.55 + 0.45 * math.cos(math.pi * state.iteration / settings.iterations))
        target = targets[drawn_view(state.iteration, len(targets), settings.seed)]
        maps = render_stage_two(parameters, target.camera, 0.01 * radius)
        environment = environment_table(parameters)

        solid = ((maps.coverage.detach() > 0.5) & (target.mask > 0.5)).flatten().nonzero().squeeze(1)
        loss = maps.coverage.new_zeros(())
        if len(solid):
            chosen = torch.randint(len(solid), (min(settings.points_a_step, len(solid)),), generator=state.generator).to(device)
            pixels = solid[chosen]
            points = points_at(maps, target.camera, pixels)
            with torch.no_grad():
                table = build_environment_table(Environment(environment.detach()))
                rays = sample_rays(points, table, settings.samples, settings.seed * 1_000_003 + state.iteration)
                openness, met = trace_samples(points, rays, light, tracer)
            radiance = integrate_samples(points, rays, openness, met, environment)
            alpha, photo = target.mask.flatten()[pixels], target.photo.reshape(-1, 3)[pixels]
            shown = display_image(radiance, alpha, target.saturation.reshape(-1, 3)[pixels])
            loss = (shown - photo).abs().mean()
            recent.append(float(((shown.detach().clamp(0, 1) - photo) ** 2).mean()))

        box = pick_box(target)
        photo = target.photo[box]
        splat = display_image(maps.splat_radiance[box], maps.coverage[box], target.saturation[box])
        loss = loss + settings.weight_splat * (splat - photo).abs().mean()
        if views.has_masks:
            loss = loss + settings.weight_mask * mask_loss(maps.coverage, target.mask)
        loss = loss + settings.weight_normal * normal_consistency(maps.normal_world, maps.depth, maps.coverage, target.camera)
        loss = loss + settings.weight_white_light * white_light(environment) + settings.weight_rough_light * rough_light(environment)
        smooth = torch.cat([maps.albedo[box], maps.roughness[box][..., None], maps.metallic[box][..., None]], -1)
        loss = loss + settings.weight_smooth * edge_aware_smoothness(smooth, photo, maps.coverage[box])
        if 2 * state.iteration > settings.iterations:
            metallic = torch.sigmoid(parameters["metallic_logits"])
            loss = loss + settings.weight_metallic_prior * (metallic * (1 - metallic)).mean()
        loss.backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        state.iteration += 1
        if report is not None and recent:
            recent = recent[-len(targets) :]
            psnr = -10 * math.log10(max(sum(recent) / len(recent), 1e-12))
            report(FitReport(state.iteration, settings.iterations, psnr, len(parameters["centers"]), time.monotonic() - started), state)
    return state
