"""A cost that is a sum over pixels or places, worked out in parts by the CPU's threads, gradients and all.

A step of a fit is some hundred operations on ten thousand places each: too short for torch to share between cores, whose threads wait longer
for each other than they compute. Here every thread takes a part of the places through all operations and back. The parts are always the same
number, added in the same order, and each draws from a generator of its own, so that sums do not depend on how many cores there are.

In: how many places, leaves, and what a part of the places costs. Out: scalars that know their gradient.
"""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from drgs.warp_torch import by_pool

SLICES = 2
"""Parts on the CPU; elsewhere all is one. On two cores a step of the surface's fit takes 100 ms in 2 parts, 127 in 3, 122 in 4 and 149 in 6, and 145
without (the teapot, `fast`): the more parts, the more threads wait for Python."""

SliceCost = Callable[[int, int, tuple[Tensor, ...], torch.Generator], tuple[Tensor, Tensor]]
"""Of places first..last, the inputs as leaves and a generator: a scalar to be minimised, summed over those places, and other sums, which get no
gradient."""


def cost_in_slices(
    count: int, inputs: tuple[Tensor, ...], cost: SliceCost, generator: torch.Generator, slices: int | None = None
) -> tuple[Tensor, Tensor]:
    """The sums of `cost` over all `count` places: the first is differentiable in `inputs`, once; the second is not.

    Args:
        generator: on the CPU; one number is drawn from it for each part. slices: None: SLICES on the CPU, else 1.
    """
    device = inputs[0].device
    edges = slice_edges(count, device, slices)
    parts = len(edges) - 1
    seeds = torch.randint(1 << 62, (parts,), generator=generator).tolist()
    done = by_pool(lambda k, _: _part(cost, edges[k], edges[k + 1], inputs, seeds[k]), range(parts + 1), device)
    gradients = tuple(torch.stack(one).sum(0) for one in zip(*(gradients for _, _, gradients in done), strict=True))
    value = torch.stack([value for value, _, _ in done]).sum(0)
    return _Known.apply(value, gradients, *inputs), torch.stack([other for _, other, _ in done]).sum(0)


def slice_edges(count: int, device: torch.device, slices: int | None = None) -> list[int]:
    """First of each part of `count` places, and the end; slices: None: SLICES on the CPU, else 1."""
    parts = slices or (SLICES if device.type == "cpu" else 1)
    return [count * k // parts for k in range(parts + 1)]


def _part(cost: SliceCost, first: int, last: int, inputs: tuple[Tensor, ...], seed: int) -> tuple[Tensor, Tensor, list[Tensor]]:
    """Both sums of some places, and the gradients of the first."""
    leaves = tuple(value.detach().requires_grad_(value.requires_grad) for value in inputs)
    with torch.enable_grad():
        value, other = cost(first, last, leaves, torch.Generator().manual_seed(seed))
    wanted = [leaf for leaf in leaves if leaf.requires_grad]
    found = iter(
        torch.autograd.grad(value, wanted, allow_unused=True, materialize_grads=True)
        if value.requires_grad
        else map(torch.zeros_like, wanted)
    )
    return value.detach(), other.detach(), [next(found) if leaf.requires_grad else torch.zeros(()) for leaf in leaves]


class _Known(torch.autograd.Function):
    """A value with gradients that are known already."""

    @staticmethod
    def forward(ctx: Any, value: Tensor, gradients: tuple[Tensor, ...], *inputs: Tensor) -> Tensor:
        ctx.gradients = gradients
        return value.clone()

    @staticmethod
    def backward(ctx: Any, *upstream: Tensor) -> tuple[Tensor | None, ...]:
        wanted = ctx.needs_input_grad[2:]
        return None, None, *(g * upstream[0] if needed else None for g, needed in zip(ctx.gradients, wanted, strict=True))
