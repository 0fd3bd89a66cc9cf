"""Stage 1: surfels, a rough material and the light, from posed photographs.

Each step draws one view: surfels are blended into maps (normal, diffuse albedo, F0, roughness, residual), the maps are shaded by split sum under
a learned HDR environment, all in linear light, and compared with the photo in display space. Reflections therefore pull at normals, so
that mirror-like surfaces get a surface and not a fog of colours. Sources: Huang et al. 2024 (surfels, normal consistency), Yao et al.
2025 (deferred reflection), Kerbl et al. 2023 (densification); docs/sources.md. Faults of the published recipes that are avoided here:
half-pixel shift of reflection rays, raw instead of normalised maps, shading in display space, LDR environment, hard material reset.

In: Views. Out: Gaussians at rest, Environment. Knows nothing of meshes or of the Monte Carlo renderer.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor

from drgs.build.densify import DensifySettings, Pull, densify, reset_opacity
from drgs.build.initial_points import InitialPoints
from drgs.build.losses import (
    display_image,
    edge_aware_smoothness,
    mask_loss,
    normal_consistency,
    rough_light,
    structural_dissimilarity,
    white_light,
)
from drgs.build.split_sum import filter_environment, shade_split_sum
from drgs.build.surfel_parameters import INITIAL_LIGHT, LearningRates, initial_parameters, make_optimizer
from drgs.maths.brdf import f0_from_base
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.maths.spherical_harmonics import evaluate_sh
from drgs.render.rasterize_gbuffer import RasterSettings, face_camera, facing_normals, rasterize
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.environment import Environment, uv_from_direction
from drgs.scene.gaussians import Gaussians
from drgs.scene.views import Views

BACKGROUND_ROWS = 64
"""Of the picture of the surroundings that captures without masks are given, by direction alone."""
ENVIRONMENT_PYRAMID = (8, 32, 128)
"""Rows of the tables whose upsampled sum is the log of the environment: coarse light settles first."""


@dataclass(frozen=True)
class FitSettings:
    """Stage 1."""

    iterations: int = 2000
    half_size_share: float = 0.4
    """Share of the iterations at half the image size, where a step costs a quarter."""
    rates: LearningRates = field(default_factory=LearningRates)
    densify: DensifySettings = field(default_factory=DensifySettings)
    sh_degree: int = 3
    sh_start: float = 0.5
    """Share of the iterations before the residual may depend on the view (one degree each tenth after)."""
    weight_dissimilarity: float = 0.2
    weight_mask: float = 0.1
    weight_coverage: float = 0.02
    """Without masks: the mean coverage costs this much, so that what the background shows as well is not the object's."""
    weight_normal: float = 0.05
    weight_normal_smooth: float = 0.02
    weight_residual: float = 0.1
    """Radiance that only the residual explains costs this share of the error that it removes."""
    weight_white_light: float = 0.02
    weight_rough_light: float = 0.002
    seed: int = 0


@dataclass(frozen=True)
class FitReport:
    """One line of progress."""

    iteration: int
    iterations: int
    psnr: float
    """Running mean over the last views, display space, on black."""
    surfels: int
    seconds: float


@dataclass(eq=False)
class FitState:
    """Everything a checkpoint must hold to go on with the same numbers."""

    parameters: dict[str, Tensor]
    optimizer: torch.optim.Adam
    pull: Pull
    iteration: int
    generator: torch.Generator


def start_fit(points: InitialPoints, settings: FitSettings, device: torch.device, has_masks: bool = True) -> FitState:
    """Surfels on the initial points under a uniform light; without masks, before a grey background."""
    parameters = initial_parameters(points, device, settings.seed)
    for rows in ENVIRONMENT_PYRAMID:
        value = math.log(INITIAL_LIGHT) if rows == ENVIRONMENT_PYRAMID[0] else 0.0
        parameters[f"environment_{rows}"] = torch.full((1, 3, rows, 2 * rows), value, device=device, requires_grad=True)
    if not has_masks:
        parameters["background"] = torch.zeros(1, 3, BACKGROUND_ROWS, 2 * BACKGROUND_ROWS, device=device, requires_grad=True)
    optimizer = make_optimizer(parameters, settings.rates, points.bounds_radius)
    generator = torch.Generator().manual_seed(settings.seed)
    return FitState(parameters, optimizer, Pull.zeros(len(points.points_world), device), 0, generator)


