"""Motion of particles, passed on to points near them: weights of moving least squares built once at rest, one gather a frame.

In: particles X at rest, points Y (surfel centres, mesh vertices); each frame the particles' positions x and total deformation
gradients F_k. Out: y and F of every point. Quadratic maps are reproduced where the neighbourhood has full rank, affine maps and rigid
motions in any. Knows nothing of what moved the particles. Twin: drgs/reference/gmls.py. The paper's Algorithm 3 is a variant; see
docs/sources.md (drgs2026) and docs/decisions for where it goes wrong.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from numpy import ndarray
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.maths.constants import UNBOUNDED
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

LARGEST_SUM = 4.0
"""Of |psi|: where weights of both signs exceed it, as for points far off a nearly flat neighbourhood, the ridge grows until they do not."""
PAPER_EPSILON = 1e-6
"""The ridge of Algorithm 3, which the paper does not give."""

Motion = wp.types.vector(length=12, dtype=wp.float32)
"""What one particle tells: a displacement, and a 3x3 matrix by rows."""


@dataclass(frozen=True)
class GmlsSettings:
    neighbours: int = 16
    reach: float = 1.25
    """Radius of the weights [distances of the last neighbour]."""
    ridge: float = 1e-6
    """Added to the second moments, which are in units of the last neighbour's distance."""
    isolated: float = float("inf")
    """Points farther than this from every particle move rigidly with the nearest [world units]; 3 grid cells is a good value."""
    variant: Literal["taylor", "paper", "paper_centred"] = "taylor"
    """taylor: ours. paper: Algorithm 3 as printed, which evaluates its basis at the world's origin; paper_centred: at the point."""
    order: Literal[1, 2] = 1
    """Of the paper's basis."""


@dataclass(frozen=True, eq=False)
class Weights:
    """Everything about a set of points that does not change while they move."""

    neighbours: Int[Tensor, "point k"]
    """int32"""
    psi: Float[Tensor, "point k"]
    """Sums to 1 (not in the paper's variants)."""
    shepard: Float[Tensor, "point k"]
    """Not negative, sums to 1: what is used instead where psi would turn a point inside out."""
    lever: Float[Tensor, "point 3"]
    """Half of Y + r, from the origin."""
    points: Float[Tensor, "point 3"]
    """Y in float32, world units."""
    rigid: Bool[Tensor, "point"]
    """Moves rigidly with its first neighbour."""
    particles: Float[Tensor, "particle 3"]
    """X in float32, world units."""
    origin: Float[Tensor, "3"]
    """float64: levers and particles count from here, so that distance from the world's origin costs no digits."""
    variant: str


@wp.kernel
def mark_still(
    first: int,
    motion: wp.array[Motion],
    # outputs
    still: wp.array[wp.bool],
):
    i = first + wp.tid()
    largest = float(0.0)
    for k in range(12):
        if motion[i][k] != 0.0:  # NaN is no rest
            largest = 1.0
    still[i] = largest == 0.0


@wp.kernel
def gather_motion(
    first: int,
    motion: wp.array[Motion],
    still: wp.array[wp.bool],
    neighbours: wp.array2d[wp.int32],
    psi: wp.array2d[float],
    lever: wp.array[wp.vec3],
    base: wp.array[wp.vec3],
    diagonal: float,
    # outputs
    position: wp.array[wp.vec3],
    gradient: wp.array[wp.mat33],
    volume: wp.array[float],
):
    i = first + wp.tid()
    # Among particles that are where they were, with F = I, nothing is to be summed: zeros would be.
    moves = wp.bool(False)
    for k in range(neighbours.shape[1]):
        moves = moves or not still[neighbours[i, k]]
    if not moves:
        position[i] = base[i]
        gradient[i] = diagonal * wp.identity(n=3, dtype=float)
        volume[i] = diagonal
        return
    total = Motion()
    for k in range(neighbours.shape[1]):
        total += psi[i, k] * motion[neighbours[i, k]]
    matrix = wp.mat33(total[3], total[4], total[5], total[6], total[7], total[8], total[9], total[10], total[11])
    position[i] = base[i] + wp.vec3(total[0], total[1], total[2]) + matrix * lever[i]
    whole = matrix + diagonal * wp.identity(n=3, dtype=float)
    gradient[i] = whole
    volume[i] = wp.determinant(whole)


