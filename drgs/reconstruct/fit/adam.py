"""Adam, as all fits step by it: torch's own fused kernel, without torch's own optimizer around it.

The first optimizer of torch's that a process makes loads torch's compiler, which no fit needs: two seconds of a core.
Bits are those of `torch.optim.Adam(..., fused=True)`.
"""

from typing import Any

import torch
from torch import Tensor


class Adam:
    """Steps parameters that have gradients.

    Args:
        groups: records with "params" (float32 leaves, all on one device) and "lr" (rate), and "betas" and "eps" of their own where they have them;
            whatever else they hold is kept.
        betas: how much of the running means of gradients and of their squares a step keeps. eps: is added to the root of the latter.
    """

    def __init__(self, groups: list[dict[str, Any]], betas: tuple[float, float] = (0.9, 0.999), eps: float = 1e-8) -> None:
        self.param_groups = groups
        self.state: dict[Tensor, dict[str, Tensor]] = {}
        """By parameter, once it was stepped: "step" (how often), "exp_avg" and "exp_avg_sq" (shaped as the parameter)."""
        self._betas, self._eps = betas, eps

    @torch.no_grad()
    def step(self) -> None:
        """Move every parameter that has a gradient, by its group's rate now."""
        for group in self.param_groups:
            moved = [value for value in group["params"] if value.grad is not None]
            if not moved:
                continue
            betas = group.get("betas", self._betas)
            states = [self.state.setdefault(value, {}) or self._begun(value) for value in moved]
            steps = [state["step"] for state in states]
            torch._foreach_add_(steps, 1)
            torch._fused_adam_(
                moved,
                [value.grad for value in moved],
                [state["exp_avg"] for state in states],
                [state["exp_avg_sq"] for state in states],
                [],
                steps,
                lr=group["lr"],
                beta1=betas[0],
                beta2=betas[1],
                weight_decay=0.0,
                eps=group.get("eps", self._eps),
                amsgrad=False,
                maximize=False,
            )

    def _begun(self, value: Tensor) -> dict[str, Tensor]:
        state = self.state[value]
        state["step"] = torch.zeros((), device=value.device)
        state["exp_avg"], state["exp_avg_sq"] = torch.zeros_like(value), torch.zeros_like(value)
        return state

    def zero_grad(self) -> None:
        """Forget the gradients."""
        for group in self.param_groups:
            for value in group["params"]:
                value.grad = None
