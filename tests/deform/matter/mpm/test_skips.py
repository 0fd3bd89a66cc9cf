"""What the simulation leaves out, each where it must be left out and where it must not (issue: skips)."""

import math
from dataclasses import replace

import pytest
import torch

from drgs.deform.carry.gmls import build_weights, interpolate
from drgs.deform.matter.mpm import Condition, GridSettings, Material, Plane, advance, make_model, rest_state
from drgs.deform.matter.mpm.blocks import make_lattice, sort_particles

DX = 1 / 16


def cube(materials=None, side=8, room=1.5, conditions=(), gravity=(0.0, 0.0, 0.0)):
    steps = (torch.arange(side) + 0.5 - side / 2) * DX / 2
    points = torch.stack(torch.meshgrid(steps, steps, steps, indexing="ij"), -1).reshape(-1, 3)
    grid = GridSettings((-room, -room, -room), (room, room, room), DX)
    return make_model(
        points,
        torch.full((len(points),), (DX / 2) ** 3),
        materials or (Material(),),
        torch.zeros(len(points), dtype=torch.int32),
        grid,
        gravity,
        conditions,
    )


def test_nothing_is_computed_for_a_body_at_rest_until_something_acts():
    model = cube()
    state = rest_state(model)
    after, report = advance(model, state, 1.0)
    assert report.skipped and report.substeps == 0 and after.positions is state.positions
    for acting in (
        replace(model, gravity=(0.0, 0.0, -9.81)),
        replace(model, conditions=(Condition(Plane((0, 0, -1), (0, 0, 1)), "push", velocity=(0, 0, 1.0)),)),
        replace(model, conditions=(Condition(Plane((0, 0, 0), (0, 0, 1)), "sticky", velocity=(0, 0, 1.0)),)),
    ):
        assert not advance(acting, rest_state(acting), 0.001)[1].skipped
    for disturbed in (
        replace(state, velocities=state.velocities + 1e-3),
        replace(state, stress=state.stress + 1e-3),
        replace(state, affine=state.affine + 1e-3),
    ):
        assert not advance(model, disturbed, 0.001)[1].skipped


def test_substeps_follow_the_speed_of_sound_of_the_materials_that_are_there():
    def substeps(*materials):
        model = cube(materials)
        return advance(model, rest_state(model, (1e-6, 0.0, 0.0)), 0.05)[1].substeps

    soft, hard = substeps(Material(young_modulus=1e4)), substeps(Material(young_modulus=1e6))
    assert hard / soft == pytest.approx(10, rel=0.1)
    assert substeps(Material(young_modulus=1e4, density=100.0)) / soft == pytest.approx(math.sqrt(10), rel=0.1)
    # What is listed, but is nowhere in the object, costs nothing; what is there does.
    assert substeps(Material(young_modulus=1e4), Material(young_modulus=1e8)) == soft
    model = cube((Material(young_modulus=1e4), Material(young_modulus=1e6)))
    mixed = make_model(
        model.rest, model.volumes, (Material(young_modulus=1e4), Material(young_modulus=1e6)), (model.rest[:, 0] > 0.1).long(), model.grid
    )
    assert advance(mixed, rest_state(mixed, (1e-6, 0.0, 0.0)), 0.05)[1].substeps == hard


def test_the_grid_exists_around_particles_only_and_the_room_does_not_matter():
    near, far = cube(room=1.5), cube(room=12.0)
    blocks = [sort_particles(model.rest, make_lattice(model.grid)) for model in (near, far)]
    rooms = [math.prod(make_lattice(model.grid).blocks) for model in (near, far)]
    assert rooms[1] > 300 * rooms[0] and len(blocks[1].corners) == len(blocks[0].corners) < 0.1 * rooms[0]
    spread = cube(room=12.0)
    apart = replace(spread, rest=(spread.rest * 20).contiguous())
    assert len(sort_particles(apart.rest, make_lattice(apart.grid)).corners) > 10 * len(blocks[0].corners)
    ends = [advance(model, rest_state(model, (0.3, 0.2, -0.1)), 0.05)[0].positions for model in (near, far)]
    assert torch.allclose(ends[0], ends[1], atol=2e-6)


def test_surfels_among_particles_at_rest_are_not_computed_and_keep_their_bits():
    model = cube()
    points = model.rest + 0.2 * DX
    weights = build_weights(model.rest, points)
    moved = model.rest.clone()
    pulled = model.rest[:, 0] > 0.1
    moved[pulled, 2] += 0.01
    identity = torch.eye(3).expand(len(points), 3, 3).contiguous()
    position, gradient = interpolate(weights, moved, identity)
    near = pulled[weights.neighbours.long()].any(1)
    assert 0 < int(near.sum()) < len(points)
    assert torch.equal(position[~near], points[~near]) and torch.equal(gradient[~near], identity[~near])
    assert float((position - points)[near].abs().amax(1).min()) > 0
    # Poisoned weights show which points were summed.
    poisoned, _ = interpolate(replace(weights, psi=torch.full_like(weights.psi, torch.nan)), moved, identity)
    assert torch.equal(torch.isnan(poisoned).any(1), near)
    # A particle that has not moved, but is stretched, is not at rest.
    stretched = identity.clone()
    stretched[pulled] *= 1.1
    _, gradient = interpolate(weights, model.rest, stretched)
    assert float((gradient - identity)[near].abs().amax((1, 2)).min()) > 0 and torch.equal(gradient[~near], identity[~near])
