"""Where matter has come apart: which faces of the mesh would span a gap, and which particles are seen as grains of their own instead.

In: matter and the mesh around it at rest, once; then where the particles are, frame by frame. Out: Parted, or None while everything hangs
together. A particle that is no longer near enough of those that it was among at rest is loose; the faces over it are cut, and what lay under cut
faces is shown. So each frame follows from its own positions alone, and rigid motion cuts nothing. Knows nothing of pictures (show_grains.py).
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.deform.clip import Parted
from drgs.deform.matter.mpm.records import LAWS, Model
from drgs.maths.unique_rows import unique_rows

MOST_GRAINS = 50_000
"""Of a frame. With more particles every second, third, ... stands for its neighbours, and is as large as they together."""
MOST_GRAINS_A_PARTICLE = 8
"""With fewer particles each is several grains, so that a thin layer of them shows no lattice."""
LEAST_SHARE, MOST_SHARE = 0.15, 0.5
"""How far along a bond a grain lies, so that grains fill what opens between particles [of the bond]."""
MOST_SHIFT = 1.0
"""How far a grain is from its particle at most, wherever its neighbour has gone [spacings]."""
GOLDEN = (math.sqrt(5) - 1) / 2
"""Its multiples spread evenly over 0..1, whatever their number."""
NEIGHBOURS = 18
BOND_SPACINGS = 1.75
"""Particles are bound to those of their neighbours that are nearer than this at rest [spacings]: beside and across, on a jittered lattice."""
LOOSE_SHARE = 0.15
"""A particle of whose bonds this share has parted is loose. Beside a plane that matter parts along it loses 5 of 18; jitter makes them 3 for one in fifty."""
SURROUNDED_SHARE = 0.5
"""A particle of whose bonds this share leads to loose ones is loose as well, so that no scraps of the mesh are left among grains. Beside a plane it has 5 of 18."""
SURROUNDED_ROUNDS = 3
"""How often that is asked: scraps as wide as so many particles on either side go."""
PARTED_CELLS = 1.5
"""Bonds have parted when they are longer than at rest by this [grid cells]: as far as a particle's quadratic spline reaches."""
CRUMBLED_CELLS = 0.4
"""The same of sand and snow, which do not stretch: most of a spacing, by which particles roll off one another."""
CRUMBLING = ("drucker_prager", "snow")
FLOWING = ("fluid",)
"""Never parts: neighbours in a fluid wander apart while it stays whole."""
MOST_SAMPLES_A_SIDE = 64
"""Of a face, in looking which particles lie under it."""


@dataclass(frozen=True, eq=False)
class Bonds:
    """Which matter hangs together at rest, and what of the mesh lies over it."""

    particle: Int[Tensor, "chosen"]
    """Numbers of those that matter is looked at by; not of particles that only follow."""
    towards: Int[Tensor, "chosen piece"]
    """The neighbour that each of its grains lies towards, a place in `particle`."""
    share: Float[Tensor, "chosen piece"]
    """How far, of the way to it."""
    most_shift: float
    """World units."""
    volumes: Float[Tensor, "grain"]
    """World units cubed; grains of one particle follow each other."""
    vertex: Int[Tensor, "grain"]
    """The mesh's nearest vertex, whose material the grain has."""
    neighbours: Int[Tensor, "chosen k"]
    """Places in `particle`, as all below."""
    rest_length: Float[Tensor, "chosen k"]
    bound: Bool[Tensor, "chosen k"]
    reach: Float[Tensor, "chosen"]
    """How much longer than at rest a bond may be [world units]; infinite in what flows."""
    face: Int[Tensor, "cover"]
    under: Int[Tensor, "cover"]
    """Pairs of a face and a particle under it, each once."""
    deep: Bool[Tensor, "chosen"]
    """Under no face."""
    over: Int[Tensor, "vertex"]
    """The particle under each vertex of the mesh."""
    over_length: Float[Tensor, "vertex"]
    """How far it is at rest [world units]."""
    corners: Int[Tensor, "face 3"]
    edge_length: Float[Tensor, "face 3"]
    """At rest [world units]."""
    edge_reach: Float[Tensor, "face 3"]
    """How much longer than at rest an edge may be [world units]; of wide faces as many times more as they are spacings wide."""
    under_surfel: Int[Tensor, "surfel"] | None
    """The particle under each surfel; None for an asset without."""


