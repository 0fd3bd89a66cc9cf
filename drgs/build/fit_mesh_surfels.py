"""Fine-tune surfels that live on the faces of a mesh, from the photographs that the fitted ones came from.

What a surfel may change: its place within its face (barycentrics, by softmax), its offset along the face's normal, opacity, scales,
orientation, material and residual colour; the light follows. It never leaves its face. Rendering and losses are stage 1's.
Source: drgs2026, section on mesh-based re-initialisation and its Fig. 9, whose ablations are `learn_offset` and `learn_opacity`.

In: Views, mesh_surfels' result, stage 1's light. Out: Gaussians and their Binding.
"""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from typing import Literal

import torch
from torch import Tensor

from drgs.build.bind_gaussians import foot_and_normal
from drgs.build.fit_gaussians import (
    FitReport,
    FitSettings,
    drawn_view,
    environment_table,
    pick_box,
    render_stage_one,
    view_targets,
)
from drgs.build.losses import (
    display_image,
    edge_aware_smoothness,
    mask_loss,
    normal_consistency,
    rough_light,
    structural_dissimilarity,
    white_light,
)
from drgs.build.mesh_surfels import FARTHEST, face_frames
from drgs.build.split_sum import filter_environment
from drgs.build.surfel_parameters import ADAM_EPSILON
from drgs.scene.binding import Binding
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views


@dataclass(frozen=True)
class MeshRates:
    """Adam's step per group; they fall to a tenth by a cosine. Offsets are in units of the face's size."""

    offsets: float = 0.02
    barycentric_logits: float = 0.02
    log_scales: float = 0.01
    quats: float = 0.004
    opacity_logits: float = 0.05
    sh_dc: float = 0.005
    sh_rest: float = 0.0005
    albedo_logits: float = 0.01
    roughness_logits: float = 0.01
    metallic_logits: float = 0.01
    environment: float = 0.005


@dataclass(frozen=True)
class MeshFitSettings:
    """A short fit: everything but the surfels' places is known already."""

    iterations: int = 400
    learn_offset: bool = True
    """False: surfels stay on the faces themselves (Fig. 9: spikes and blur)."""
    learn_opacity: bool = True
    """False: opacities stay as they were taken over (Fig. 9: stains and cracks)."""
    variant: Literal["corrected", "paper"] = "corrected"
    """How Alg. 1 was read (see mesh_surfels): decides the unit of offsets here."""
    rates: MeshRates = field(default_factory=MeshRates)
    losses: FitSettings = field(default_factory=FitSettings)
    """Whose weights are used."""
    seed: int = 0


@dataclass(eq=False)
class MeshFitState:
    """Everything a checkpoint must hold, and what follows from the mesh."""

    parameters: dict[str, Tensor]
    optimizer: torch.optim.Adam
    iteration: int
    generator: torch.Generator
    mesh: TriangleMesh
    face: Tensor
    """(surfel,) int32: never changes."""
    unit: Tensor
    """(surfel,) [world units] of an offset of 1."""
    longest_edge: Tensor
    """(surfel,) [world units]: no surfel grows beyond it."""


def start_mesh_fit(
    gaussians: Gaussians, binding: Binding, mesh: TriangleMesh, stage_one: dict[str, Tensor], settings: MeshFitSettings
) -> MeshFitState:
    """State from mesh_surfels' result and the light among stage 1's parameters."""
    frames = face_frames(mesh, settings.variant)
    index = binding.face.long()
    unit = frames.unit[index]
    offsets = (binding.normal_offset / unit).clamp(-FARTHEST, FARTHEST)
    parameters = {
        "offsets": offsets if settings.learn_offset else torch.zeros_like(offsets),
        "barycentric_logits": binding.barycentric.clamp(min=1e-3).log(),
        "log_scales": gaussians.log_scales,
        "quats": gaussians.quats_wxyz,
        "opacity_logits": gaussians.opacity_logits,
        "sh_dc": gaussians.sh[:, :1],
        "sh_rest": gaussians.sh[:, 1:],
        "albedo_logits": torch.logit(gaussians.albedo.clamp(0.005, 0.995)),
        "roughness_logits": torch.logit(gaussians.roughness.clamp(0.005, 0.995)),
        "metallic_logits": torch.logit(gaussians.metallic.clamp(0.005, 0.995)),
    } | {name: value for name, value in stage_one.items() if name.startswith("environment_")}
    frozen = {name for name, learnt in (("offsets", settings.learn_offset), ("opacity_logits", settings.learn_opacity)) if not learnt}
    parameters = {
        name: value.detach().clone(memory_format=torch.contiguous_format).requires_grad_(name not in frozen)
        for name, value in parameters.items()
    }
    groups = []
    for name, value in parameters.items():
        rate = 0.0 if name in frozen else getattr(settings.rates, "environment" if name.startswith("environment") else name)
        groups.append({"params": [value], "lr": rate, "name": name, "full_rate": rate})
    optimizer = torch.optim.Adam(groups, eps=ADAM_EPSILON, fused=True)
    generator = torch.Generator().manual_seed(settings.seed)
    return MeshFitState(parameters, optimizer, 0, generator, mesh, binding.face, unit, frames.longest_edge[index])


