"""Positions from normals: the mesh is moved until its edges lie across the normals that shading found, and its outlines on the masks'.

Each vertex moves along its own normal by s, which minimises

    sum_edges w_e ((x_i - x_j) . n_e / |x_i - x_j| - a_e)^2  +  w_outline sum_outlines w_o l_o d_o(x)^2  +  anchor sum_vertices (s / mean edge)^2
    +  even sum_edges ((s_i - s_j) / |x_i - x_j|)^2  +  home sum_vertices w_h ((s - h) / mean edge)^2
    +  texture sum_vertices w_t ((s - t) / mean edge)^2

with n_e the mean of the wanted normals at the edge's ends, a_e how far the edge leans now, by the mean of the surface's own normals there, d_o the
outlines' distances in pixels, h how far behind or before the vertex its home lies and t how far its texture (matched_texture), by a sparse linear
solve in float64. So a surface that has the normals which are wanted stays as it is, creases and all: without a_e each solve rounds a crease by an
edge, as no edge that leads into it lies across the mean of the normals at its ends (decisions/0003, "Moves that round nothing"). Homes matter where
nothing else says how deep a place is: a floor within a rim may sink as a whole without turning any normal, and does so solve by solve if each
starts from where the one before ended.
Weights are robust (Cauchy's), so that normals that no surface has and wrong outlines do not pull their surroundings along.
Source: Nehab et al. 2005 (positions from normals), with outlines in place of measured depths (docs/sources.md: nehab2005).
"""

from dataclasses import dataclass
from itertools import combinations

import torch
from jaxtyping import Float64, Int
from torch import Tensor

from drgs.reconstruct.geometry.mask_outlines import OutlineResiduals
from drgs.reconstruct.geometry.mesh_edges import MeshEdges
from drgs.reconstruct.geometry.symmetric_systems import SymmetricPlaces, solved
from drgs.reconstruct.geometry.thickness import OtherSide
from drgs.scene.mesh import vertex_normals

TURNED = 0.3
"""Cosine between a face's normals before and after a solve below which it has turned over, or nearly."""
UNFOLDINGS = 8


@dataclass(frozen=True)
class IntegrationSettings:
    """How much each part counts."""

    outline_weight: float = 0.2
    """Of a pixel of outline, squared, against an edge across its normal by a radian."""
    anchor: float = 1e-3
    """Of a mean edge's length moved."""
    home: float = 1e-3
    """Of a mean edge's length away from home."""
    texture: float = 0.5
    """Of a mean edge's length away from where texture lies. With 0.02 outlines of masks that were drawn too wide hold the tankard's walls where they
    are; with 0.5 half of what texture says is left of it after a pass."""
    even: float = 0.005
    """Of a difference between neighbours' moves, as an edge's tilt: keeps slivers, which hardly know their normal, with their surroundings."""
    crease_angle: float = 0.2
    """[radians] by which an edge is to tilt, at which its weight is halved."""
    outline_outlier: float = 1.0
    """[pixels] at which an outline's weight is halved."""
    reweightings: int = 3
    longest_move: float = 2.0
    """Mean edges at a vertex that it may move in one solve: what wants to go farther is badly determined."""


@dataclass(frozen=True, eq=False)
class Places:
    """Where vertices should lie: where a surface that moves in many solves began, or where its texture was found."""

    towards: Tensor
    """(vertex, 3) from each vertex to its place."""
    weight: Tensor
    """(vertex,) 0..1: how much each is held."""


def integrate_normals(
    vertices: Tensor,
    faces: Tensor,
    wanted_normals: Tensor,
    edges: MeshEdges,
    outlines: OutlineResiduals,
    settings: IntegrationSettings,
    homes: Places | None = None,
    texture: Places | None = None,
    behind: OtherSide | None = None,
) -> Tensor:
    """(vertex, 3) positions after one solve.

    Args:
        vertices: (vertex, 3). faces: (face, 3). wanted_normals: (vertex, 3) unit. outlines: of these vertices.
        homes, texture: None: there are none. behind: which no vertex comes nearer to than it allows; None: none is held off.
    """
    direction = vertex_normals(vertices, faces)
    start, end = edges.vertices.unbind(1)
    normal = torch.nn.functional.normalize(wanted_normals[start] + wanted_normals[end], dim=-1)
    across = vertices[start] - vertices[end]
    length = across.norm(dim=1).clamp(min=1e-30)
    own = torch.nn.functional.normalize(direction[start] + direction[end], dim=-1)
    tilt = (across * (normal - own)).sum(1) / length
    by_start, by_end = (direction[start] * normal).sum(1) / length, -(direction[end] * normal).sum(1) / length
    by_corners = outlines.weights * (outlines.gradient[:, None] * direction[outlines.corners]).sum(-1)

    count, edge2 = len(vertices), float(length.mean()) ** 2
    held, pull = torch.full((count,), settings.anchor / edge2, dtype=torch.float64), torch.zeros(count, dtype=torch.float64)
    reach = settings.longest_move * _mean_of_edges(length, edges, count)
    for places, strength in ((homes, settings.home), (texture, settings.texture)):
        if places is not None:
            hold = strength / edge2 * _on_cpu(places.weight)
            away = (places.towards * direction).sum(1)
            if places is texture:
                away = torch.maximum(torch.minimum(away, reach), -reach)
            held, pull = held + hold, pull + hold * _on_cpu(away)
    even = settings.even / _on_cpu(length) ** 2
    for corner in edges.vertices.cpu().unbind(1):
        held.index_add_(0, corner, even)
    tilts = _Residuals(edges.vertices.cpu(), _on_cpu(torch.stack([by_start, by_end], 1)), _on_cpu(tilt))
    leaps = _Residuals(outlines.corners.cpu(), _on_cpu(by_corners), _on_cpu(outlines.distance))
    pattern = SymmetricPlaces.of(torch.cat([tilts.pairs, leaps.pairs]), count)
    outline_length = settings.outline_weight * _on_cpu(outlines.length)
    moved = torch.zeros_like(held)
    for _ in range(settings.reweightings):
        diagonal, right_side, beside = held.clone(), pull.clone(), []
        weights = (
            1 / (1 + (tilts.after(moved) / settings.crease_angle) ** 2),
            outline_length / (1 + (leaps.after(moved) / settings.outline_outlier) ** 2),
        )
        for residuals, weight in zip((tilts, leaps), weights, strict=True):
            residuals.add_to(diagonal, right_side, weight)
            beside.append(residuals.products(weight))
        beside[0] -= even
        moved = solved(pattern.filled(torch.cat(beside)), diagonal, right_side, moved)
    step = torch.maximum(torch.minimum(moved.to(vertices), reach), -reach)
    if behind is not None:
        step = behind.kept_apart(step)
    return vertices + unfolded(vertices, direction, step, faces, edges)[:, None] * direction


