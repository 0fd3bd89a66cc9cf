"""Particles to grid and back: momentum, forces, velocities (MLS-MPM with APIC, quadratic B-splines).

`scatter_blocks` runs a block a thread and writes that block's tile only; `scatter_particles` runs a particle a thread and adds by
atomics, for CUDA. `update_nodes` sums the tiles that cover a node, turns momentum into velocity and applies gravity, conditions and
walls. `gather_particles` moves particles and lets the laws respond. Sources: docs/sources.md (hu2018, jiang2015).
"""

from pathlib import Path

import warp as wp

from drgs.deform.matter.mpm.blocks import BLOCK_NODES, TILE_NODES, WALL
from drgs.deform.matter.mpm.conditions import apply_conditions
from drgs.deform.matter.mpm.stress_laws import DRUCKER_PRAGER, FLUID, respond

wp.set_module_options({"enable_backward": False})

TILE_SIZE = wp.constant(TILE_NODES)
BLOCK_SIZE = wp.constant(BLOCK_NODES)
WALL_CELLS = wp.constant(WALL)
MOST_TOTAL = wp.constant(1.0e6)
"""|F|^2 beyond which a particle's total gradient stays as it is: plastic flow may stretch it without end."""

NOT_FINITE, STRAYED, AT_WALL = 0, 1, 2
"""Places in the flags."""


@wp.struct
class Grid:
    origin: wp.vec3
    dx: float
    inv_dx: float
    limit: wp.vec3
    """Upper end of the room; the lower is origin + WALL dx."""
    nodes_x: int
    nodes_y: int
    nodes_z: int
    corners: wp.array[wp.vec3i]
    neighbours: wp.array2d[wp.int32]
    starts: wp.array[wp.int32]
    block_of: wp.array[wp.int32]
    tiles: wp.array[wp.vec4]
    """Momentum and mass."""
    nodes: wp.array[wp.vec4]
    """Velocity, and 1 where there is mass."""


@wp.struct
class Matter:
    x: wp.array[wp.vec3]
    v: wp.array[wp.vec3]
    c: wp.array[wp.mat33]
    total: wp.array[wp.mat33]
    elastic: wp.array[wp.mat33]
    stress: wp.array[wp.mat33]
    plastic: wp.array[float]
    mass: wp.array[float]
    volume: wp.array[float]
    law: wp.array[wp.int32]
    parameters: wp.array[wp.vec4]
    frozen: wp.array[wp.bool]


def _source(name: str) -> str:
    return (Path(__file__).parent / name).read_text()


@wp.func_native(_source("spread_particle.h"))
def spread_particle(
    first: int, start: wp.vec4, qx: wp.vec4, qy: wp.vec4, qz: wp.vec4, wx: wp.vec3, wy: wp.vec3, wz: wp.vec3,
    tiles: wp.array[wp.vec4],
): ...  # fmt: skip


@wp.func_native(_source("collect_nodes.h"))
def collect_nodes(
    block: int, x: int, y: int, z: int, f: wp.vec3, wx: wp.vec3, wy: wp.vec3, wz: wp.vec3,
    neighbours: wp.array2d[wp.int32], nodes: wp.array[wp.vec4],
) -> wp.mat44: ...  # fmt: skip


@wp.func
def base_of(x: wp.vec3, grid: Grid):
    """Grid coordinates of a particle, and the first of the three nodes along each axis that it touches."""
    g = (x - grid.origin) * grid.inv_dx
    base = wp.vec3i(int(wp.floor(g[0] - 0.5)), int(wp.floor(g[1] - 0.5)), int(wp.floor(g[2] - 0.5)))
    return g - wp.vec3(float(base[0]), float(base[1]), float(base[2])), base


@wp.func
def spline(f: float):
    """Quadratic B-spline weights of nodes 0, 1, 2 for a particle at f in [1/2, 3/2)."""
    return wp.vec3(0.5 * (1.5 - f) * (1.5 - f), 0.75 - (f - 1.0) * (f - 1.0), 0.5 * (f - 0.5) * (f - 0.5))