@wp.kernel
def test_segments(
    first: int,
    mesh: wp.uint64,
    particles: wp.array[wp.vec3],
    points: wp.array[wp.vec3],
    neighbours: wp.array2d[wp.int32],
    inset: float,
    # outputs
    blocked: wp.array2d[wp.int32],
):
    """Whether the surface lies between a point, drawn `inset` into the solid, and each neighbour."""
    i = first + wp.tid()
    target = points[i]
    query = wp.mesh_query_point_no_sign(mesh, target, UNBOUNDED)
    if query.result:
        inner = wp.mesh_eval_position(mesh, query.face, query.u, query.v) - inset * wp.mesh_eval_face_normal(mesh, query.face)
        if wp.length(inner - target) < 4.0 * inset:
            target = inner
    for k in range(neighbours.shape[1]):
        start = particles[neighbours[i, k]]
        way = target - start
        length = wp.length(way)
        blocked[i, k] = 0
        # What lies within an inset of its target cannot be separated from it.
        if length > inset and wp.mesh_query_ray_anyhit(mesh, start, way / length, length):
            blocked[i, k] = 1


def build_weights(
    particles: Float[Tensor, "particle 3"],
    points: Float[Tensor, "point 3"],
    settings: GmlsSettings | None = None,
    solid: tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]] | None = None,
) -> Weights:
    """Weights that carry points (point, 3) with particles (particle, 3), both at rest.

    Args:
        solid: vertices and faces of the mesh around the particles: a neighbour on the other side of a gap (leg and body) is left out.

    Raises:
        ValueError: no particles.
    """
    settings = settings or GmlsSettings()
    if not len(particles):
        raise ValueError("cannot carry points with no particles")
    device = particles.device
    exact = particles.detach().double().cpu()
    origin = exact.mean(0)
    rest, where = (exact - origin).numpy(), (points.detach().double().cpu() - origin).numpy()
    k = min(settings.neighbours, len(rest))
    distance, index = cKDTree(rest).query(where, k=k, workers=-1)
    distance, index = distance.reshape(len(where), k), index.reshape(len(where), k)
    free = np.ones_like(index, dtype=bool) if solid is None else ~_blocked(particles, points, index, distance, solid)
    free[~free.any(1)] = True  # a point that no particle sees follows its nearest ones all the same
    offsets = rest[index] - where[:, None]
    if settings.variant == "taylor":
        psi, shepard = _taylor_weights(offsets, distance, free, settings)
        nearest = np.argmax(free, 1)  # neighbours come in order of distance
        rigid = distance[np.arange(len(where)), nearest] > settings.isolated
        psi[rigid] = 0
        psi[rigid, nearest[rigid]] = 1
        shepard[rigid] = psi[rigid]
        residual = -(psi[..., None] * offsets).sum(1)
        lever = (where + residual) / 2
        # The neighbour that rigid points follow comes first.
        rows = np.arange(len(where))
        for array in (index, psi, shepard):
            array[rows, 0], array[rows, nearest] = array[rows, nearest].copy(), array[rows, 0].copy()
    else:
        basis_points = rest[index] + origin.numpy() if settings.variant == "paper" else offsets
        psi = _paper_weights(basis_points, distance, settings.order)
        shepard, lever, rigid = np.full_like(psi, 1 / k), np.zeros_like(where), np.zeros(len(where), dtype=bool)

    def tensor(array: np.ndarray, dtype: torch.dtype) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(device, dtype).contiguous()

    return Weights(
        tensor(index, torch.int32), tensor(psi, torch.float32), tensor(shepard, torch.float32), tensor(lever, torch.float32),
        points.detach().float().contiguous(), tensor(rigid, torch.bool), particles.detach().float().contiguous(), origin.to(device),
        settings.variant,
    )  # fmt: skip


