"""Matter moves on in time: the material point method with a time step of its own choice, and failures kept inside.

In: a model, a state, seconds. Out: a new state, and a report. The time step follows from the fastest wave and the fastest particle.
A step that yields values that are not finite is never kept: the call starts again from the state it was given with half the time
step, and, should that not help, without the particles that failed.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
import warp as wp
from jaxtyping import Bool, Int
from torch import Tensor

from drgs.deform.matter.mpm.blocks import BLOCK_NODES, DRIFT, TILE_NODES, WALL, Blocks, Lattice, make_lattice, sort_particles
from drgs.deform.matter.mpm.conditions import pack_conditions
from drgs.deform.matter.mpm.records import Condition, Model, MpmSettings, State
from drgs.deform.matter.mpm.transfer import (
    NOT_FINITE,
    STRAYED,
    Grid,
    Matter,
    gather_particles,
    scatter_blocks,
    scatter_particles,
    update_nodes,
)
from drgs.warp_torch import launch, warp_array, warp_device

BATCH = 16
"""Substeps between two looks at the fastest particle."""
SURGE = 1.25
"""The factor by which speeds may grow within a batch, beside gravity, before the state is taken back."""
BLAST = 10.0
"""The factor by which speeds may exceed the first and that of waves; more is no motion but a time step that failed."""
MOVING = ("positions", "velocities", "affine", "total", "elastic", "stress", "plastic", "frozen")
FIXED = ("masses", "volumes", "laws", "parameters")


@dataclass(frozen=True)
class AdvanceReport:
    substeps: int
    retries: int
    """Halvings of the time step that were needed."""
    frozen: int
    """Particles out of the motion, of this call and those before."""
    smallest_dt: float
    """Seconds."""
    at_wall: bool
    """Whether some particle was stopped at the end of the room."""
    skipped: bool
    """Whether nothing could have moved, so that nothing was computed."""


class _Failed(Exception):
    """A step went wrong; holds the particles (bool, in their original order) that are to blame."""

    def __init__(self, culprits: Bool[Tensor, "particle"]) -> None:
        super().__init__()
        self.culprits = culprits


def advance(
    model: Model, state: State, seconds: float, settings: MpmSettings | None = None, go_on: Callable[[], None] | None = None
) -> tuple[State, AdvanceReport]:
    """The state `seconds` later; the one given is not changed.

    Args:
        go_on: called between batches of substeps; what it raises ends the work.

    Raises:
        ValueError: it would take more than `max_substeps`.
    """
    settings = settings or MpmSettings()
    if not (0 <= seconds < math.inf):
        raise ValueError(f"seconds is {seconds}; expected a finite number, 0 or more")
    if seconds == 0 or _nothing_moves(model, state):
        still = replace(state, time=state.time + seconds)
        return still, AdvanceReport(0, 0, int(state.frozen.sum()), math.inf, False, True)
    scale, retries, start = 1.0, 0, state
    while True:
        try:
            # When somebody is about to be stopped, every step is looked at: after a batch, all around them have failed as well.
            after, report = _run(model, start, seconds, settings, scale, BATCH if retries < settings.retries else 1, go_on)
            return after, replace(report, retries=retries)
        except _Failed as failure:
            retries += 1
            scale /= 2
            if retries > settings.retries:
                # The time step is not to blame. All that fail are stopped; in the end that is everything.
                culprits = failure.culprits if retries <= settings.retries + 3 else torch.ones_like(failure.culprits)
                scale = 2.0**-settings.retries
                velocities = torch.where(culprits[:, None], torch.zeros_like(start.velocities), start.velocities)
                start = replace(start, frozen=start.frozen | culprits, velocities=velocities)
                if bool(start.frozen.all()):
                    return replace(start, time=start.time + seconds), AdvanceReport(0, retries, len(start.frozen), 0.0, False, False)


def _nothing_moves(model: Model, state: State) -> bool:
    """Exactly: no motion, no stress, nothing that acts."""
    acts = any(model.gravity) or any(condition.effect == "push" or any(condition.velocity) for condition in model.conditions)
    return not acts and not bool(state.velocities.any()) and not bool(state.stress.any()) and not bool(state.affine.any())


@dataclass(eq=False)
class _Work:
    """Sorted copies of everything, on which kernels write in place."""

    arrays: dict[str, Tensor]
    order: Int[Tensor, "particle"]
    """Place in the arrays -> particle."""
    blocks: Blocks
    grid: Grid
    matter: Matter
    drift: float
    """Cells that some particle may have moved since the last sort."""


def _run(
    model: Model, state: State, seconds: float, settings: MpmSettings, scale: float, batch: int, go_on: Callable[[], None] | None
) -> tuple[State, AdvanceReport]:
    lattice = make_lattice(model.grid)
    device = model.rest.device
    conditions = pack_conditions(model.conditions, device)
    flags = torch.zeros(4, dtype=torch.int32, device=device)
    work = _start(model, state, lattice)
    gravity = math.sqrt(sum(g * g for g in model.gravity))
    pull = gravity + sum(math.sqrt(sum(a * a for a in c.velocity)) for c in model.conditions if c.effect == "push")
    own_speeds = [_speed(c) for c in model.conditions if c.effect != "push"]
    done, substeps, smallest, blast = 0.0, 0, math.inf, math.inf
    while done < seconds:
        if go_on is not None:
            go_on()
        speed = float(work.arrays["velocities"].norm(dim=-1).max())
        if not math.isfinite(speed):
            raise _Failed(_culprits(work))
        speed = max([speed, *own_speeds])
        if done == 0:
            blast = BLAST * (speed + model.wave_speed + pull * seconds)
        elif speed > blast:
            raise _Failed(_culprits(work, blast))
        # A batch's speeds: gravity may add to them, and a blow of any wave may, too.
        dt = scale * settings.courant * lattice.dx / (model.wave_speed + speed)
        speed = SURGE * (speed + pull * BATCH * dt) + 0.01 * model.wave_speed
        dt = scale * settings.courant * lattice.dx / (model.wave_speed + speed)
        dt = min(dt, _viscous_limit(model, lattice.dx) * scale)
        left = math.ceil((seconds - done) / dt * (1 - 1e-9))
        if substeps + left > settings.max_substeps / scale:
            raise ValueError(
                f"{seconds:.4g} s would take {substeps + left} substeps, more than {settings.max_substeps}: "
                f"waves run at {model.wave_speed:.3g} units/s through cells of {lattice.dx:.3g}; use softer matter, larger cells or shorter frames"
            )
        dt = (seconds - done) / left
        step_drift = speed * dt / lattice.dx
        if work.drift + step_drift > DRIFT:
            work = _sort(model, work.arrays, work.order, lattice, work.grid)
        count = max(1, min(batch, left, int((DRIFT - work.drift) / step_drift)))
        _batch(work, count, dt, state.time + done, model, conditions, settings, flags)
        work.drift += count * step_drift
        substeps, smallest = substeps + count, min(smallest, dt)
        done = seconds if count == left else done + count * dt
        found = flags.tolist()
        if found[NOT_FINITE] or found[STRAYED]:
            raise _Failed(_culprits(work, speed))
    after = _unsorted(work, state.time + seconds)
    return after, AdvanceReport(substeps, 0, int(after.frozen.sum()), smallest, bool(flags[2]), False)


def _speed(condition: Condition) -> float:
    return math.sqrt(sum(a * a for a in condition.velocity))


def _viscous_limit(model: Model, dx: float) -> float:
    """dt <= rho dx^2 / (6 eta), of fluids."""
    from drgs.deform.matter.mpm.records import LAWS

    fluid = model.laws == LAWS.index("fluid")
    if not bool(fluid.any()):
        return math.inf
    density = model.masses[fluid] / model.volumes[fluid]
    return float((density * dx * dx / (6 * model.parameters[fluid, 0]).clamp(min=1e-30)).min())


def _start(model: Model, state: State, lattice: Lattice) -> _Work:
    arrays = {name: getattr(state, name) for name in MOVING} | {name: getattr(model, name) for name in FIXED}
    # Only ratios of masses and volumes matter on the grid; scaled ones keep float32 away from its ends.
    scale = 1 / float(model.masses.double().mean())
    arrays["masses"], arrays["volumes"] = model.masses * scale, model.volumes * scale
    grid = Grid()
    grid.origin, grid.dx, grid.inv_dx = wp.vec3(*lattice.origin), lattice.dx, 1 / lattice.dx
    grid.limit = wp.vec3(*(o + (n - 1 - WALL) * lattice.dx for o, n in zip(lattice.origin, lattice.nodes, strict=True)))
    grid.limit = wp.vec3(*(min(a, b) for a, b in zip(grid.limit, model.grid.maximum, strict=True)))
    grid.nodes_x, grid.nodes_y, grid.nodes_z = lattice.nodes
    return _sort(model, arrays, torch.arange(len(model.rest), device=model.rest.device), lattice, grid)


def _sort(model: Model, arrays: dict[str, Tensor], order: Tensor, lattice: Lattice, grid: Grid) -> _Work:
    blocks = sort_particles(arrays["positions"], lattice)
    arrays = {name: values[blocks.order].contiguous() for name, values in arrays.items()}
    device = order.device
    grid.corners = wp.from_torch(blocks.corners, dtype=wp.vec3i)
    grid.neighbours, grid.starts, grid.block_of = (warp_array(x) for x in (blocks.neighbours, blocks.starts, blocks.block_of))
    grid.tiles = wp.from_torch(torch.zeros(blocks.filled * TILE_NODES, 4, device=device), dtype=wp.vec4)
    grid.nodes = wp.from_torch(torch.zeros(len(blocks.corners) * BLOCK_NODES, 4, device=device), dtype=wp.vec4)
    matter = Matter()
    names = {"x": "positions", "v": "velocities", "c": "affine", "total": "total", "elastic": "elastic", "stress": "stress"}
    for own, name in names.items():
        setattr(matter, own, warp_array(arrays[name], wp.vec3 if arrays[name].ndim == 2 else wp.mat33))
    matter.plastic, matter.mass, matter.volume = (warp_array(arrays[name]) for name in ("plastic", "masses", "volumes"))
    matter.law, matter.parameters, matter.frozen = (
        warp_array(arrays["laws"]),
        warp_array(arrays["parameters"], wp.vec4),
        wp.from_torch(arrays["frozen"]),
    )
    return _Work(arrays, order[blocks.order], blocks, grid, matter, 0.0)


def _batch(
    work: _Work,
    count: int,
    dt: float,
    time: float,
    model: Model,
    conditions: tuple[Tensor, Tensor],
    settings: MpmSettings,
    flags: Tensor,
) -> None:
    device = warp_device(flags)
    on_cpu = flags.device.type == "cpu"
    affine = 1.0 if settings.transfer == "apic" else 0.0
    seen, table, distances = warp_array(flags), *map(warp_array, conditions)
    kept = math.exp(-settings.velocity_damping * dt)
    gravity = wp.vec3(*model.gravity)
    matter, grid, filled, particles = work.matter, work.grid, work.blocks.filled, len(work.order)
    for step in range(count):
        if on_cpu:
            launch(scatter_blocks, filled, [matter, grid, dt, affine, seen], [], device, 2)
        else:
            grid.tiles.zero_()
            launch(scatter_particles, particles, [matter, grid, dt, affine, seen], [], device)
        nodes = len(work.blocks.corners) * BLOCK_NODES
        launch(update_nodes, nodes, [grid, filled, dt, time + step * dt, gravity, table, distances], [], device, 1)
        launch(gather_particles, particles, [matter, grid, dt, 1 - settings.strain_damping, kept, seen], [], device, 1)


def _unsorted(work: _Work, time: float) -> State:
    back = torch.empty_like(work.order)
    back[work.order] = torch.arange(len(back), device=back.device)
    return State(**{name: work.arrays[name][back].contiguous() for name in MOVING}, time=time)


def _culprits(work: _Work, speed: float = math.inf) -> Bool[Tensor, "particle"]:
    """Particles (bool, in their original order) with values that are not finite, or faster than anything was expected to be."""
    bad = torch.zeros(len(work.order), dtype=torch.bool, device=work.order.device)
    for name in ("positions", "velocities", "affine", "total", "elastic", "stress"):
        values = work.arrays[name]
        bad |= ~torch.isfinite(values).flatten(1).all(1)
    if not bool(bad.any()):
        speeds = work.arrays["velocities"].norm(dim=-1)
        bad = speeds >= min(speed, float(speeds.max()))
    found = torch.empty_like(bad)
    found[work.order] = bad
    return found
