import math

import torch

from drgs.render.visible.draw_surfels import draw_surfels, surfel_colors
from drgs.scene.materials import Materials
from drgs.scene.posed_scene import PosedSurfels
from tests.render.closed_form_scenes import front_camera

DISTANCE, FIELD_OF_VIEW, SIDE = 4.0, 0.6, 64
FOCAL = SIDE / 2 / math.tan(FIELD_OF_VIEW / 2)


def facing_surfels(places: list[list[float]], scale: float, opacity: float) -> PosedSurfels:
    count = len(places)
    tangents = scale * torch.tensor([[1.0, 0.0], [0.0, 0.0], [0.0, 1.0]]).expand(count, 3, 2).contiguous()
    materials = Materials(torch.zeros(count, 3), torch.ones(count), torch.zeros(count))
    return PosedSurfels(torch.tensor(places), tangents, torch.full((count,), opacity), materials)


def test_a_surfel_is_an_opaque_disc_of_one_standard_deviation_however_faint_it_is():
    scale = 0.3
    picture = draw_surfels(facing_surfels([[0.0, 0.0, 0.0]], scale, opacity=0.02), front_camera(SIDE, DISTANCE, FIELD_OF_VIEW))
    assert float(picture[SIDE // 2, SIDE // 2, 3]) > 0.98
    radius = scale * FOCAL / DISTANCE
    # The rim is soft by a few tenths of the radius.
    area = float(picture[..., 3].sum())
    assert math.pi * radius**2 < area < 1.7 * math.pi * radius**2
    assert torch.allclose(picture[SIDE // 2, SIDE // 2, :3], surfel_colors(1)[0], atol=0.02)


def test_the_nearest_disc_hides_the_others():
    surfels = facing_surfels([[0.0, 0.5, 0.0], [0.0, -0.5, 0.0]], 0.3, 0.9)
    middle = draw_surfels(surfels, front_camera(SIDE, DISTANCE, FIELD_OF_VIEW))[SIDE // 2, SIDE // 2, :3]
    assert torch.allclose(middle, surfel_colors(2)[1], atol=0.03)


def test_colours_of_surfels_that_follow_each_other_differ():
    colors = surfel_colors(100)
    assert float((colors[1:] - colors[:-1]).abs().sum(-1).min()) > 0.4
