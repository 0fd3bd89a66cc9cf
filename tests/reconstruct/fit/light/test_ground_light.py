"""A ground as light: where rays meet it, and that all who ask what a ray meets see the same of it."""

import math

import pytest
import torch

from drgs.maths.color import linear_from_srgb
from drgs.reconstruct.fit.light.ground_light import GroundLight, environment_with_ground, fitted_ground, ground_light
from drgs.reconstruct.fit.light.mesh_light import MeshLight, light_of_rays, mirrored_light, radiance_along
from drgs.reconstruct.fit.light.split_sum import ENVIRONMENT_SIZE, filter_environment, texel_directions
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.scene.ground import Ground
from drgs.scene.mesh import TriangleMesh
from tests.render.closed_form_scenes import sphere_mesh

SIDE, HALF, HEIGHT = 64, 4.0, -1.5
MIDDLE = torch.tensor([0.3, -0.2, HEIGHT])
TURN = 0.4
"""[radians] of the ground's axes about the vertical one."""


def smooth_ground(known: bool = True) -> Ground:
    """Horizontal, of a colour that is linear in the place in linear light, along its own axes; without `known` its half where the first is negative."""
    x = (torch.arange(SIDE) + 0.5) / SIDE
    row, column = torch.meshgrid(x, x, indexing="ij")
    linear = torch.stack([0.2 + 0.5 * column, 0.2 + 0.5 * row, torch.full_like(row, 0.3)])
    srgb = torch.where(linear > 0.0031308, 1.055 * linear ** (1 / 2.4) - 0.055, 12.92 * linear)
    axes = torch.tensor([[math.cos(TURN), math.sin(TURN), 0.0], [-math.sin(TURN), math.cos(TURN), 0.0]])
    there = torch.ones(1, SIDE, SIDE) if known else (column > 0.5).float()[None]
    return Ground(MIDDLE, axes, HALF, srgb, there)


def color_at(ground: Ground, points: torch.Tensor) -> torch.Tensor:
    """(point, 3) linear, of points on it."""
    u, v = (((points - ground.middle) @ ground.axes.T) / ground.half / 2 + 0.5).unbind(-1)
    return torch.stack([0.2 + 0.5 * u, 0.2 + 0.5 * v, torch.full_like(u, 0.3)], -1)


def test_rays_see_the_place_where_they_meet_it() -> None:
    generator = torch.Generator().manual_seed(0)
    origins = torch.randn(500, 3, generator=generator)
    directions = torch.nn.functional.normalize(torch.randn(500, 3, generator=generator), dim=-1)
    ground = smooth_ground()
    met, radiance = ground_light(ground, torch.device("cpu")).along(origins, directions)
    reach = (HEIGHT - origins[:, 2]) / directions[:, 2]
    points = origins + reach[:, None] * directions
    within = (((points - MIDDLE) @ ground.axes.T).abs() < HALF).all(1)
    expected = (origins[:, 2] > HEIGHT) & (directions[:, 2] < 0) & within
    assert torch.equal(met, expected) and 0.2 < float(met.float().mean()) < 0.5
    inner = met & (((points - MIDDLE) @ ground.axes.T).abs() < HALF * (1 - 1 / SIDE)).all(1)
    torch.testing.assert_close(radiance[inner], color_at(ground, points)[inner], atol=2e-3, rtol=0)
    assert float(radiance[~met].abs().max()) == 0


def test_where_the_ground_is_not_known_there_is_none() -> None:
    ground = smooth_ground(known=False)
    light = ground_light(ground, torch.device("cpu"))
    places = torch.linspace(-0.9, 0.9, 37)[:, None] * HALF * ground.axes[0] + MIDDLE
    down = torch.tensor([0.0, 0, -1]).expand(37, 3)
    met, radiance = light.along(places - down, down)
    assert torch.equal(met, ((places - MIDDLE) @ ground.axes[0]) > 0)
    torch.testing.assert_close(
        radiance[met], color_at(ground, places)[met], atol=5e-3, rtol=0
    )  # to half a texel, and not mixed with what is not there


def mirror_ball() -> TriangleMesh:
    ball = sphere_mesh(subdivisions=4)
    count = len(ball.vertices)
    return TriangleMesh(ball.vertices, ball.faces, ball.normals, torch.ones(count, 3), torch.full((count,), 0.01), torch.ones(count))


@pytest.fixture(scope="module")
def light() -> MeshLight:
    ball = mirror_ball()
    tables = filter_environment(torch.full((*ENVIRONMENT_SIZE, 3), 2.0))
    return MeshLight(tables, torch.ones_like(ball.vertices), ground=ground_light(smooth_ground(), torch.device("cpu")))