def bonds_at_rest(
    model: Model,
    interior: int,
    vertices: Float[Tensor, "vertex 3"],
    faces: Int[Tensor, "face 3"],
    centers: Float[Tensor, "surfel 3"] | None,
) -> Bonds:
    """What hangs together before anything moves.

    Args:
        interior: how many of the model's first particles are matter; those behind them only follow.
        vertices, centers: of the mesh and of the surfels, where the model's particles are.
    """
    every = math.ceil(interior / MOST_GRAINS)
    particle = torch.arange(0, interior, every, device=vertices.device)
    pieces = max(1, min(MOST_GRAINS // len(particle), MOST_GRAINS_A_PARTICLE))
    volumes = model.volumes[particle] * (interior / len(particle))
    spacing = float(volumes.double().mean()) ** (1 / 3)
    rest = model.rest[particle]
    places = rest.double().cpu().numpy()
    tree, count = cKDTree(places), min(NEIGHBOURS + 1, len(places))
    length, index = (values.reshape(len(places), count)[:, 1:] for values in tree.query(places, k=count))
    towards, share = (values.to(vertices.device) for values in _grains_on_bonds(index, pieces))
    face, under = _covers(tree, vertices.double().cpu().numpy(), faces.long().cpu().numpy(), spacing)
    _, vertex = cKDTree(vertices.double().cpu().numpy()).query(
        _grain_places(rest, towards, share, MOST_SHIFT * spacing).reshape(-1, 3).double().cpu().numpy()
    )
    over_length, over = tree.query(vertices.double().cpu().numpy())
    edges = _edge_lengths(vertices, faces.long())
    surfel = None if centers is None else tree.query(centers.double().cpu().numpy())[1]
    laws, cell = model.laws[particle].long().cpu(), max(model.grid.dx, 2 * spacing)
    reach = torch.tensor([_cells(law) * cell for law in LAWS])[laws]

    reach = reach.to(vertices.device)
    wide = (edges / spacing).clamp(min=1)
    edge_reach = reach[torch.from_numpy(over).to(vertices.device)[faces[:, 0].long()], None] * wide

    def tensor(array: NDArray) -> Tensor:
        return torch.from_numpy(np.ascontiguousarray(array)).to(vertices.device)

    return Bonds(
        particle, towards, share, MOST_SHIFT * spacing, (volumes / share.shape[1]).repeat_interleave(share.shape[1]), tensor(vertex), tensor(index), tensor(length).float(), tensor(length < BOND_SPACINGS * spacing),
        reach, tensor(face), tensor(under), tensor(np.bincount(under, minlength=len(places)) == 0), tensor(over), tensor(over_length).float(), faces.long(), edges, edge_reach, None if surfel is None else tensor(surfel),
    )  # fmt: skip


def part_matter(
    bonds: Bonds, positions: Float[Tensor, "particle 3"], vertices: Float[Tensor, "vertex 3"], origin: Float[Tensor, "3"]
) -> Parted | None:
    """What has come apart where particles are at (particle, 3) and have carried the mesh to (vertex, 3); None where nothing has.

    Args:
        origin: (3,) of the positions, in the world.
    """
    places = positions[bonds.particle]
    length = (places[bonds.neighbours] - places[:, None]).norm(dim=-1)
    parted = bonds.bound & (length - bonds.rest_length > bonds.reach[:, None])
    loose = parted.any(1) & (parted.sum(1) >= LOOSE_SHARE * bonds.bound.sum(1))
    # What follows the surface without weight can hang between two halves, and the mesh with it.
    left = (vertices - places[bonds.over]).norm(dim=-1) - bonds.over_length > bonds.reach[bonds.over]
    torn = left[bonds.corners].any(1) | (_edge_lengths(vertices, bonds.corners) - bonds.edge_length > bonds.edge_reach).any(1)
    if not bool(loose.any()) and not bool(torn.any()):
        return None
    for _ in range(SURROUNDED_ROUNDS):
        around = (bonds.bound & loose[bonds.neighbours]).sum(1)
        loose = loose | ((around > 0) & (around >= SURROUNDED_SHARE * bonds.bound.sum(1)))
    cut = torn.clone()
    cut[bonds.face[loose[bonds.under]]] = True
    shown = loose.clone()
    shown[bonds.under[cut[bonds.face]]] = True
    # Through the holes one sees what lies deeper; what lies under faces would come out through those that are left.
    shown |= bonds.deep & (bonds.bound & shown[bonds.neighbours]).any(1)
    grains = _grain_places(places, bonds.towards, bonds.share, bonds.most_shift).reshape(-1, 3)
    centers = (grains.double() + origin.to(places.device)).float()
    gone = None if bonds.under_surfel is None else shown[bonds.under_surfel]
    return Parted(centers, bonds.volumes, bonds.vertex, shown.repeat_interleave(bonds.share.shape[1]), cut, gone)


def _cells(law: str) -> float:
    if law in FLOWING:
        return math.inf
    return CRUMBLED_CELLS if law in CRUMBLING else PARTED_CELLS


def _grains_on_bonds(neighbours: NDArray, pieces: int) -> tuple[Int[Tensor, "chosen piece"], Float[Tensor, "chosen piece"]]:
    """`towards` and `share` of Bonds: every grain of a particle towards another neighbour (chosen, k); the only one is where the particle is."""
    own, count = torch.arange(len(neighbours))[:, None], neighbours.shape[1]
    if pieces == 1 or not count:
        return own, torch.zeros(len(neighbours), 1)
    piece = torch.arange(pieces)[None]
    share = (GOLDEN * (own * pieces + piece).double()).frac()
    towards = torch.from_numpy(neighbours)[own, (own + piece * count // pieces) % count]
    return towards, (LEAST_SHARE + (MOST_SHARE - LEAST_SHARE) * share).float()


def _grain_places(
    particles: Float[Tensor, "chosen 3"], towards: Int[Tensor, "chosen piece"], share: Float[Tensor, "chosen piece"], most_shift: float
) -> Float[Tensor, "chosen piece 3"]:
    """Where grains are, for particles at (chosen, 3)."""
    shift = share[..., None] * (particles[towards] - particles[:, None])
    return particles[:, None] + shift * (most_shift / shift.norm(dim=-1, keepdim=True).clamp(min=most_shift))


def _edge_lengths(vertices: Float[Tensor, "vertex 3"], corners: Int[Tensor, "face 3"]) -> Float[Tensor, "face 3"]:
    placed = vertices[corners]
    return (placed - placed.roll(1, 1)).norm(dim=-1)


def _covers(tree: cKDTree, vertices: NDArray, faces: NDArray, spacing: float) -> tuple[NDArray, NDArray]:
    """Pairs of a face and a particle that is nearest to one of its corners or, where it is wide, to a point on it every spacing."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=-1).max(1, initial=0)
    sides = np.clip(np.ceil(longest / spacing), 1, MOST_SAMPLES_A_SIDE).astype(int)
    pairs = []
    for side in np.unique(sides):
        chosen = np.flatnonzero(sides == side)
        if side == 1:
            # Corners are shared: asked about once each, not once a face.
            own = tree.query(vertices)[1][faces[chosen]]
        else:
            steps = np.array([(i, j, side - i - j) for i in range(side + 1) for j in range(side + 1 - i)]) / side
            own = tree.query(np.einsum("sc,fcx->fsx", steps, corners[chosen]))[1]
        pairs.append(np.stack([np.broadcast_to(chosen[:, None], own.shape), own], -1).reshape(-1, 2))
    found = unique_rows(torch.from_numpy(np.concatenate(pairs)))[0].numpy() if pairs else np.zeros((0, 2), np.int64)
    return found[:, 0], found[:, 1]