def environment_table(parameters: dict[str, Tensor]) -> Tensor:
    """(128, 256, 3) linear radiance; exp keeps it positive and lets a lamp be a thousand times the sky."""
    log_radiance = parameters[f"environment_{ENVIRONMENT_PYRAMID[-1]}"]
    for rows in ENVIRONMENT_PYRAMID[:-1]:
        coarse = parameters[f"environment_{rows}"]
        wrapped = torch.cat([coarse[..., -1:], coarse, coarse[..., :1]], -1)
        scale = ENVIRONMENT_PYRAMID[-1] // rows
        fine = torch.nn.functional.interpolate(wrapped, scale_factor=scale, mode="bilinear", align_corners=False)
        log_radiance = log_radiance + fine[..., scale:-scale]
    return log_radiance[0].permute(1, 2, 0).clamp(-8, 8).exp()


@dataclass(frozen=True, eq=False)
class StageOneMaps:
    """What one view looks like to stage 1."""

    radiance_linear: Tensor
    """(height, width, 3); 0 where nothing is covered."""
    coverage: Tensor
    normal_world: Tensor
    depth: Tensor
    roughness: Tensor
    residual: Tensor
    """(covered pixel, 3) radiance that the material and the unshadowed light do not explain."""


def render_stage_one(parameters: dict[str, Tensor], tables: Tensor, camera: Camera, near: float, sh_degree: int) -> StageOneMaps:
    """Blend, normalise by coverage, shade once a pixel; differentiable."""
    rotation = rotation_from_quat_wxyz(parameters["quats"])
    tangents = rotation[:, :, :2] * parameters["log_scales"].exp()[:, None, :]
    centers = parameters["centers"]
    with torch.no_grad():
        to_surfel = torch.nn.functional.normalize(centers - camera.center_world, dim=-1)
    metallic = torch.sigmoid(parameters["metallic_logits"])
    sh = parameters["sh_dc"] if sh_degree == 0 else torch.cat([parameters["sh_dc"], parameters["sh_rest"]], 1)
    albedo = torch.sigmoid(parameters["albedo_logits"])
    surface = [albedo * (1 - metallic)[:, None], f0_from_base(albedo, metallic), torch.sigmoid(parameters["roughness_logits"])[:, None]]
    features = torch.cat([facing_normals(rotation[:, :, 2], centers, camera), *surface, evaluate_sh(sh, to_surfel, sh_degree)], 1)
    maps = rasterize(centers, tangents, torch.sigmoid(parameters["opacity_logits"]), features, camera, RasterSettings(near=near))
    # Maps are divided by coverage; a pixel hardly covered keeps a bounded gradient.
    inverse = 1 / maps.coverage.clamp(min=0.02)
    depth = maps.depth_sum * inverse + maps.depth_origin
    pixels = (maps.coverage.detach().flatten() > 0.02).nonzero().squeeze(1)
    values = (maps.features.flatten(1)[:, pixels] * inverse.flatten()[pixels]).T
    _, directions = pixel_rays_world(camera)
    wo = -directions.reshape(-1, 3)[pixels]
    normal = face_camera(values[:, :3], wo)
    radiance = shade_split_sum(values[:, 3:6], values[:, 10:13], values[:, 6:9], values[:, 9], normal, wo, tables)
    size = (camera.height, camera.width)

    def image(packed: Tensor) -> Tensor:
        return packed.new_zeros(camera.height * camera.width, packed.shape[1]).index_copy(0, pixels, packed).view(*size, -1)

    return StageOneMaps(image(radiance), maps.coverage, image(normal), depth, image(values[:, 9:10])[..., 0], values[:, 10:13])


