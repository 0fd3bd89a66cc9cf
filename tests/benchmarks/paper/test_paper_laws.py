"""The clips of three kinds of matter: the sand in them is what its particles are."""

import math

import numpy as np
import pytest
import torch
import trimesh

from benchmarks.paper.laws import FPS, HELD, LAWS, MOMENTS, SIDE, Clips, against_balls, balls, film_pictures, picture_at
from drgs.deform.matter.simulate import Simulation
from drgs.scene.asset import Asset
from tests.deform.matter.test_show_grains import looking_down
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


def test_a_film_shows_all_clips_at_once_and_stays_on_their_ends():
    lengths = {action: picture_at(max(moments)) + 1 for action, moments in MOMENTS.items()}
    assert lengths == {"drop": 0.6 * FPS + 1, "twist": 0.3 * FPS + 1, "tear": 0.4 * FPS + 1}

    def clip(pictures: int) -> list[np.ndarray]:
        """Grey that grows to black, the object 20 pixels wide on the right of the picture."""
        shown = np.ones((pictures, 60, 80, 4)) * [1, 1, 1, 0]
        shown[:, 20:40, 50:70, 3] = 1
        shown[:, 20:40, 50:70, :3] = np.linspace(1, 0, pictures)[:, None, None, None]
        return list(shown)

    film = list(film_pictures({(name, action): clip(lengths[action]) for name in LAWS for action in MOMENTS}))
    assert len(film) == max(lengths.values()) + HELD
    height, width, _ = film[0].shape
    assert len({picture.shape for picture in film}) == 1
    assert width < 3 * 40 and height < 3 * 60, "cut to what is seen"
    black = [[int(np.all(part[16:] < 0.02, axis=-1).sum()) for part in np.array_split(shown[: height // 3], 3, axis=1)] for shown in film]
    # Black is what has ended: the twist first, then the tear, then the drop.
    ended = [[count > 300 for count in counts] for counts in black]
    assert ended[0] == [False] * 3 and ended[lengths["twist"] - 1] == [False, True, False]
    assert ended[lengths["tear"] - 1] == [False, True, True] and ended[lengths["drop"] - 1] == ended[-1] == [True] * 3


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
