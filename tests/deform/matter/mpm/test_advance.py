"""Matter in motion: what physics conserves, what closed forms say, and what must never get out."""

import math
from dataclasses import replace
from itertools import pairwise

import pytest
import torch

from drgs.deform.matter.mpm import (
    Box,
    Condition,
    GridSettings,
    Material,
    MpmSettings,
    Plane,
    Sphere,
    advance,
    make_model,
    measure_balance,
    rest_state,
)
from drgs.deform.matter.mpm.blocks import make_lattice, sort_particles
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reference import mpm as reference

DX = 1 / 16


def cube(material=None, side=8, center=(0.0, 0.0, 0.5), room=1.5, gravity=(0.0, 0.0, 0.0), conditions=(), jitter=0.2, dx=DX, bottom=0.0):
    """A cube of side^3 cells' half widths, eight particles a cell, in a room that starts at z = bottom."""
    steps = (torch.arange(side) + 0.5 - side / 2) * dx / 2
    points = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    points = points + jitter * dx / 2 * (2 * torch.rand(points.shape) - 1) + torch.tensor(center)
    grid = GridSettings((-room, -room, bottom), (room, room, bottom + 2 * room), dx)
    volumes = torch.full((len(points),), (dx / 2) ** 3)
    return make_model(points, volumes, (material or Material(),), torch.zeros(len(points), dtype=torch.int32), grid, gravity, conditions)


def spinning(model, rate=4.0, shift=(0.5, 0.2, 0.0)):
    center = model.rest.mean(0)
    axis = torch.tensor([0.3, 0.2, 1.0])
    return torch.linalg.cross((rate * axis).expand_as(model.rest), model.rest - center) + torch.tensor(shift)


def test_one_step_agrees_with_the_float64_twin():
    model = cube(Material("neo_hookean"), side=6, center=(0.6, 0.7, 0.8), gravity=(0.0, 0.0, -9.81))
    state = replace(
        rest_state(model, spinning(model)), affine=torch.randn(len(model.rest), 3, 3), stress=100 * torch.randn(len(model.rest), 3, 3)
    )
    dt = 2e-4
    after, report = advance(model, state, dt)
    assert report.substeps == 1
    lattice = make_lattice(model.grid)
    origin = torch.tensor(lattice.origin, dtype=torch.float64)
    x, v, c = reference.step(
        state.positions.double() - origin, state.velocities.double(), state.affine.double(), state.stress.double(),
        model.masses.double(), model.volumes.double(), lattice.dx, dt, torch.tensor([0, 0, -9.81], dtype=torch.float64),
    )  # fmt: skip
    assert torch.allclose(after.positions.double(), x + origin, atol=1e-6)
    assert torch.allclose(after.velocities.double(), v, atol=2e-5) and torch.allclose(after.affine.double(), c, atol=2e-3)


def test_blocks_hold_every_particle_once_and_know_their_neighbours():
    model = cube()
    lattice = make_lattice(model.grid)
    blocks = sort_particles(model.rest, lattice)
    assert torch.equal(blocks.order.sort().values, torch.arange(len(model.rest)))
    base = torch.floor((model.rest[blocks.order] - torch.tensor(lattice.origin)) / lattice.dx - 0.5).int()
    local = base - blocks.corners[blocks.block_of.long()]
    assert int(local.min()) >= 0 and int(local.max()) <= 3
    assert torch.equal(
        blocks.starts[blocks.block_of.long()] <= torch.arange(len(model.rest)), torch.ones(len(model.rest), dtype=torch.bool)
    )
    assert (blocks.neighbours[:, 13] == torch.arange(len(blocks.corners))).all()
    assert (blocks.neighbours[: blocks.filled] >= 0).all()
    steps = torch.stack(torch.meshgrid(*3 * [torch.arange(-1, 2)], indexing="ij"), -1).reshape(27, 3)
    found = blocks.corners[blocks.neighbours[: blocks.filled].long()]
    assert torch.equal(found, blocks.corners[: blocks.filled, None] + 4 * steps.int())