def surfels_on_faces(state: MeshFitState) -> dict[str, Tensor]:
    """The parameters as render_stage_one wants them: with centres, differentiable."""
    parameters = state.parameters
    weights = torch.softmax(parameters["barycentric_logits"], -1)
    foot, normal = foot_and_normal(state.face, weights, state.mesh.vertices, state.mesh.faces)
    return parameters | {"centers": foot + (parameters["offsets"] * state.unit)[:, None] * normal}


def fit_mesh_surfels(
    views: Views,
    state: MeshFitState,
    settings: MeshFitSettings,
    radius: float,
    report: Callable[[FitReport, MeshFitState], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> MeshFitState:
    """Run (or go on with) the fine-tuning until settings.iterations, or until should_stop() says so.

    Args:
        radius: of the object's bounding sphere [world units]; scales the near plane.
    """
    parameters, optimizer, weights = state.parameters, state.optimizer, settings.losses
    targets = view_targets(views, 1.0, parameters["offsets"].device)
    recent: list[float] = []
    started = time.monotonic()
    while state.iteration < settings.iterations:
        if should_stop is not None and should_stop():
            break
        for group in optimizer.param_groups:
            group["lr"] = group["full_rate"] * (0.55 + 0.45 * math.cos(math.pi * state.iteration / settings.iterations))
        target = targets[drawn_view(state.iteration, len(targets), settings.seed + 1)]
        environment = environment_table(parameters)
        maps = render_stage_one(surfels_on_faces(state), filter_environment(environment), target.camera, 0.01 * radius, weights.sh_degree)
        box = pick_box(target)
        image = display_image(maps.radiance_linear[box], maps.coverage[box], target.saturation[box])
        photo = target.photo[box]
        loss = (1 - weights.weight_dissimilarity) * (image - photo).abs().mean()
        loss = loss + weights.weight_dissimilarity * structural_dissimilarity(image, photo)
        if views.has_masks:
            loss = loss + weights.weight_mask * mask_loss(maps.coverage, target.mask)
        loss = loss + weights.weight_normal * normal_consistency(maps.normal_world, maps.depth, maps.coverage, target.camera)
        loss = loss + weights.weight_white_light * white_light(environment) + weights.weight_rough_light * rough_light(environment)
        loss = loss + weights.weight_residual * maps.residual.abs().sum() / image.numel()
        loss = loss + weights.weight_normal_smooth * edge_aware_smoothness(maps.normal_world[box], photo, maps.coverage[box])
        loss.backward()
        optimizer.step()
        optimizer.zero_grad(set_to_none=True)
        with torch.no_grad():
            recent.append(float(((image.clamp(0, 1) - photo) ** 2).sum() / target.photo.numel()))
            parameters["offsets"].clamp_(-FARTHEST, FARTHEST)
            # A splat much larger than its face tears when neighbours part.
            parameters["log_scales"].copy_(torch.minimum(parameters["log_scales"], state.longest_edge.log()[:, None]))
        state.iteration += 1
        if report is not None:
            recent = recent[-len(targets) :]
            psnr = -10 * math.log10(max(sum(recent) / len(recent), 1e-12))
            report(FitReport(state.iteration, settings.iterations, psnr, len(state.face), time.monotonic() - started), state)
    return state


def gaussians_from_mesh_fit(state: MeshFitState) -> tuple[Gaussians, Binding]:
    """Surfels as stage 2 takes them (`sh` is the residual alone, as from gaussians_from_state), and where they sit."""
    with torch.no_grad():
        p = surfels_on_faces(state)
        binding = Binding(state.face, torch.softmax(p["barycentric_logits"], -1), p["offsets"] * state.unit)
        gaussians = Gaussians(
            centers=p["centers"],
            log_scales=p["log_scales"],
            quats_wxyz=torch.nn.functional.normalize(p["quats"], dim=-1),
            opacity_logits=p["opacity_logits"],
            sh=torch.cat([p["sh_dc"], p["sh_rest"]], 1),
            albedo=torch.sigmoid(p["albedo_logits"]),
            roughness=torch.sigmoid(p["roughness_logits"]),
            metallic=torch.sigmoid(p["metallic_logits"]),
        )
        return detached(gaussians), detached(binding)


def detached(record):
    """The same record without gradients."""
    return type(record)(*(getattr(record, entry.name).detach() for entry in fields(record)))
