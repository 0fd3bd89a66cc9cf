"""The clips of three kinds of matter: the sand in them is what its particles are."""

import math

import pytest
import torch
import trimesh

from benchmarks.paper.laws import LAWS, MOMENTS, SIDE, Clips, against_balls, balls
from drgs.deform.simulate import Simulation
from drgs.scene.asset import Asset
from tests.deform.test_show_grains import looking_down
from tests.render.closed_form_scenes import constant_sky, sphere_mesh


@pytest.fixture(scope="module")
def clips() -> Clips:
    return Clips(Asset(None, sphere_mesh(3), None, constant_sky()), looking_down(torch.zeros(3), SIDE), 600, 4)


def test_balls_have_the_volume_and_the_materials_they_are_given(clips):
    centers, radii = torch.tensor([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]]).double(), torch.tensor([0.1, 0.2]).double()
    made = balls(centers, radii, clips.asset.mesh, torch.tensor([3, 5]))
    placed = made.vertices.double().reshape(2, -1, 3)
    assert torch.allclose(placed.mean(1), centers, atol=1e-6)
    assert placed[1].sub(centers[1]).norm(dim=-1).mean() == pytest.approx(2 * float(placed[0].norm(dim=-1).mean()), rel=1e-5)
    solid = trimesh.Trimesh(made.vertices.double().numpy(), made.faces.numpy(), process=False)
    assert solid.volume == pytest.approx(4 / 3 * math.pi * (0.1**3 + 0.2**3), rel=1e-5)
    assert torch.equal(made.albedo.reshape(2, -1, 3)[1, 0], clips.asset.mesh.albedo[5])


@pytest.mark.slow
@pytest.mark.parametrize("action", MOMENTS)
def test_an_object_is_dropped_twisted_and_torn(clips, action):
    scene = clips.scene(LAWS["jelly"], action)
    assert scene.duration == max(MOMENTS[action]) and (scene.floor is None) == (action != "drop")
    frame = Simulation(clips.asset, scene).at(0.1)
    moved = frame.vertices - clips.asset.mesh.vertices
    rest = clips.asset.mesh.vertices
    if action == "drop":
        assert float(moved[:, 2].mean()) < -0.01
        return
    head, foot = rest[:, 2] > 0.8, rest[:, 2] < -0.8
    assert float(moved[foot].norm(dim=-1).mean()) < 0.2 * float(moved[head].norm(dim=-1).mean())
    if action == "tear":
        assert float(moved[head, 2].mean()) > 0.1
    else:
        assert float(moved[head & (rest[:, 0] > 0.2), 1].mean()) > 0.05 and float(moved[head & (rest[:, 0] < -0.2), 1].mean()) < -0.05


@pytest.mark.slow
def test_a_heap_of_sand_is_near_its_particles(clips):
    simulation = Simulation(clips.asset, clips.scene(LAWS["sand"], "drop"))
    frame = simulation.at(0.6)
    assert frame.parted is not None
    told = against_balls(clips, simulation, clips.picture(clips.posed(frame)))
    # Pixel by pixel the lit pictures differ, for grains lie between the balls; where they lie is bounded.
    assert told["outlines' IoU"] > 0.9 and told["spacings from the nearest ball, median"] < 0.1 and told["95 of 100"] < 0.6
