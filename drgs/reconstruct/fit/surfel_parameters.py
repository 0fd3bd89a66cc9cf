"""The numbers that Adam moves, by name: how they start, what they stand for, and how surfels are added and removed without losing moments."""

import math
from collections.abc import Collection
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.maths.color import linear_from_srgb
from drgs.maths.frames import quat_wxyz_from_rotation, rotation_from_quat_wxyz, tangents_from_normal
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.fit.adam import Adam
from drgs.scene.gaussians import Gaussians

ADAM_EPSILON = 1e-15
INITIAL_LIGHT = 0.6
"""Radiance of the uniform environment that the fit starts under."""


@dataclass(frozen=True)
class LearningRates:
    """Adam's step per group; world lengths are in units of the object's radius. Rates ending in _end are reached exponentially."""

    centers: float = 4e-3
    centers_end: float = 2e-5
    log_scales: float = 0.01
    quats: float = 0.005
    quats_end: float = 0.001
    opacity_logits: float = 0.04
    sh_dc: float = 0.005
    sh_rest: float = 0.0005
    albedo_logits: float = 0.02
    roughness_logits: float = 0.02
    metallic_logits: float = 0.04
    environment: float = 0.03


SURFEL_GROUPS = (
    "centers",
    "log_scales",
    "quats",
    "opacity_logits",
    "sh_dc",
    "sh_rest",
    "albedo_logits",
    "roughness_logits",
    "metallic_logits",
)


def logit(p: float) -> float:
    return math.log(p / (1 - p))


def initial_parameters(points: InitialPoints, device: torch.device, seed: int) -> dict[str, Tensor]:
    """Surfels lying in the initial surface, as large as the points' spacing; random orientation where no surface is known."""
    generator = torch.Generator().manual_seed(seed)
    count = len(points.points_world)
    distances, _ = cKDTree(points.points_world.numpy()).query(points.points_world.numpy(), k=4)
    spacing = torch.from_numpy(distances[:, 1:].mean(1)).float().clamp(min=1e-4 * points.bounds_radius, max=0.1 * points.bounds_radius)
    if points.normals_world is None:
        quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=-1)
    else:
        t_u, t_v = tangents_from_normal(points.normals_world)
        quats = quat_wxyz_from_rotation(torch.stack([t_u, t_v, points.normals_world], -1))
    radiance = linear_from_srgb(points.colors_srgb)
    parameters = {
        "centers": points.points_world.clone(),
        "log_scales": spacing.log()[:, None].repeat(1, 2),
        "quats": quats,
        "opacity_logits": torch.full((count,), logit(0.6 if points.normals_world is not None else 0.1)),
        "sh_dc": torch.zeros(count, 1, 3),
        "sh_rest": torch.zeros(count, 15, 3),
        "albedo_logits": torch.logit((radiance / INITIAL_LIGHT).clamp(0.1, 0.8)),
        "roughness_logits": torch.full((count,), logit(0.35)),
        "metallic_logits": torch.full((count,), logit(0.25)),
    }
    return {name: value.to(device).requires_grad_(True) for name, value in parameters.items()}


def make_optimizer(parameters: dict[str, Tensor], rates: object, radius: float) -> Adam:
    """One group a name, in the order of `parameters`; parameters that want no gradient stay as they are.

    Args:
        rates: a record with a rate a name; tables of light share `environment`. radius: of the object [world units], the unit of centres' rate.
    """
    groups = []
    for name, value in parameters.items():
        rate = rate_of_group(name, rates) * (radius if name == "centers" else 1.0) if value.requires_grad else 0.0
        groups.append({"params": [value], "lr": rate, "name": name, "full_rate": rate})
    return Adam(groups, eps=ADAM_EPSILON)


def rate_of_group(name: str, rates: object) -> float:
    """Of the record with a rate a name; tables of light share `environment`."""
    return getattr(rates, "environment" if name.startswith("environment") or name in ("background", "ground") else name)


def parameters_from_gaussians(gaussians: Gaussians) -> dict[str, Tensor]:
    """What later fits start from; all but the harmonics, which each stage reads in its own way."""
    return {
        "centers": gaussians.centers,
        "log_scales": gaussians.log_scales,
        "quats": gaussians.quats_wxyz,
        "opacity_logits": gaussians.opacity_logits,
        "albedo_logits": logits_of_shares(gaussians.albedo),
        "roughness_logits": logits_of_shares(gaussians.roughness),
        "metallic_logits": logits_of_shares(gaussians.metallic),
    }


