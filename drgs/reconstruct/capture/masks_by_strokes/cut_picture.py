"""Divide a picture in two along its edges, so that each side agrees with what its pixels say: a minimal cut, by its convex relaxation.

Minimises the sum of edge · |difference of neighbours| + cost · value over values 0..1, whose level set at one half is a minimal cut. In: what it costs to
call each pixel the object's, and what to part neighbours. Out: 0..1 of each pixel, nearly all at either end.
Source: Chan, Esedoglu & Nikolova 2006 (docs/sources.md: chan2006), by the steps of Chambolle & Pock 2011 (chambolle2011).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float, Float32, UInt8
from numpy import ndarray
from torch import Tensor

STEP = 0.35
"""Of values and of flows alike: its square times 8, the norm of differences in two directions, must stay below 1."""
LEAST_EDGE = 0.05
"""Of what parting equal neighbours costs, between neighbours however different: outlines through texture stay short, too."""


@dataclass(frozen=True, eq=False)
class Edges:
    """What it costs to part neighbours."""

    across: Float[Tensor, "height _less"]
    """Of each pixel and the one to its right."""
    down: Float[Tensor, "_less width"]


@dataclass(eq=False)
class Cut:
    """Where the division stands; another call goes on from it."""

    value: Float[Tensor, "height width"]
    """1: object, 0: not."""
    across: Float[Tensor, "height _less"]
    """Flow between neighbours, of at most the edges' size; this and the next."""
    down: Float[Tensor, "_less width"]


def edges_of(color_srgb: UInt8[ndarray, "height width 3"], weight: float) -> Edges:
    """Small where colours change by more than they do on average over the picture.

    Args:
        weight: of parting neighbours of one colour.
    """
    color = torch.from_numpy(color_srgb).float() / 255
    across, down = ((after - before).square().sum(-1) for after, before in ((color[:, 1:], color[:, :-1]), (color[1:], color[:-1])))
    mean = float((across.mean() + down.mean()) / 2) + 1e-6  # of a picture of one colour it is 0
    return Edges(*(weight * (LEAST_EDGE + (1 - LEAST_EDGE) * torch.exp(-change / (2 * mean))) for change in (across, down)))


def undecided(edges: Edges) -> Cut:
    """To begin with."""
    height, width = len(edges.across), edges.down.shape[1]
    return Cut(torch.full((height, width), 0.5), torch.zeros_like(edges.across), torch.zeros_like(edges.down))


def cut_picture(cut: Cut, cost: Float32[ndarray, "height width"], edges: Edges, steps: int) -> None:
    """Some steps towards the minimum, in place."""
    priced = STEP * torch.from_numpy(cost)
    value, leading = cut.value, cut.value.clone()
    for _ in range(steps):
        cut.across.add_(leading[:, 1:] - leading[:, :-1], alpha=STEP).clamp_(-edges.across, edges.across)
        cut.down.add_(leading[1:] - leading[:-1], alpha=STEP).clamp_(-edges.down, edges.down)
        moved = value - priced
        moved[:, :-1].add_(cut.across, alpha=STEP)
        moved[:, 1:].sub_(cut.across, alpha=STEP)
        moved[:-1].add_(cut.down, alpha=STEP)
        moved[1:].sub_(cut.down, alpha=STEP)
        moved.clamp_(0, 1)
        leading = 2 * moved - value
        value = moved
    cut.value = value
