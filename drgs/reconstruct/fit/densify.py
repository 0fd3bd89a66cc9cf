"""Where surfels are added and removed: more where the image would move them most, none where nothing is drawn.

Measured by the mean norm of the loss gradient with respect to a surfel's screen position (Kerbl et al. 2023). Instead of a threshold,
which depends on image size, loss and scene, a fixed share of the surfels, those of the largest gradients, is divided until the budget is
reached.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.reconstruct.fit.adam import Adam
from drgs.reconstruct.fit.surfel_parameters import divide_surfels, keep_surfels
from drgs.scene.camera import Camera


@dataclass(frozen=True)
class DensifySettings:
    """When and how much; iterations are shares of the whole fit."""

    every: int = 100
    """Iterations between rounds."""
    start: float = 0.08
    stop: float = 0.65
    growth: float = 0.12
    """Largest share of surfels divided in a round."""
    budget: int = 40_000
    """Surfels at most."""
    prune_opacity: float = 0.05
    prune_radius: float = 0.25
    """Surfels larger than this share of the object's radius are dropped."""
    reset_every: int = 0
    """Iterations between opacity resets (opacity <= 0.1); 0: never. The visual hull leaves no fog to clear, random points do."""


@dataclass(eq=False)
class ScreenGradientStats:
    """Running mean of the screen-space gradient, per surfel."""

    total: Float[Tensor, "surfel"]
    seen: Float[Tensor, "surfel"]

    @staticmethod
    def zeros(count: int, device: torch.device) -> "ScreenGradientStats":
        return ScreenGradientStats(torch.zeros(count, device=device), torch.zeros(count, device=device))

    def add(self, centers: Float[Tensor, "surfel 3"], center_gradients: Float[Tensor, "surfel 3"], camera: Camera) -> None:
        """Add one view's gradients (N, 3): lengths are turned into shares of the image width."""
        rotation = camera.camera_from_world[:3, :3]
        across = center_gradients @ rotation[:2].T
        depth = centers @ rotation[2] + camera.camera_from_world[2, 3]
        norm = across.norm(dim=1) * depth.clamp(min=0) * (camera.width / camera.intrinsics[0, 0])
        self.total += norm
        self.seen += (norm > 0).float()


def densify(
    optimizer: Adam,
    parameters: dict[str, Tensor],
    gradients: ScreenGradientStats,
    settings: DensifySettings,
    radius: float,
    generator: torch.Generator,
) -> ScreenGradientStats:
    """One round; returns the emptied statistics."""
    with torch.no_grad():
        opacity = torch.sigmoid(parameters["opacity_logits"])
        largest = parameters["log_scales"].amax(1).exp()
        finite = torch.isfinite(parameters["centers"]).all(1) & torch.isfinite(parameters["log_scales"]).all(1)
        kept = (opacity > settings.prune_opacity) & (largest < settings.prune_radius * radius) & (gradients.seen > 0) & finite
        mean_gradient = (gradients.total / gradients.seen.clamp(min=1))[kept]
    keep_surfels(optimizer, parameters, kept)
    count = len(mean_gradient)
    added = min(int(settings.growth * count), settings.budget - count)
    if added > 0:
        chosen = torch.topk(mean_gradient, added).indices
        divide_surfels(optimizer, parameters, chosen, generator)
    return ScreenGradientStats.zeros(len(parameters["centers"]), parameters["centers"].device)


def reset_opacity(optimizer: Adam, parameters: dict[str, Tensor], ceiling: float = 0.1) -> None:
    """Opacity of every surfel at most `ceiling`, with Adam's memory of it cleared: fog does not come back, surfaces do."""
    with torch.no_grad():
        parameters["opacity_logits"].clamp_(max=float(torch.logit(torch.tensor(ceiling))))
    state = optimizer.state.get(parameters["opacity_logits"])
    if state:
        state["exp_avg"].zero_()
        state["exp_avg_sq"].zero_()