@pytest.mark.parametrize("law", ["fixed_corotated", "von_mises"])
def test_free_fall_is_exact(law):
    model = cube(Material(law), side=6, center=(0.0, 0.0, 2.0), gravity=(0.0, 0.0, -9.81))
    after, report = advance(model, rest_state(model), 0.1)
    n, dt = report.substeps, 0.1 / report.substeps
    assert torch.allclose(after.velocities[:, 2], torch.full((len(model.rest),), -0.981), rtol=5e-6)
    assert report.smallest_dt <= dt
    fallen = (after.positions - model.rest)[:, 2].double()
    assert float(fallen.std()) < 2e-6 and float(fallen.mean()) == pytest.approx(-0.5 * 9.81 * 0.01, rel=1.5 / n)
    assert torch.allclose(after.total, torch.eye(3).expand_as(after.total), atol=2e-6)


def test_momentum_and_angular_momentum_are_kept_and_energy_never_grows():
    model = cube(side=8, center=(0.0, 0.0, 1.5))
    state = rest_state(model, spinning(model))
    before = measure_balance(model, state)
    energies = [before.energy]
    for _ in range(4):
        state, _ = advance(model, state, 0.05)
        energies.append(measure_balance(model, state).energy)
    after = measure_balance(model, state)
    assert torch.allclose(after.momentum, before.momentum, rtol=1e-5, atol=1e-6 * float(before.momentum.norm()))
    assert float((after.angular_momentum - before.angular_momentum).norm() / before.angular_momentum.norm()) < 1e-5
    assert all(b <= a * (1 + 1e-6) for a, b in pairwise(energies)) and energies[-1] > 0.9 * energies[0]
    pic, _ = advance(model, rest_state(model, spinning(model, shift=(0, 0, 0))), 0.2, MpmSettings(transfer="pic"))
    loss = measure_balance(model, pic).angular_momentum[2] / before.angular_momentum[2]
    assert abs(float(loss)) < 0.3  # the paper's printed transfer: rotation dies out


@pytest.mark.slow
def test_a_bar_swings_with_the_period_of_its_first_mode():
    # Free-free bar, nu = 0, rest moved by the mode: T = 2 L / sqrt(E / rho).
    dx, length, youngs, rho = 1 / 32, 1.0, 1e4, 1000.0
    x, across = (torch.arange(64) + 0.5) * dx / 2, (torch.arange(8) + 0.5) * dx / 2
    points = torch.stack(torch.meshgrid(x, across, across, indexing="ij"), -1).reshape(-1, 3)
    grid = GridSettings((-0.5, -0.5, -0.5), (1.5, 1.0, 1.0), dx)
    material = Material("fixed_corotated", young_modulus=youngs, poisson_ratio=0.0, density=rho)
    model = make_model(points, torch.full((len(points),), (dx / 2) ** 3), (material,), torch.zeros(len(points), dtype=torch.int32), grid)
    mode = torch.cos(math.pi * points[:, 0] / length)
    state = rest_state(model, torch.stack([0.01 * mode, 0 * mode, 0 * mode], -1))
    period = 2 * length / math.sqrt(youngs / rho)
    # Velocity of the mode crosses 0 at T/4 and at 5 T/4.
    amplitudes, times = [], []
    state, _ = advance(model, state, 1.2 * period)
    for _ in range(5):
        amplitudes.append(float((state.velocities[:, 0] * mode).sum()))
        times.append(state.time)
        state, _ = advance(model, state, 0.02 * period)
    k = next(k for k in range(4) if amplitudes[k] <= 0 < amplitudes[k + 1] or amplitudes[k] >= 0 > amplitudes[k + 1])
    crossing = times[k] - amplitudes[k] * (times[k + 1] - times[k]) / (amplitudes[k + 1] - amplitudes[k])
    assert crossing / (1.25 * period) == pytest.approx(1, abs=0.01)