def test_a_mirror_ball_shows_the_ground_below_it_and_the_sky_above(light: MeshLight) -> None:
    ball = mirror_ball()
    tracer = build_tracer(ball)
    generator = torch.Generator().manual_seed(1)
    origins = torch.nn.functional.normalize(torch.randn(400, 3, generator=generator) * torch.tensor([1, 1, 0.3]), dim=-1) * 3
    along = torch.nn.functional.normalize(0.7 * torch.rand(400, 3, generator=generator) - 0.35 - origins, dim=-1)
    hits = trace_rays(origins, along, tracer)
    face, barycentric = hits.face[hits.hit].long(), hits.barycentric[hits.hit]
    weights = torch.cat([1 - barycentric.sum(-1, keepdim=True), barycentric], -1)
    transmittance, met = mirrored_light(tracer, face, weights, -along[hits.hit], light, generator)

    places = (ball.vertices[ball.faces[face].long()] * weights[..., None]).sum(1)
    normals = torch.nn.functional.normalize((ball.normals[ball.faces[face].long()] * weights[..., None]).sum(1), dim=-1)
    mirrored = along[hits.hit] - 2 * (along[hits.hit] * normals).sum(-1, keepdim=True) * normals
    expected_met, expected = light.ground.along(places, mirrored) if light.ground else (None, None)
    assert expected_met is not None and expected is not None
    clear = mirrored[:, 2].abs() > 0.2  # at the horizon a hair decides
    assert torch.equal(transmittance[clear] == 0, expected_met[clear])
    both = clear & expected_met
    assert int(both.sum()) > 30 and int((~expected_met & clear).sum()) > 30
    torch.testing.assert_close(met[both], expected[both], atol=0.02, rtol=0)
    assert float(met[transmittance == 1].abs().max()) == 0


def test_all_who_ask_what_a_ray_meets_see_the_same_ground(light: MeshLight) -> None:
    tracer = build_tracer(mirror_ball())
    generator = torch.Generator().manual_seed(2)
    up = torch.nn.functional.normalize(torch.randn(50, 3, generator=generator), dim=-1)
    directions = torch.nn.functional.normalize(torch.randn(50, 20, 3, generator=generator), dim=-1)
    transmittance, met = light_of_rays(tracer, 1.01 * up, up, directions, torch.ones(50, 20), light)
    counts = (directions * up[:, None]).sum(-1) > 0
    alone = radiance_along(tracer, (1.01 * up)[:, None].expand_as(directions)[counts].contiguous(), directions[counts].contiguous(), light)
    torch.testing.assert_close(transmittance[counts], alone[0])
    torch.testing.assert_close(met[counts], alone[1])
    assert 0.1 < float((alone[0] == 0).float().mean()) < 0.7


def test_the_environment_shows_the_ground_as_a_point_sees_it_and_nothing_else_of_it() -> None:
    radiance, ground, point = torch.full((*ENVIRONMENT_SIZE, 3), 2.0), smooth_ground(), torch.tensor([0.1, 0.2, 0.0])
    shown = environment_with_ground(radiance, ground_light(ground, torch.device("cpu")), point)
    directions = texel_directions(ENVIRONMENT_SIZE[0])
    assert torch.equal(shown[directions[..., 2] >= 0], radiance[directions[..., 2] >= 0])
    below = directions[-1, 0]
    torch.testing.assert_close(shown[-1, 0], color_at(ground, (point + below * (HEIGHT / below[2]))[None])[0], atol=2e-3, rtol=0)


def test_the_fitted_picture_is_ground_where_it_covers() -> None:
    ground = smooth_ground()
    color, cover = torch.rand(3, SIDE, SIDE, generator=torch.Generator().manual_seed(3)), torch.full((1, SIDE, SIDE), 0.9)
    cover[:, : SIDE // 2] = 0.2
    fitted = fitted_ground(torch.logit(torch.cat([color.clamp(0.02, 0.98), cover]))[None], ground)
    torch.testing.assert_close(fitted.color_srgb, color.clamp(0.02, 0.98))
    assert torch.equal(fitted.known, (cover > 0.5).float())
    light: GroundLight = ground_light(fitted, torch.device("cpu"))
    torch.testing.assert_close(light.texels[-1, 0, :3], linear_from_srgb(fitted.color_srgb)[:, -1, 0])
    assert float(light.texels[0].abs().max()) == 0
