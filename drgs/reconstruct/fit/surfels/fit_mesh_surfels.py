"""Fine-tune surfels that live on the faces of a mesh, from the photographs that the fitted ones came from.

What a surfel may change: its place within its face (barycentrics, by softmax), its offset along the face's normal, opacity, scales,
orientation, material and residual colour; the light follows. It never leaves its face. Rendering and losses are stage 1's.
Source: drgs2026, section on mesh-based re-initialisation and its Fig. 9, whose ablations are `learn_offset` and `learn_opacity`.

In: Views, mesh_surfels' result, stage 1's light. Out: Gaussians and their Binding.
"""

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Literal, TypeVar

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.reconstruct.fit.fit_loop import FitLoop, FitReport, FitState, StepLoss, cosine_rates, run_fit
from drgs.reconstruct.fit.light.environment_pyramid import environment_table
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.surfel_parameters import (
    gaussians_from_parameters,
    leaves,
    light_parameters,
    make_optimizer,
    parameters_from_gaussians,
    residual_sh,
)
from drgs.reconstruct.fit.surfels.fit_gaussians import FitSettings, displayed, squared_error, stage_one_terms
from drgs.reconstruct.fit.surfels.render_stage_one import render_stage_one
from drgs.reconstruct.fit.view_targets import drawn_view, view_targets
from drgs.reconstruct.geometry.bind_gaussians import foot_and_normal
from drgs.reconstruct.geometry.mesh_surfels import FARTHEST, face_frames
from drgs.render.visible.rasterize.near_plane import near_plane
from drgs.scene.binding import Binding
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views

Record = TypeVar("Record", Gaussians, Binding)


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


@dataclass(frozen=True, eq=False)
class MeshFitState:
    """The fit, and what follows from the mesh: that part never changes, and no checkpoint holds it."""

    fit: FitState
    mesh: TriangleMesh
    face: Int[Tensor, "surfel"]
    """int32: where each surfel lives."""
    unit: Float[Tensor, "surfel"]
    """[world units] of an offset of 1."""
    longest_edge: Float[Tensor, "surfel"]
    """[world units]: no surfel grows beyond it."""


def start_mesh_fit(
    gaussians: Gaussians, binding: Binding, mesh: TriangleMesh, stage_one: dict[str, Tensor], settings: MeshFitSettings
) -> MeshFitState:
    """State from mesh_surfels' result and the light among stage 1's parameters."""
    frames = face_frames(mesh, settings.variant)
    index = binding.face.long()
    unit = frames.unit[index]
    offsets = (binding.normal_offset / unit).clamp(-FARTHEST, FARTHEST)
    own = {name: value for name, value in parameters_from_gaussians(gaussians).items() if name != "centers"}
    on_face = {
        "offsets": offsets if settings.learn_offset else torch.zeros_like(offsets),
        "barycentric_logits": binding.barycentric.clamp(min=1e-3).log(),
    }
    harmonics = {"sh_dc": gaussians.sh[:, :1], "sh_rest": gaussians.sh[:, 1:]}
    frozen = {name for name, learnt in (("offsets", settings.learn_offset), ("opacity_logits", settings.learn_opacity)) if not learnt}
    parameters = leaves(on_face | own | harmonics | light_parameters(stage_one), frozen)
    optimizer = make_optimizer(parameters, settings.rates, radius=1.0)
    fit = FitState(parameters, optimizer, torch.Generator().manual_seed(settings.seed))
    return MeshFitState(fit, mesh, binding.face, unit, frames.longest_edge[index])


def surfels_on_faces(state: MeshFitState) -> dict[str, Tensor]:
    """The parameters as render_stage_one wants them: with centres, differentiable."""
    parameters = state.fit.parameters
    weights = torch.softmax(parameters["barycentric_logits"], -1)
    foot, normal = foot_and_normal(state.face, weights, state.mesh.vertices, state.mesh.faces)
    return parameters | {"centers": foot + (parameters["offsets"] * state.unit)[:, None] * normal}


def fit_mesh_surfels(
    views: Views,
    state: MeshFitState,
    settings: MeshFitSettings,
    radius: float,
    report: Callable[[FitReport], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> MeshFitState:
    """Run (or go on with) the fine-tuning; see run_fit.

    Args:
        radius: of the object's bounding sphere [world units]; scales the near plane.
    """
    fit, weights = state.fit, replace(settings.losses, weight_coverage=0.0)  # without masks nothing is asked of the outline
    parameters = fit.parameters
    targets = view_targets(views, 1.0, parameters["offsets"].device)

    def step(iteration: int) -> StepLoss:
        target = targets[drawn_view(iteration, len(targets), settings.seed + 1)]
        environment = environment_table(parameters)
        tables = filter_environment(environment)
        maps = render_stage_one(
            surfels_on_faces(state), tables, target.camera, near_plane(radius), weights.sh_degree, target.light_from_world
        )
        image = displayed(maps, target)
        terms = stage_one_terms(maps, image, target, environment, weights, views.has_masks)
        return StepLoss(terms, target.camera, squared_error(image, target))

    def rates(iteration: int) -> dict[str, float]:
        return cosine_rates(fit.optimizer, iteration, settings.iterations)

    def keep_in_bounds(_done: int) -> None:
        with torch.no_grad():
            parameters["offsets"].clamp_(-FARTHEST, FARTHEST)
            # A splat much larger than its face tears when neighbours part.
            parameters["log_scales"].copy_(torch.minimum(parameters["log_scales"], state.longest_edge.log()[:, None]))

    run_fit(FitLoop(fit, settings.iterations, len(targets), step, rates, after_step=keep_in_bounds), report, should_stop)
    return state


def gaussians_from_mesh_fit(state: MeshFitState) -> tuple[Gaussians, Binding]:
    """Surfels as stage 2 takes them (`sh` is the residual alone, as from gaussians_from_state), and where they sit."""
    with torch.no_grad():
        p = surfels_on_faces(state)
        binding = Binding(state.face, torch.softmax(p["barycentric_logits"], -1), p["offsets"] * state.unit)
        return gaussians_from_parameters(p, residual_sh(p)), detached(binding)


def detached(record: Record) -> Record:
    """The same record without gradients."""
    return type(record)(*(getattr(record, entry.name).detach() for entry in fields(record)))