def gaussians_from_parameters(parameters: dict[str, Tensor], sh: Float[Tensor, "surfel 16 3"]) -> Gaussians:
    """Surfels as an asset holds them, without gradients, with harmonics `sh` (surfel, 16, 3)."""
    p = {name: value.detach() for name, value in parameters.items()}
    return Gaussians(
        centers=p["centers"],
        log_scales=p["log_scales"],
        quats_wxyz=torch.nn.functional.normalize(p["quats"], dim=-1),
        opacity_logits=p["opacity_logits"],
        sh=sh.detach(),
        albedo=torch.sigmoid(p["albedo_logits"]),
        roughness=torch.sigmoid(p["roughness_logits"]),
        metallic=torch.sigmoid(p["metallic_logits"]),
    )


def residual_sh(parameters: dict[str, Tensor]) -> Float[Tensor, "surfel 16 3"]:
    """(surfel, 16, 3) harmonics of the radiance that stage 1 explains by nothing else."""
    return torch.cat([parameters["sh_dc"], parameters["sh_rest"]], 1)


def light_parameters(parameters: dict[str, Tensor]) -> dict[str, Tensor]:
    """The tables of environment_table among the parameters of a fit."""
    return {name: value for name, value in parameters.items() if name.startswith("environment_")}


def leaves(values: dict[str, Tensor], frozen: Collection[str] = ()) -> dict[str, Tensor]:
    """Copies for Adam to move, all but those named in `frozen`."""
    # Row-major like a checkpoint's: sums round by memory layout, and a resumed fit must end with the same bits.
    copies = {name: value.detach().clone(memory_format=torch.contiguous_format) for name, value in values.items()}
    return {name: value.requires_grad_(name not in frozen) for name, value in copies.items()}


def logits_of_shares(shares: Float[Tensor, "*shape"]) -> Float[Tensor, "*shape"]:
    """Logits of values 0..1, which are kept off the ends, where no gradient would bring them back."""
    return torch.logit(shares.clamp(0.005, 0.995))


def _replace(optimizer: Adam, parameters: dict[str, Tensor], change) -> None:
    """Apply `change(name, tensor, is_moment)` to every surfel tensor and to its Adam moments."""
    for group in optimizer.param_groups:
        name = group["name"]
        if name not in SURFEL_GROUPS:
            continue
        old = group["params"][0]
        state = optimizer.state.pop(old, None)
        new = change(name, old.detach(), False).contiguous().requires_grad_(True)
        if state is not None:
            for key in ("exp_avg", "exp_avg_sq"):
                state[key] = change(name, state[key], True).contiguous()
            optimizer.state[new] = state
        group["params"][0] = new
        parameters[name] = new


def keep_surfels(optimizer: Adam, parameters: dict[str, Tensor], kept: Bool[Tensor, "surfel"]) -> None:
    """Drop the surfels where `kept` (N,) is False."""
    _replace(optimizer, parameters, lambda name, value, is_moment: value[kept])


def divide_surfels(optimizer: Adam, parameters: dict[str, Tensor], chosen: Int[Tensor, "chosen"], generator: torch.Generator) -> None:
    """Replace each chosen surfel (indices) by two: half-sized along its longer axis, set apart along it, so that they cover the same disc.

    Clone and split of 3DGS in one: a small surfel's halves stay within its footprint, a large one's separate.
    """
    with torch.no_grad():
        log_scales = parameters["log_scales"][chosen]
        longer = log_scales.argmax(1)
        rotation = rotation_from_quat_wxyz(parameters["quats"][chosen])
        axis = rotation[torch.arange(len(chosen)), :, longer]
        length = log_scales.gather(1, longer[:, None]).exp()
        side = torch.rand(len(chosen), 1, generator=generator).to(axis.device).round() * 2 - 1
        shift = axis * length * 0.7 * side
        shrunk = log_scales.clone()
        shrunk.scatter_(1, longer[:, None], log_scales.gather(1, longer[:, None]) - math.log(1.7))

    def change(name: str, value: Tensor, is_moment: bool) -> Tensor:
        twin = value[chosen]
        if is_moment:
            return torch.cat([value, torch.zeros_like(twin)])
        value = value.clone()
        if name == "centers":
            value[chosen], twin = twin + shift, twin - shift
        elif name == "log_scales":
            value[chosen], twin = shrunk, shrunk
        return torch.cat([value, twin])

    _replace(optimizer, parameters, change)