@wp.func
def deposit(p: int, block: int, matter: Matter, grid: Grid, dt: float, affine: float, flags: wp.array[wp.int32]):
    """Add one particle's momentum, force times dt and mass to its block's tile."""
    x = matter.x[p]
    v = matter.v[p]
    m = matter.mass[p]
    q = (m * affine) * matter.c[p] - (4.0 * dt * grid.inv_dx * grid.inv_dx * matter.volume[p]) * matter.stress[p]
    if matter.frozen[p]:
        return
    if not (wp.isfinite(x) and wp.isfinite(v) and wp.isfinite(q)):
        flags[NOT_FINITE] = 1
        return
    f, base = base_of(x, grid)
    local = base - grid.corners[block] + wp.vec3i(1, 1, 1)
    if wp.min(local) < 0 or wp.max(local) > 5:
        flags[STRAYED] = 1
        return
    wx = spline(f[0])
    wy = spline(f[1])
    wz = spline(f[2])
    q = grid.dx * q
    start = m * v - q * f
    spread_particle(
        block * TILE_SIZE + (local[0] * 8 + local[1]) * 8 + local[2],
        wp.vec4(start[0], start[1], start[2], m),
        wp.vec4(q[0, 0], q[1, 0], q[2, 0], 0.0),
        wp.vec4(q[0, 1], q[1, 1], q[2, 1], 0.0),
        wp.vec4(q[0, 2], q[1, 2], q[2, 2], 0.0),
        wx,
        wy,
        wz,
        grid.tiles,
    )


@wp.kernel
def scatter_blocks(first: int, matter: Matter, grid: Grid, dt: float, affine: float, flags: wp.array[wp.int32]):
    block = first + wp.tid()
    for n in range(TILE_SIZE):
        grid.tiles[block * TILE_SIZE + n] = wp.vec4()
    for p in range(grid.starts[block], grid.starts[block + 1]):
        deposit(p, block, matter, grid, dt, affine, flags)


@wp.kernel
def scatter_particles(first: int, matter: Matter, grid: Grid, dt: float, affine: float, flags: wp.array[wp.int32]):
    """Tiles must have been cleared."""
    p = first + wp.tid()
    deposit(p, grid.block_of[p], matter, grid, dt, affine, flags)


@wp.func
def tile_value(grid: Grid, filled: int, block: int, bx: int, by: int, bz: int, x: int, y: int, z: int):
    """What the tile of the block at offset (bx, by, bz) holds of the node at (x, y, z) in this block."""
    other = grid.neighbours[block, ((bx + 1) * 3 + by + 1) * 3 + bz + 1]
    value = wp.vec4()
    if other >= 0 and other < filled:
        value = grid.tiles[other * TILE_SIZE + ((x - 4 * bx + 1) * 8 + y - 4 * by + 1) * 8 + z - 4 * bz + 1]
    return value


