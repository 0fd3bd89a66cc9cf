"""The loop that every fit runs in: draw a view, sum the loss terms, go a step down, report.

A stage gives a `FitLoop`: its state, how many iterations, what a step costs and which rates it takes; where it wants to, what happens after the
gradients are known and after the step. The loop asks whether to stop, keeps the running PSNR and tells of each step. It knows neither
surfels nor photographs; checkpoints are its caller's.
"""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from jaxtyping import Float64
from torch import Tensor

from drgs.reconstruct.fit.adam import Adam
from drgs.reconstruct.fit.densify import ScreenGradientStats
from drgs.reconstruct.fit.surfels.surfel_shadows import SurfelShadows
from drgs.scene.camera import Camera


@dataclass(eq=False)
class FitState:
    """Everything a checkpoint must hold to go on with the same numbers."""

    parameters: dict[str, Tensor]
    optimizer: Adam
    """One group a parameter, of the same `name`; `full_rate` is its rate at the start."""
    generator: torch.Generator
    iteration: int = 0
    """Steps done."""
    screen_gradients: ScreenGradientStats | None = None
    """Of surfels that are divided (stage 1); None elsewhere."""
    exposures: Float64[Tensor, "view 4"] | None = None
    """Of each view its gain and its tints, as the fit found them half way (stage 1); None before, and elsewhere."""
    shadows: SurfelShadows | None = None
    """Of surfels, where light turns with the camera and their shape has been looked at (stage 1); None elsewhere."""


@dataclass(frozen=True)
class FitReport:
    """One line of progress."""

    iteration: int
    iterations: int
    psnr: float
    """Running mean over the last views, display space, on black [dB]."""
    elements: int
    """Surfels, or vertices."""
    seconds: float
    """Since the fit was started or resumed."""
    terms: dict[str, float] = field(default_factory=dict)
    """Of the last step: weighted loss terms by name."""


@dataclass(frozen=True, eq=False)
class StepLoss:
    """What one drawn view costs."""

    terms: dict[str, Tensor]
    """Weighted scalars by name; their sum is minimised."""
    camera: Camera
    """Of the drawn view."""
    squared_error: float | None
    """Mean over what was compared with the photograph, display space; None where nothing was."""


@dataclass(frozen=True, eq=False)
class FitLoop:
    """What a stage gives to run_fit."""

    state: FitState
    iterations: int
    view_count: int
    """Steps that the running PSNR looks back."""
    step: Callable[[int], StepLoss]
    """The loss of the iteration with this number, from 0."""
    rates: Callable[[int], dict[str, float]]
    """Adam's rates by parameter in that iteration; those left out stay as they are."""
    after_backward: Callable[[StepLoss], None] | None = None
    """Called while gradients are there and parameters still are what they were drawn with."""
    after_step: Callable[[int], None] | None = None
    """Called with the number of steps done; may replace parameters, as densify does."""


def run_fit(fit: FitLoop, report: Callable[[FitReport], None] | None = None, should_stop: Callable[[], bool] | None = None) -> FitState:
    """Run (or go on with) a fit until fit.iterations are done, or until should_stop(), asked before each step, says so.

    Args:
        report: called after each step; may look at, not change, the state.

    Raises:
        ValueError: a step's loss is not finite; the state is as it was before that step.
    """
    state = fit.state
    recent: deque[float] = deque(maxlen=fit.view_count)
    started = time.monotonic()
    while state.iteration < fit.iterations:
        if should_stop is not None and should_stop():
            break
        rates = fit.rates(state.iteration)
        for group in state.optimizer.param_groups:
            group["lr"] = rates.get(group["name"], group["lr"])
        loss = fit.step(state.iteration)
        total = torch.stack(list(loss.terms.values())).sum()
        if not torch.isfinite(total):
            lost = ", ".join(name for name, term in loss.terms.items() if not torch.isfinite(term))
            raise ValueError(
                f"step {state.iteration + 1} of {fit.iterations} of a fit has no finite error (of {lost or 'all terms together'}), so the build cannot go on; "
                "expected finite numbers: look at the capture with `drgs doctor`, or build again with another --seed"
            )
        total.backward()
        if fit.after_backward is not None:
            fit.after_backward(loss)
        state.optimizer.step()
        state.optimizer.zero_grad()
        state.iteration += 1
        if fit.after_step is not None:
            fit.after_step(state.iteration)
        if loss.squared_error is not None:
            recent.append(loss.squared_error)
        if report is not None and recent:
            report(_report(fit, loss, sum(recent) / len(recent), time.monotonic() - started))
    return state


def _report(fit: FitLoop, loss: StepLoss, mean_squared_error: float, seconds: float) -> FitReport:
    values = torch.stack([term.detach() for term in loss.terms.values()]).tolist()
    return FitReport(
        iteration=fit.state.iteration,
        iterations=fit.iterations,
        psnr=-10 * math.log10(max(mean_squared_error, 1e-12)),
        elements=len(next(iter(fit.state.parameters.values()))),
        seconds=seconds,
        terms=dict(zip(loss.terms, values, strict=True)),
    )


def cosine_rates(optimizer: Adam, iteration: int, iterations: int) -> dict[str, float]:
    """Rates that fall from `full_rate` to a tenth of it by a cosine."""
    share = 0.55 + 0.45 * math.cos(math.pi * iteration / iterations)
    return {group["name"]: group["full_rate"] * share for group in optimizer.param_groups}