def scaled_camera(camera: Camera, factor: float) -> Camera:
    """The same view at `factor` times the size (exact: pixel centres stay at +0.5)."""
    width, height = round(camera.width * factor), round(camera.height * factor)
    scale = torch.diag(torch.tensor([width / camera.width, height / camera.height, 1.0], device=camera.intrinsics.device))
    return Camera(camera.camera_from_world, scale @ camera.intrinsics, width, height, camera.name)


def background_image(background: Tensor, camera: Camera) -> Tensor:
    """(height, width, 3) sRGB of the surroundings, from their logits (1, 3, rows, 2 rows) in the environment's layout; differentiable."""
    uv = uv_from_direction(pixel_rays_world(camera)[1])
    wrapped = torch.cat([background[..., -1:], background, background[..., :1]], -1)
    columns = wrapped.shape[-1]
    x = (uv[..., 0] * (columns - 2) + 1) / columns
    grid = torch.stack([2 * x - 1, 2 * uv[..., 1] - 1], -1)[None]
    sampled = torch.nn.functional.grid_sample(wrapped, grid, mode="bilinear", padding_mode="border", align_corners=False)
    return torch.sigmoid(sampled[0]).permute(1, 2, 0)


@dataclass(frozen=True, eq=False)
class ViewTarget:
    """A photo as the losses want it."""

    camera: Camera
    photo: Tensor
    """(height, width, 3) sRGB times mask."""
    saturation: Tensor
    """(height, width, 3) sRGB as stored."""
    mask: Tensor
    rows: slice
    columns: slice
    """Box around the mask: outside it only coverage is compared."""


def view_targets(views: Views, factor: float, device: torch.device) -> list[ViewTarget]:
    """Photos at `factor` times their size, premultiplied by their masks."""
    targets = []
    for camera, image, mask in zip(views.cameras, views.images_srgb, views.coverage, strict=True):
        photo, alpha = image.float() / 255, mask.float() / 255
        small = scaled_camera(camera, factor)
        if factor != 1:
            stacked = torch.cat([photo * alpha[..., None], alpha[..., None], photo], -1).permute(2, 0, 1)[None]
            stacked = torch.nn.functional.interpolate(stacked, (small.height, small.width), mode="area")[0].permute(1, 2, 0)
            premultiplied, alpha, photo = stacked[..., :3], stacked[..., 3], stacked[..., 4:]
        else:
            premultiplied = photo * alpha[..., None]
        rows, columns = (alpha > 0).any(1).nonzero().flatten(), (alpha > 0).any(0).nonzero().flatten()
        margin = 8
        box = [slice(max(0, int(x[0]) - margin), int(x[-1]) + margin + 1) if len(x) else slice(0, 1) for x in (rows, columns)]
        targets.append(ViewTarget(small.to(device), *(x.contiguous().to(device) for x in (premultiplied, photo, alpha)), *box))
    return targets


def drawn_view(iteration: int, count: int, seed: int) -> int:
    """Which of `count` views a step looks at: all once a round, in an order that only seed and round decide, so a resumed fit keeps it."""
    rounds, place = divmod(iteration, count)
    return int(torch.randperm(count, generator=torch.Generator().manual_seed(seed * 1_000_003 + rounds))[place])


def pick_box(target: ViewTarget) -> tuple[slice, slice]:
    """Rows and columns of the target's box."""
    return target.rows, target.columns


