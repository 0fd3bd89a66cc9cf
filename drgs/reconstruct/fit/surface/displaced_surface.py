"""The surface displaced along its own normals by what pixels show.

A pixel says two things of the surface: by its shade how it is turned, by which of its normals and paint the ray meets where it lies. Normals that are
fitted alone use the first, and positions that are integrated from them inherit their errors: where the surface lies beside its place, photographs
contradict even the true normals. Here both follow from positions: normals turn as those of the displaced mesh do, and a ray sees what lies where it
meets the displaced faces. What blocks light, and what mirrors meet, is taken as known between two settlings. Steps are taken in diffused offsets, so that
noise does not crumple the mesh (Nicolet et al. 2021; docs/sources.md: nicolet2021).

In: MovingSurface, its state with a parameter `offsets` (vertex,) [mean edges]. Out: positions, normals and the corners' weights of what was seen,
differentiable in the offsets; on demand the same surface, with offsets 0.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.reconstruct.capture.build_box import whole_or_within
from drgs.reconstruct.fit.adam import Adam
from drgs.reconstruct.fit.fit_loop import FitState
from drgs.reconstruct.fit.light.mesh_light import at_corners
from drgs.reconstruct.fit.surface.moving_surface import MoveSettings, MovingSurface
from drgs.reconstruct.fit.surface.shade_surface import SeenPlaces
from drgs.reconstruct.geometry.diffused import Diffusion
from drgs.reconstruct.geometry.integrate_normals import unfolded
from drgs.scene.mesh import vertex_normals

OFFSET_BETAS = (0.9, 0.99)
SELDOM = 0.3
"""Of the gradients' root mean square: what is added to a vertex' own."""
DIFFUSION = 1.0
"""Strength by which offsets are spread over neighbours; 0.3 is noisier, with 3 and more creases are slow to come (decisions/0003)."""
STEEP = 0.1
"""Least cosine between face and ray of a place whose parallax counts."""


class DisplacedSurface:
    """Final. The surface of a fit, displaced."""

    def __init__(self, surface: MovingSurface, state: FitState, moves: MoveSettings | None = None) -> None:
        """
        Args:
            moves: which parts stay how thick, and the box that the surface does not leave.
        """
        self._surface, self._state, self._moves = surface, state, moves or MoveSettings()
        self._diffusion = Diffusion(surface.edges, len(state.parameters["vertices"]), DIFFUSION)
        self._begin()

    def _begin(self) -> None:
        vertices = self._state.parameters["vertices"]
        self._own = vertex_normals(vertices, self._surface.faces)
        start, end = vertices[self._surface.edges.vertices].unbind(1)
        self._edge = (start - end).norm(dim=1).mean()

    def positions(self) -> Float[Tensor, "vertex 3"]:
        """Differentiable in the offsets."""
        step = self._edge * self._diffusion(self._state.parameters["offsets"])
        return self._state.parameters["vertices"] + step[:, None] * self._own

    def normals(self, positions: Float[Tensor, "vertex 3"]) -> Float[Tensor, "vertex 3"]:
        """Those of the fit, turned as the surface's own turn with it; differentiable in both."""
        own = vertex_normals(positions, self._surface.faces)
        normals = torch.nn.functional.normalize(self._state.parameters["normals"], dim=-1)
        return torch.nn.functional.normalize(normals + own - self._own, dim=-1)

    @torch.no_grad()
    def damp_steps(self, optimizer: Adam) -> None:
        """Between gradients and the step by them: what few pixels see would else go as far as what many do, by noise."""
        group = next(group for group in optimizer.param_groups if group["name"] == "offsets")
        group["betas"] = OFFSET_BETAS
        offsets = self._state.parameters["offsets"]
        if offsets.grad is None:  # nothing was seen
            return
        state, beta = optimizer.state.get(offsets, {}), OFFSET_BETAS[1]
        count = float(state["step"]) + 1 if state else 1.0
        squares = (1 - beta) * offsets.grad.square().mean() + (beta * state["exp_avg_sq"].mean() if state else 0.0)
        group["eps"] = SELDOM * math.sqrt(float(squares) / (1 - beta**count)) + 1e-30

    @torch.no_grad()
    def settle(self) -> None:
        """The displaced surface becomes the fit's, with offsets 0. Faces do not turn over, and thin parts not inside out."""
        parameters = self._state.parameters
        vertices, offsets = parameters["vertices"], parameters["offsets"]
        step = self._surface.behind(self._moves).kept_apart(self._edge * self._diffusion(offsets))
        moved = vertices + unfolded(vertices, self._own, step, self._surface.faces, self._surface.edges)[:, None] * self._own
        moved = whole_or_within(self._moves.box, moved)
        parameters["normals"].copy_(self.normals(moved))
        for place in (parameters["homeward"], parameters["to_texture"]):
            place += vertices - moved
        vertices.copy_(moved)
        offsets.zero_()
        self._surface.follow()
        self._begin()


def weights_where_seen(
    seen: SeenPlaces, before: Float[Tensor, "vertex 3"], positions: Float[Tensor, "vertex 3"]
) -> Float[Tensor, "place 3"]:
    """Of the corners where the rays that saw places on the mesh `before` meet the planes of the same faces at `positions`; differentiable in these.

    Faces that a ray meets at a grazing angle keep their weights: there a hair's breadth moves them by whole faces.
    """
    origin = at_corners(before, seen.corners, seen.weights).detach()
    a, b, c = positions.index_select(0, seen.corners.reshape(-1)).view(*seen.corners.shape, 3).unbind(1)
    first, second, direction = b - a, c - a, -seen.wo
    across = torch.linalg.cross(first, second)
    facing = (across * direction).sum(-1)
    steep = facing.detach().abs() > STEEP * across.detach().norm(dim=-1)
    inverse = 1 / torch.where(steep, facing, 1.0)
    away = torch.linalg.cross(origin - a, direction)
    by_second, by_third = -(second * away).sum(-1) * inverse, (first * away).sum(-1) * inverse
    weights = torch.stack([1 - by_second - by_third, by_second, by_third], -1)
    return torch.where(steep[:, None], weights, seen.weights)