def interpolate(
    weights: Weights, moved: Float[Tensor, "particle 3"], gradients: Float[Tensor, "particle 3 3"]
) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 3 3"]]:
    """Positions (point, 3) and deformation gradients (point, 3, 3) from those of the particles, (particle, 3) and (particle, 3, 3)."""
    if weights.variant != "taylor":
        return _gather(_Rows(weights.neighbours, weights.psi, weights.lever, torch.zeros_like(weights.points)), moved, gradients, 0.0)[:2]
    identity = torch.eye(3, device=moved.device)
    excess = gradients - identity
    local = (weights.particles.double() - weights.origin).float()
    shift = (moved - weights.particles) - 0.5 * (excess @ local[..., None])[..., 0]
    position, gradient, volume = _gather(_Rows(weights.neighbours, weights.psi, weights.lever, weights.points), shift, excess, 1.0)
    # Possibly the weights of both signs turned a point inside out; then use those of one sign, then the nearest particle's rotation.
    folded, rigid = volume <= 0, weights.rigid
    if bool(folded.any()):
        rows = _Rows(weights.neighbours[folded], weights.shepard[folded], weights.lever[folded].contiguous(), weights.points[folded])
        again, matrix, volume = _gather(rows, shift, excess, 1.0)
        # Shepard's weights leave another residual, which `lever` does not know.
        base = _residual(weights, folded)
        position[folded] = again + 0.5 * ((matrix - identity) @ base[..., None])[..., 0]
        gradient[folded] = matrix
        rigid = rigid.clone()
        rigid[folded] |= volume <= 0
    if bool(rigid.any()):
        nearest = weights.neighbours[rigid, 0].long()
        rotation = polar_rotation(gradients[nearest])
        arm = weights.points[rigid] - weights.particles[nearest]
        position[rigid] = moved[nearest] + (rotation @ arm[..., None])[..., 0]
        gradient[rigid] = rotation
    return position, gradient