@dataclass(frozen=True, eq=False)
class _Residuals:
    """What is to be 0, each a sum over a few vertices' moves."""

    corners: Int[Tensor, "residual corner"]
    by_corners: Float64[Tensor, "residual corner"]
    """Derivatives by the corners' moves."""
    now: Float64[Tensor, "residual"]
    """Without any move."""

    @property
    def _two(self) -> list[tuple[int, int]]:
        return list(combinations(range(self.corners.shape[1]), 2))

    @property
    def pairs(self) -> Int[Tensor, "pair 2"]:
        """Of different corners of one residual."""
        return torch.cat([self.corners[:, [a, b]] for a, b in self._two]).long()

    def products(self, weight: Float64[Tensor, "residual"]) -> Float64[Tensor, "pair"]:
        """Of both derivatives of each of `pairs`."""
        return torch.cat([weight * self.by_corners[:, a] * self.by_corners[:, b] for a, b in self._two])

    def after(self, moved: Float64[Tensor, "vertex"]) -> Float64[Tensor, "residual"]:
        return (self.by_corners * moved[self.corners.long()]).sum(1) + self.now

    def add_to(
        self, diagonal: Float64[Tensor, "vertex"], right_side: Float64[Tensor, "vertex"], weight: Float64[Tensor, "residual"]
    ) -> None:
        """Of the weighted squares' normal equations, what does not lie beside the diagonal."""
        for corner, derivative in zip(self.corners.long().unbind(1), self.by_corners.unbind(1), strict=True):
            diagonal.index_add_(0, corner, weight * derivative**2)
            right_side.index_add_(0, corner, -weight * derivative * self.now)


def unfolded(vertices: Tensor, direction: Tensor, step: Tensor, faces: Tensor, edges: MeshEdges) -> Tensor:
    """(vertex,) steps along the directions, but the neighbours' mean at the corners of faces that would turn over, and 0 where that does not help."""
    corners = faces.long()
    own = _face_normals(vertices, corners)
    for attempt in range(UNFOLDINGS):
        turned = (_face_normals(vertices + step[:, None] * direction, corners) * own).sum(-1) < TURNED * own.norm(dim=-1)
        if not bool(turned.any()):
            break
        folded = torch.zeros_like(step, dtype=torch.bool)
        folded[corners[turned].flatten()] = True
        around = _mean_of_neighbours(step, edges) if attempt < UNFOLDINGS // 2 else torch.zeros_like(step)
        step = torch.where(folded, around, step)
    return step


def _face_normals(vertices: Tensor, corners: Tensor) -> Tensor:
    """(face, 3) unit normals; zero where a face has no area."""
    a, b, c = vertices[corners].unbind(1)
    return torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1, eps=1e-30)


def _mean_of_edges(values: Tensor, edges: MeshEdges, count: int) -> Tensor:
    """(vertex,) mean of edge values (edge,) over a vertex's edges."""
    total, number = values.new_zeros(count), values.new_zeros(count)
    for corner in edges.vertices.unbind(1):
        total.index_add_(0, corner, values)
        number.index_add_(0, corner, torch.ones_like(values))
    return total / number.clamp(min=1)


def _mean_of_neighbours(values: Tensor, edges: MeshEdges) -> Tensor:
    """(vertex,) mean of the values (vertex,) at the other ends of a vertex's edges."""
    start, end = edges.vertices.unbind(1)
    total, number = torch.zeros_like(values), torch.zeros_like(values)
    for here, there in ((start, end), (end, start)):
        total.index_add_(0, here, values[there])
        number.index_add_(0, here, torch.ones_like(values[there]))
    return total / number.clamp(min=1)


def _on_cpu(values: Tensor) -> Float64[Tensor, "*shape"]:
    """Where systems are solved, and as exactly."""
    return values.detach().cpu().double()