def test_matter_at_rest_stays_so_bit_for_bit_and_costs_nothing():
    model = cube()
    state = rest_state(model)
    after, report = advance(model, state, 1.0)
    assert report.skipped and report.substeps == 0 and after.positions is state.positions and after.time == 1.0
    moving, report = advance(model, rest_state(model, (0.1, 0.0, 0.0)), 0.01)
    assert not report.skipped and moving.positions is not state.positions


def test_two_runs_agree_bit_for_bit_whatever_the_number_of_threads(monkeypatch):
    model = cube(Material("von_mises", yield_stress=100.0), gravity=(0.0, 0.0, -9.81))
    state = rest_state(model, spinning(model))
    first, _ = advance(model, state, 0.05)
    monkeypatch.setenv("DRGS_THREADS", "1")
    second, _ = advance(model, state, 0.05)
    for name in ("positions", "velocities", "affine", "total", "stress", "plastic"):
        assert torch.equal(getattr(first, name), getattr(second, name)), name


def test_a_rigid_turn_of_the_whole_scene_turns_the_result():
    model = cube(jitter=0.0, side=6, center=(0.0, 0.0, 1.5))
    quarter = rotation_from_quat_wxyz(torch.tensor([1.0, 0.0, 0.0, 1.0]))  # a quarter turn keeps the grid
    center = torch.tensor([0.0, 0.0, 1.5])
    turned = replace(model, rest=((model.rest - center) @ quarter.T + center).contiguous())
    velocity = spinning(model)
    one, _ = advance(model, rest_state(model, velocity), 0.1)
    two, _ = advance(turned, rest_state(turned, (velocity @ quarter.T).contiguous()), 0.1)
    assert torch.allclose((one.positions - center) @ quarter.T + center, two.positions, atol=2e-5)


def test_a_drop_bounces_lower_than_it_fell_and_stays_above_the_floor():
    model = cube(
        Material(young_modulus=2e4),
        side=6,
        center=(0, 0, 0.6),
        gravity=(0, 0, -9.81),
        conditions=(Condition(Plane((0, 0, 0.1), (0, 0, 1))),),
    )
    state, heights = rest_state(model), []
    for _ in range(12):
        state, report = advance(model, state, 0.05)
        assert report.retries == 0
        heights.append(float(state.positions[:, 2].mean()))
    lowest = heights.index(min(heights))
    assert 2 <= lowest <= 8 and max(heights[lowest:]) < 0.6 and max(heights[lowest:]) > heights[lowest] + 0.02
    assert float(state.positions[:, 2].min()) > 0.1 - DX / 2


def slide(effect, friction):
    floor = Condition(Plane((0, 0, 0.2), (0, 0, 1)), effect, friction)
    model = cube(Material(young_modulus=1e5), side=6, center=(0, 0, 0.2 + 3 * DX / 2), gravity=(3.0, 0, -9.81), conditions=(floor,))
    after, _ = advance(model, rest_state(model), 0.3)
    return float((after.positions - model.rest)[:, 0].mean())


def test_a_block_on_a_slope_slides_only_if_friction_is_less_than_its_tangent():
    free = 0.5 * 3.0 * 0.09  # the slope's tangent is 3 / 9.81 = 0.31
    assert slide("separate", 0.0) == pytest.approx(free, rel=0.02) and slide("slip", 0.0) == pytest.approx(free, rel=0.02)
    assert slide("separate", 0.6) < 0.1 * free and slide("sticky", 0.0) < 0.1 * free
    assert slide("separate", 0.15) == pytest.approx(free * (1 - 0.15 * 9.81 / 3), rel=0.15)