@wp.kernel
def update_nodes(
    first: int,
    grid: Grid,
    filled: int,
    dt: float,
    time: float,
    gravity: wp.vec3,
    conditions: wp.array2d[float],
    distances: wp.array[float],
):
    i = first + wp.tid()
    block = i // BLOCK_SIZE
    n = i % BLOCK_SIZE
    x = n // 16
    y = (n // 4) % 4
    z = n % 4
    # Along each axis two tiles cover a node: its own block's, and one neighbour's.
    ox = wp.where(x < 3, -1, 1)
    oy = wp.where(y < 3, -1, 1)
    oz = wp.where(z < 3, -1, 1)
    total = tile_value(grid, filled, block, 0, 0, 0, x, y, z) + tile_value(grid, filled, block, 0, 0, oz, x, y, z)
    total += tile_value(grid, filled, block, 0, oy, 0, x, y, z) + tile_value(grid, filled, block, 0, oy, oz, x, y, z)
    total += tile_value(grid, filled, block, ox, 0, 0, x, y, z) + tile_value(grid, filled, block, ox, 0, oz, x, y, z)
    total += tile_value(grid, filled, block, ox, oy, 0, x, y, z) + tile_value(grid, filled, block, ox, oy, oz, x, y, z)
    if total[3] <= 1.0e-20:
        grid.nodes[i] = wp.vec4()
        return
    v = wp.vec3(total[0], total[1], total[2]) / total[3] + dt * gravity
    corner = grid.corners[block]
    nx = corner[0] + x
    ny = corner[1] + y
    nz = corner[2] + z
    position = grid.origin + grid.dx * wp.vec3(float(nx), float(ny), float(nz))
    v = apply_conditions(position, v, dt, time, conditions, distances)
    # The room's walls: nothing leaves.
    vx = v[0]
    vy = v[1]
    vz = v[2]
    if nx <= WALL_CELLS:
        vx = wp.max(vx, 0.0)
    if ny <= WALL_CELLS:
        vy = wp.max(vy, 0.0)
    if nz <= WALL_CELLS:
        vz = wp.max(vz, 0.0)
    if position[0] >= grid.limit[0]:
        vx = wp.min(vx, 0.0)
    if position[1] >= grid.limit[1]:
        vy = wp.min(vy, 0.0)
    if position[2] >= grid.limit[2]:
        vz = wp.min(vz, 0.0)
    grid.nodes[i] = wp.vec4(vx, vy, vz, 1.0)


@wp.kernel
def gather_particles(
    first: int, matter: Matter, grid: Grid, dt: float, strain_kept: float, velocity_kept: float, flags: wp.array[wp.int32]
):
    p = first + wp.tid()
    if matter.frozen[p]:
        return
    x = matter.x[p]
    block = grid.block_of[p]
    f, base = base_of(x, grid)
    local = base - grid.corners[block]
    if wp.min(local) < -1 or wp.max(local) > 4:
        flags[STRAYED] = 1
        return
    sums = collect_nodes(block, local[0], local[1], local[2], f, spline(f[0]), spline(f[1]), spline(f[2]), grid.neighbours, grid.nodes)
    v = wp.vec3(sums[0, 0], sums[0, 1], sums[0, 2])
    c = wp.mat33(
        sums[1, 0], sums[2, 0], sums[3, 0], sums[1, 1], sums[2, 1], sums[3, 1], sums[1, 2], sums[2, 2], sums[3, 2]
    )  # fmt: skip
    c = (4.0 * grid.inv_dx) * c
    # Strain damping leaves rotation alone.
    c = (0.5 * (1.0 + strain_kept)) * c - (0.5 * (1.0 - strain_kept)) * wp.transpose(c)
    v = velocity_kept * v
    to = x + dt * v
    low = grid.origin + (float(WALL_CELLS) * grid.dx) * wp.vec3(1.0, 1.0, 1.0)
    kept = wp.min(wp.max(to, low), grid.limit)
    if wp.length_sq(kept - to) > 0.0:
        flags[AT_WALL] = 1
    law = matter.law[p]
    elastic = matter.elastic[p] + dt * (c * matter.elastic[p])
    total = matter.total[p]
    if law == FLUID or law == DRUCKER_PRAGER:  # noqa: SIM109 (Warp has no `in`)
        # Only the spin; rows are made orthonormal again.
        turned = wp.transpose(total + (0.5 * dt) * ((c - wp.transpose(c)) * total))
        a = wp.normalize(wp.vec3(turned[0, 0], turned[0, 1], turned[0, 2]))
        b = wp.vec3(turned[1, 0], turned[1, 1], turned[1, 2])
        b = wp.normalize(b - wp.dot(a, b) * a)
        total = wp.matrix_from_cols(a, b, wp.cross(a, b))
    elif wp.ddot(total, total) < MOST_TOTAL:
        total = total + dt * (c * total)
    response, plastic, tau = respond(law, elastic, matter.plastic[p], c, dt, matter.parameters[p])
    if not (wp.isfinite(kept) and wp.isfinite(v) and wp.isfinite(tau) and wp.isfinite(total)):
        flags[NOT_FINITE] = 1
    matter.x[p] = kept
    matter.v[p] = v
    matter.c[p] = c
    matter.total[p] = total
    matter.elastic[p] = response
    matter.plastic[p] = plastic
    matter.stress[p] = tau