def polar_rotation(gradient: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """(n, 3, 3) the rotations nearest to matrices (n, 3, 3), det +1 always."""
    u, _, vt = torch.linalg.svd(gradient.double())
    flip = torch.ones_like(u[:, 0])
    flip[:, 2] = torch.sign(torch.linalg.det(u @ vt))
    return ((u * flip[:, None]) @ vt).to(gradient.dtype)


@dataclass(frozen=True, eq=False)
class _Rows:
    """What `_gather` reads of some points; see Weights."""

    neighbours: Int[Tensor, "point k"]
    psi: Float[Tensor, "point k"]
    """psi, or Shepard's weights."""
    lever: Float[Tensor, "point 3"]
    base: Float[Tensor, "point 3"]
    """Where displacements count from."""


def _gather(
    rows: _Rows, shift: Float[Tensor, "particle 3"], matrix: Float[Tensor, "particle 3 3"], diagonal: float
) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 3 3"], Float[Tensor, "point"]]:
    """Positions (point, 3), gradients (point, 3, 3) and their determinants (point,)."""
    base = rows.base
    motion = torch.cat([shift, matrix.reshape(-1, 9)], 1).float().contiguous()
    still = torch.empty(len(motion), dtype=torch.bool, device=base.device)
    launch(mark_still, len(motion), [wp.from_torch(motion, dtype=Motion)], [warp_array(still)], warp_device(base), 1)
    position = torch.empty_like(base)
    gradient = torch.empty(len(base), 3, 3, device=base.device)
    inputs = [
        wp.from_torch(motion, dtype=Motion), warp_array(still), warp_array(rows.neighbours), warp_array(rows.psi), warp_array(rows.lever, wp.vec3),
        warp_array(base, wp.vec3), diagonal,
    ]  # fmt: skip
    volume = torch.empty(len(base), device=base.device)
    outputs = [warp_array(position, wp.vec3), warp_array(gradient, wp.mat33), warp_array(volume)]
    launch(gather_motion, len(base), inputs, outputs, warp_device(base), 1)
    return position, gradient, volume


def _residual(weights: Weights, chosen: Bool[Tensor, "point"]) -> Float[Tensor, "chosen 3"]:
    """(chosen, 3): how much Shepard's sum of positions misses its point by more than psi's does."""
    near = weights.particles[weights.neighbours[chosen].long()]
    return ((weights.psi - weights.shepard)[chosen][..., None] * (near - weights.points[chosen][:, None])).sum(1)


def _blocked(
    particles: Float[Tensor, "particle 3"],
    points: Float[Tensor, "point 3"],
    index: Int[ndarray, "point k"],
    distance: Float[ndarray, "point k"],
    solid: tuple[Float[Tensor, "vertex 3"], Int[Tensor, "face 3"]],
) -> Bool[ndarray, "point k"]:
    vertices, faces = solid
    tree = wp.Mesh(warp_array(vertices.float(), wp.vec3), warp_array(faces.to(torch.int32).reshape(-1)))
    neighbours = torch.from_numpy(index.astype(np.int32)).to(particles.device)
    blocked = torch.zeros_like(neighbours)
    inset = 0.1 * float(np.median(distance[:, -1]))
    inputs = [
        tree.id, warp_array(particles.float(), wp.vec3), warp_array(points.float(), wp.vec3), warp_array(neighbours), inset,
    ]  # fmt: skip
    launch(test_segments, len(points), inputs, [warp_array(blocked)], warp_device(particles))
    return blocked.cpu().numpy().astype(bool)


def _taylor_weights(
    offsets: Float[ndarray, "point k 3"], distance: Float[ndarray, "point k"], free: Bool[ndarray, "point k"], settings: GmlsSettings
) -> tuple[Float[ndarray, "point k"], Float[ndarray, "point k"]]:
    """psi and Shepard's weights (point, k), in float64."""
    h = np.maximum(distance[:, -1], np.finfo(np.float64).tiny)
    w = np.clip(1 - (distance / (settings.reach * h)[:, None]) ** 2, 0, None) ** 4 * free
    # All at one distance, reach 1: nothing would be left.
    w = np.where(w.sum(1, keepdims=True) > 1e-12, w, free)
    w /= w.sum(1, keepdims=True)
    p = np.concatenate([np.ones_like(distance)[..., None], offsets / h[:, None, None]], -1)
    moments = np.einsum("mk,mki,mkj->mij", w, p, p)
    first = np.zeros((len(w), 4, 1))
    first[:, 0] = 1

    def solve(rows: np.ndarray, ridge: float) -> np.ndarray:
        matrix = moments[rows] + np.diag([0, ridge, ridge, ridge])
        return w[rows] * (p[rows] @ np.linalg.solve(matrix, first[rows]))[..., 0]

    psi = solve(np.arange(len(w)), settings.ridge)
    ridge = settings.ridge
    while ridge < 1:
        wild = np.flatnonzero(np.abs(psi).sum(1) > LARGEST_SUM)
        if not len(wild):
            break
        ridge *= 10
        psi[wild] = solve(wild, ridge)
    return psi, w


def _paper_weights(points: Float[ndarray, "point k 3"], distance: Float[ndarray, "point k"], order: int) -> Float[ndarray, "point k"]:
    """psi_k = W_k Phi_k A^-1 Phi(0) of Algorithm 3, (point, k), from X_k or X_k - Y (point, k, 3)."""
    sigma = np.maximum(distance.mean(1, keepdims=True), np.finfo(np.float64).tiny)
    w = np.exp(-((distance / sigma) ** 2))
    x, y, z = np.moveaxis(points, -1, 0)
    columns = [np.ones_like(x), x, y, z]
    if order == 2:  # eight terms, as printed: the squares appear only as their sum
        columns += [x * y, y * z, x * z, x * x + y * y + z * z]
    phi = np.stack(columns, -1)
    matrix = np.einsum("mk,mki,mkj->mij", w, phi, phi) + PAPER_EPSILON * np.eye(len(columns))
    at_zero = np.zeros((len(w), len(columns), 1))
    at_zero[:, 0] = 1
    return w * (phi @ np.linalg.solve(matrix, at_zero))[..., 0]
