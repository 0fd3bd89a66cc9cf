"""Particles sorted into blocks of 4x4x4 grid cells: the sparse grid, and the reason why threads never add to one address.

Each block that holds particles owns a tile of 8x8x8 nodes, which its particles alone write: the nodes that the quadratic B-splines of
its cells reach, and one more cell on each side, so that particles may drift by a cell before they are sorted again. Nodes exist in
the blocks around them, and gather from the tiles that cover them.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.deform.matter.mpm.records import GridSettings

BLOCK = 4
"""Nodes along a block's edge."""
TILE = BLOCK + 4
TILE_NODES = TILE**3
BLOCK_NODES = BLOCK**3
DRIFT = 0.9
"""Cells that a particle may move between sorts; beyond 1 it would leave its tile."""
WALL = 3
"""Cells between the room's wall and the end of the grid."""
MOST_BLOCKS = 1 << 27


@dataclass(frozen=True)
class Lattice:
    """The room's nodes: node n lies at origin + n dx."""

    origin: tuple[float, float, float]
    dx: float
    blocks: tuple[int, int, int]

    @property
    def nodes(self) -> tuple[int, int, int]:
        return (self.blocks[0] * BLOCK, self.blocks[1] * BLOCK, self.blocks[2] * BLOCK)


def make_lattice(settings: GridSettings) -> Lattice:
    """Nodes that cover the room and three cells more on each side.

    Raises:
        ValueError: no room, or one with too many cells.
    """
    extent = [high - low for low, high in zip(settings.minimum, settings.maximum, strict=True)]
    if not settings.dx > 0 or min(extent) <= 0:
        raise ValueError(f"the room {settings.minimum} to {settings.maximum} with cells of {settings.dx} holds nothing")
    blocks = tuple(-(-(int(length / settings.dx) + 2 + 2 * WALL) // BLOCK) for length in extent)
    if blocks[0] * blocks[1] * blocks[2] > MOST_BLOCKS:
        raise ValueError(f"the room holds {blocks} blocks of {BLOCK} cells, more than {MOST_BLOCKS}: make it smaller, or its cells larger")
    origin = tuple(low - WALL * settings.dx for low in settings.minimum)
    return Lattice(origin, settings.dx, blocks)  # type: ignore[arg-type]


@dataclass(frozen=True, eq=False)
class Blocks:
    """Where particles are, until they are sorted again."""

    order: Int[Tensor, "particle"]
    """int64: place in the sorted arrays -> particle."""
    block_of: Int[Tensor, "particle"]
    """int32, of sorted particles."""
    starts: Int[Tensor, "filled_plus_1"]
    """int32: each filled block's first sorted particle."""
    corners: Int[Tensor, "block 3"]
    """int32, first node of each block; those with particles come first."""
    neighbours: Int[Tensor, "block 27"]
    """int32: places of the blocks around, x slowest; -1 where there is none."""

    @property
    def filled(self) -> int:
        """How many blocks hold particles."""
        return len(self.starts) - 1


def sort_particles(positions: Float[Tensor, "particle 3"], lattice: Lattice) -> Blocks:
    """Sort positions (particle, 3) into blocks, by cell within each; stable, so the same on every run."""
    device = positions.device
    sizes = torch.tensor(lattice.blocks, device=device)
    origin = torch.tensor(lattice.origin, device=device)
    base = torch.floor((positions - origin) / lattice.dx - 0.5).long()
    base = torch.minimum(base.clamp(min=0), sizes * BLOCK - 3)  # positions are kept inside; this guards the tables against NaN
    block = base // BLOCK
    inside = base - block * BLOCK
    key = _linear(block, sizes) * BLOCK_NODES + (inside[:, 0] * BLOCK + inside[:, 1]) * BLOCK + inside[:, 2]
    key, order = torch.sort(key, stable=True)
    filled, block_of, counts = torch.unique_consecutive(key // BLOCK_NODES, return_inverse=True, return_counts=True)
    starts = torch.nn.functional.pad(counts.cumsum(0), (1, 0))

    steps = torch.arange(-1, 2, device=device)
    offsets = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(27, 3)
    table = torch.full((int(sizes.prod()),), -1, dtype=torch.int32, device=device)
    table[filled] = torch.arange(len(filled), dtype=torch.int32, device=device)
    around, valid = _around(filled, offsets, sizes)
    reached = torch.unique(around[valid])
    empty = reached[table[reached] < 0]
    blocks = torch.cat([filled, empty])
    table[empty] = torch.arange(len(filled), len(blocks), dtype=torch.int32, device=device)
    around, valid = _around(blocks, offsets, sizes)
    neighbours = torch.where(valid, table[around], torch.full_like(around, -1, dtype=torch.int32))
    corners = (_unravel(blocks, sizes) * BLOCK).int()
    return Blocks(order, block_of.int(), starts.int(), corners.contiguous(), neighbours.contiguous())


def _linear(block: Int[Tensor, "*n 3"], sizes: Int[Tensor, "3"]) -> Int[Tensor, "*n"]:
    return (block[..., 0] * sizes[1] + block[..., 1]) * sizes[2] + block[..., 2]


def _unravel(linear: Int[Tensor, "*n"], sizes: Int[Tensor, "3"]) -> Int[Tensor, "*n 3"]:
    plane = sizes[1] * sizes[2]
    return torch.stack([linear // plane, linear % plane // sizes[2], linear % sizes[2]], -1)


def _around(
    linear: Int[Tensor, "block"], offsets: Int[Tensor, "27 3"], sizes: Int[Tensor, "3"]
) -> tuple[Int[Tensor, "block 27"], Bool[Tensor, "block 27"]]:
    """(block, 27) indices of the blocks around, clamped into the room, and which of them exist."""
    block = _unravel(linear, sizes)[:, None] + offsets
    valid = ((block >= 0) & (block < sizes)).all(-1)
    return _linear(torch.minimum(block.clamp(min=0), sizes - 1), sizes), valid