def test_pins_hold_handles_drag_and_pushes_last_as_long_as_they_say():
    top = Box((-1, -1, 0.55), (1, 1, 1))
    pinned = cube(side=8, conditions=(Condition(top, "sticky"),), gravity=(0, 0, -9.81))
    after, _ = advance(pinned, rest_state(pinned), 0.1)
    held = pinned.rest[:, 2] > 0.55 + 2 * DX / 3
    assert float((after.positions - pinned.rest)[held].abs().max()) < 2e-3
    dragged = cube(side=8, conditions=(Condition(top, "sticky", velocity=(0.5, 0, 0), end=0.1),))
    after, _ = advance(dragged, rest_state(dragged), 0.1)
    assert float((after.positions - dragged.rest)[held, 0].mean()) == pytest.approx(0.05, rel=0.15)
    pushed = cube(side=6, conditions=(Condition(Sphere((0, 0, 0.5), 2.0), "push", velocity=(1.0, 0, 0), start=0.02, end=0.06),))
    after, _ = advance(pushed, rest_state(pushed), 0.1)
    assert float(after.velocities[:, 0].mean()) == pytest.approx(0.04, rel=0.06)


@pytest.mark.slow
def test_nothing_leaves_the_room():
    model = cube(side=6, room=0.6, center=(0, 0, 0.6))
    after, _ = advance(model, rest_state(model, (30.0, 20.0, -10.0)), 0.2)
    low, high = torch.tensor(model.grid.minimum), torch.tensor(model.grid.maximum)
    assert (after.positions >= low - 1e-4).all() and (after.positions <= high + 1e-4).all() and torch.isfinite(after.velocities).all()
    with pytest.raises(ValueError, match=r"particles lie outside the room"):
        cube(center=(5.0, 0.0, 0.5))


def test_a_step_that_fails_is_taken_back_and_the_culprits_are_frozen():
    model = cube(side=6)
    state = rest_state(model, (0.1, 0.0, 0.0))
    poison = state.elastic.clone()
    poison[7] = math.nan
    after, report = advance(model, replace(state, elastic=poison, stress=poison.clone()), 0.02)
    assert report.retries == 5 and report.frozen == 1 and bool(after.frozen[7])
    assert torch.isfinite(after.positions).all() and torch.isfinite(after.velocities[:7]).all()
    others = torch.arange(len(model.rest)) != 7
    assert float((after.positions - model.rest)[others, 0].mean()) == pytest.approx(0.002, rel=0.05)
    assert float((after.positions - model.rest)[7].abs().max()) == 0


@pytest.mark.slow
@pytest.mark.parametrize("law", ["fixed_corotated", "neo_hookean", "von_mises", "drucker_prager", "fluid", "snow"])
def test_every_law_survives_a_hard_fall(law):
    material = Material(law, yield_stress=2e3, bulk_modulus=1e5, viscosity=1.0)
    model = cube(
        material, side=6, center=(0, 0, 0.3), gravity=(0, 0, -9.81), conditions=(Condition(Plane((0, 0, 0.1), (0, 0, 1)), friction=0.3),)
    )
    state = rest_state(model, (0, 0, -5.0))
    state, report = advance(model, state, 0.15)
    assert report.frozen == 0 and torch.isfinite(state.positions).all() and torch.isfinite(state.total).all()
    assert float(state.velocities.norm(dim=-1).max()) < 15 and float(state.positions[:, 2].min()) > 0.05


@pytest.mark.parametrize("count", [1, 2, 3])
def test_a_handful_of_particles_falls_as_well(count):
    points = torch.tensor([[0.0, 0.0, 0.5], [0.3, 0.0, 0.5], [0.3, 0.0, 0.5]])[:count]
    grid = GridSettings((-1, -1, 0), (1, 1, 1), DX)
    model = make_model(points, torch.full((count,), 1e-4), (Material(),), torch.zeros(count, dtype=torch.int32), grid, (0, 0, -9.81))
    after, _ = advance(model, rest_state(model), 0.1)
    assert torch.allclose(after.velocities[:, 2], torch.tensor(-0.981), rtol=1e-4)


def test_more_substeps_than_allowed_are_refused_with_a_sentence():
    model = cube(Material(young_modulus=1e9), gravity=(0, 0, -9.81))
    with pytest.raises(ValueError, match=r"would take .* substeps, more than 100"):
        advance(model, rest_state(model), 1 / 24, MpmSettings(max_substeps=100))
    with pytest.raises(ValueError, match=r"at most 0\.9"):
        MpmSettings(courant=1.5)