def fit_gaussians(
    views: Views,
    state: FitState,
    settings: FitSettings,
    radius: float,
    report: Callable[[FitReport, FitState], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> FitState:
    """Run (or go on with) stage 1 until settings.iterations, or until should_stop() says so.

    Args:
        radius: of the object's bounding sphere [world units]; scales learning rates and the near plane.
        report: called about ten times a second at most with the latest figures; may look at, not change, the state.
    """
    device = state.parameters["centers"].device
    total = settings.iterations
    half_until = int(settings.half_size_share * total)
    targets = view_targets(views, 0.5 if state.iteration < half_until else 1.0, device)
    parameters, optimizer = state.parameters, state.optimizer
    near = 0.01 * radius
    recent: list[float] = []
    started = time.monotonic()
    while state.iteration < total:
        if should_stop is not None and should_stop():
            break
        if state.iteration == half_until:
            targets = view_targets(views, 1.0, device)
        progress = state.iteration / total
        _set_rates(optimizer, settings.rates, radius, progress)
        target = targets[drawn_view(state.iteration, len(targets), settings.seed)]

        degree = min(settings.sh_degree, max(0, int((progress - settings.sh_start) * 10) + 1) if progress >= settings.sh_start else 0)
        environment = environment_table(parameters)
        tables = filter_environment(environment)
        maps = render_stage_one(parameters, tables, target.camera, near, degree)
        box = pick_box(target)
        image = display_image(maps.radiance_linear[box], maps.coverage[box], target.saturation[box])
        photo = target.photo[box]
        if not views.has_masks:
            image = image + (1 - maps.coverage[box])[..., None] * background_image(parameters["background"], target.camera)[box]
        weight = settings.weight_dissimilarity
        loss = (1 - weight) * (image - photo).abs().mean()
        if weight > 0:
            loss = loss + weight * structural_dissimilarity(image, photo)
        if views.has_masks:
            loss = loss + settings.weight_mask * mask_loss(maps.coverage, target.mask)
        else:
            loss = loss + settings.weight_coverage * maps.coverage.mean()
        if progress > 0.02:
            normal_term = normal_consistency(maps.normal_world, maps.depth, maps.coverage, target.camera)
            loss = loss + settings.weight_normal * min(1.0, (progress - 0.02) * 10) * normal_term
        loss = loss + settings.weight_white_light * white_light(environment) + settings.weight_rough_light * rough_light(environment)
        loss = loss + settings.weight_residual * maps.residual.abs().sum() / image.numel()
        if settings.weight_normal_smooth > 0:
            loss = loss + settings.weight_normal_smooth * edge_aware_smoothness(maps.normal_world[box], photo, maps.coverage[box])
        loss.backward()
        with torch.no_grad():
            recent.append(float(((image.clamp(0, 1) - photo) ** 2).sum() / target.photo.numel()))
            state.pull.add(parameters["centers"], parameters["centers"].grad, target.camera)
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        state.iteration += 1

        plan = settings.densify
        if state.iteration % plan.every == 0 and plan.start <= progress <= plan.stop:
            state.pull = densify(optimizer, parameters, state.pull, plan, radius, state.generator)
        if plan.reset_every and state.iteration % plan.reset_every == 0 and progress <= plan.stop:
            reset_opacity(optimizer, parameters)
        if report is not None:
            recent = recent[-len(targets) :]
            psnr = -10 * math.log10(max(sum(recent) / len(recent), 1e-12))
            report(FitReport(state.iteration, total, psnr, len(parameters["centers"]), time.monotonic() - started), state)
    return state


def _set_rates(optimizer: torch.optim.Adam, rates: LearningRates, radius: float, progress: float) -> None:
    for group in optimizer.param_groups:
        if group["name"] == "centers":
            group["lr"] = radius * rates.centers ** (1 - progress) * rates.centers_end**progress
        elif group["name"] == "quats":
            group["lr"] = rates.quats ** (1 - progress) * rates.quats_end**progress


def gaussians_from_state(state: FitState) -> Gaussians:
    """Surfels as an asset holds them, but for `sh`, which is the residual alone (bake_outgoing_radiance makes it the whole)."""
    p = {name: value.detach() for name, value in state.parameters.items()}
    return Gaussians(
        centers=p["centers"],
        log_scales=p["log_scales"],
        quats_wxyz=torch.nn.functional.normalize(p["quats"], dim=-1),
        opacity_logits=p["opacity_logits"],
        sh=torch.cat([p["sh_dc"], p["sh_rest"]], 1),
        albedo=torch.sigmoid(p["albedo_logits"]),
        roughness=torch.sigmoid(p["roughness_logits"]),
        metallic=torch.sigmoid(p["metallic_logits"]),
    )


def environment_from_state(state: FitState) -> Environment:
    """The learned light."""
    with torch.no_grad():
        return Environment(environment_table(state.parameters))
