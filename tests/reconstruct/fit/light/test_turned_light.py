"""Light that turns with the camera: shares of the sky that arrive, against those that are sampled for one light, and against turning everything."""

import dataclasses
import math

import pytest
import torch

from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reconstruct.fit.light.mesh_light import BRIGHTEST_SHARE, MeshLight, irradiance_share
from drgs.reconstruct.fit.light.split_sum import ENVIRONMENT_SIZE, filter_environment, shade_split_sum, texel_directions
from drgs.reconstruct.fit.light.turned_light import (
    BOUNCES,
    COARSE,
    FINE,
    Fineness,
    HiddenSky,
    SeenSky,
    arriving_share,
    even_directions,
    light_of_views,
    seen_sky,
)
from drgs.reconstruct.fit.light.turned_light_kernels import SUM_ROWS
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reference.split_sum import split_tables
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment, environment_radiance, turned_environment
from drgs.scene.mesh import TriangleMesh
from tests.reconstruct.fit.light.test_mesh_light import black_spheres

TURN = rotation_from_quat_wxyz(torch.nn.functional.normalize(torch.tensor([[0.8, 0.3, -0.4, 0.6]]), dim=-1))[0]


def smooth_sky() -> Environment:
    """Bright on one side, coloured, and nowhere black."""
    direction = texel_directions(ENVIRONMENT_SIZE[0])
    towards = (direction * torch.tensor([0.6, -0.5, 0.62])).sum(-1).clamp(min=0)
    return Environment(0.2 + towards[..., None] ** 2 * torch.tensor([3.0, 2.0, 1.0]))


def spheres(albedo: float) -> TriangleMesh:
    mesh = black_spheres(2.3)
    return dataclasses.replace(mesh, albedo=torch.full_like(mesh.albedo, albedo))


@pytest.mark.parametrize("albedo", [0.0, 0.8])
def test_shares_are_those_that_are_sampled_for_the_light_as_it_is_turned(albedo: float) -> None:
    mesh = spheres(albedo)
    tracer = build_tracer(mesh)
    found = arriving_share(seen_sky(tracer), mesh.albedo, filter_environment(smooth_sky().radiance), TURN)
    turned = turned_environment(smooth_sky(), TURN)
    turned = Environment(turned.radiance.view(*ENVIRONMENT_SIZE[:1], 2, ENVIRONMENT_SIZE[1], 2, 3).mean((1, 3)))
    light = MeshLight(filter_environment(turned.radiance), torch.ones_like(mesh.vertices))
    generator = torch.Generator().manual_seed(0)
    for _ in range(3):
        light = dataclasses.replace(light, open_share=irradiance_share(tracer, turned, light, 256, generator))
    sampled = light.open_share
    hidden = sampled[:, 0] < 0.95
    assert int(hidden.sum()) > 15
    assert float((found - sampled).abs()[hidden].mean()) < 0.03
    assert float((found - sampled).abs().mean()) < 0.015


def share_twin(
    sky: SeenSky,
    albedo: torch.Tensor,
    tables: torch.Tensor,
    turn: torch.Tensor,
    normals: torch.Tensor | None = None,
    *,
    by_table: bool = True,
) -> torch.Tensor:
    """The specification, by whole matrices: what is sent from vertex to vertex, and which directions are open.

    Args:
        by_table: all of the sky about a normal is looked up in a table of such sums; False: summed itself.
    """
    own, tables, turn = sky.hidden.normals.double(), tables.double(), turn.double()
    all_of_it, left = from_sky(sky.hidden, own if normals is None else normals, tables, turn, by_table)
    with torch.no_grad():
        direct, sent_back = from_sky(sky.coarse, own, tables, turn, by_table)[1], 0.0
        for _ in range(BOUNCES):
            sent_back = exchanged(sky) @ (albedo.double() * (direct + sent_back))
    share = ((left + sent_back) / all_of_it).clamp(0, BRIGHTEST_SHARE)
    return torch.where(sky.hidden.first_met.diff()[:, None] > 0, share, torch.ones_like(share))


def receivers(sky: HiddenSky) -> torch.Tensor:
    """Of each direction in which something is met."""
    return torch.repeat_interleave(torch.arange(len(sky.normals)), sky.first_met.diff().long())


def from_sky(
    sky: HiddenSky, normals: torch.Tensor, tables: torch.Tensor, turn: torch.Tensor, by_table: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """Over pi, all of it and what is left of it."""
    directions = sky.directions.double()
    radiance = environment_radiance(Environment(split_tables(tables)[0][sky.fineness.lobe]), directions @ turn.T) * (4 / len(directions))
    met = torch.zeros(len(normals), len(directions), dtype=torch.float64)
    met[receivers(sky), sky.met_direction.long()] = 1
    about = Environment((texel_directions(SUM_ROWS).double() @ directions.T).clamp(min=0) @ radiance)
    cosines = (normals @ directions.T).clamp(min=0)
    all_of_it = environment_radiance(about, normals) if by_table else cosines @ radiance
    return all_of_it, (all_of_it - (cosines * met) @ radiance).clamp(min=0)


def exchanged(sky: SeenSky) -> torch.Tensor:
    """What vertices receive of others' radiance times pi."""
    coarse = sky.coarse
    count, receiver = len(coarse.normals), receivers(coarse)
    cosines = (coarse.normals @ coarse.directions.T).double()[receiver, coarse.met_direction.long()] * (4 / len(coarse.directions))
    return torch.zeros(count, count, dtype=torch.float64).index_put((receiver, sky.sender.long()), cosines, accumulate=True)


@pytest.mark.parametrize("fineness", [COARSE, FINE], ids=["coarse", "fine"])
def test_shares_are_those_of_whole_matrices(fineness: Fineness) -> None:
    mesh = spheres(0.8)
    albedo = mesh.albedo * torch.linspace(0.2, 1.0, len(mesh.vertices))[:, None]
    sky, tables = seen_sky(build_tracer(mesh), fineness), filter_environment(smooth_sky().radiance)
    assert int(sky.coarse.first_met[-1]) == len(sky.sender) > 1000
    found = arriving_share(sky, albedo, tables, TURN)
    torch.testing.assert_close(found.double(), share_twin(sky, albedo, tables, TURN), atol=2e-6, rtol=0)


def lamp_and_sky() -> Environment:
    """smooth_sky with a lamp that spheres hide from each other where TURN takes it."""
    sky = smooth_sky().radiance.clone()
    direction = texel_directions(ENVIRONMENT_SIZE[0])
    sky[(direction @ (TURN @ torch.tensor([1.0, 0.0, 0.1]))) > 0.95] += 20.0
    return Environment(sky)


@pytest.mark.parametrize("fineness", [COARSE, FINE], ids=["coarse", "fine"])
def test_shares_of_fitted_normals_and_their_slopes_are_those_of_whole_matrices(device: str, fineness: Fineness) -> None:
    mesh, generator = spheres(0.8), torch.Generator().manual_seed(3)
    sky, tables = seen_sky(build_tracer(mesh), fineness), filter_environment(lamp_and_sky().radiance)
    random = torch.randn(mesh.vertices.shape, generator=generator)
    tilted = torch.nn.functional.normalize(mesh.normals + 0.2 * random, dim=-1)
    pull = torch.rand(tilted.shape, generator=generator) - 0.4
    leaves = [x.double().requires_grad_(True) for x in (tables, tilted)]
    wanted = share_twin(sky, mesh.albedo, leaves[0], TURN, leaves[1])
    wanted_slopes = torch.autograd.grad((wanted * pull).sum(), leaves)
    assert float((wanted.detach() - share_twin(sky, mesh.albedo, tables, TURN)).abs().max()) > 0.1  # normals matter

    own_sky = seen_sky(build_tracer(TriangleMesh(**{name: value.to(device) for name, value in mesh.columns.items()})), fineness)
    own = [x.to(device).requires_grad_(True) for x in (tables, tilted)]
    found = arriving_share(own_sky, mesh.albedo.to(device), own[0], TURN.to(device), own[1])
    slopes = torch.autograd.grad((found * pull.to(device)).sum(), own)
    torch.testing.assert_close(found.detach().cpu().double(), wanted.detach(), atol=5e-5, rtol=0)
    for slope, expected in zip(slopes, wanted_slopes, strict=True):
        assert float(expected.abs().max()) > 0
        error = (slope.cpu().double() - expected).abs() / (expected.abs() + 1e-2 * expected.abs().max())
        assert float(error.max()) < 1e-2 and float(error.median()) < 1e-4


def test_without_a_turn_an_open_vertex_has_all_of_the_sky() -> None:
    mesh = spheres(0.5)
    share = arriving_share(seen_sky(build_tracer(mesh)), mesh.albedo, filter_environment(smooth_sky().radiance), torch.eye(3))
    away = mesh.vertices[:, 0] < -0.2
    torch.testing.assert_close(share[away], torch.ones_like(share[away]), atol=1e-5, rtol=0)


def test_shading_under_a_turned_light_is_that_under_the_light_that_the_world_sees() -> None:
    generator = torch.Generator().manual_seed(1)
    normal, wo = (torch.nn.functional.normalize(torch.randn(200, 3, generator=generator), dim=-1) for _ in range(2))
    wo = torch.where((normal * wo).sum(-1, keepdim=True) < 0, -wo, wo)
    roughness = 0.3 + 0.7 * torch.rand(200, generator=generator)
    colour = torch.rand(200, 3, generator=generator)
    sky = smooth_sky()
    turned = turned_environment(sky, TURN).radiance.view(*ENVIRONMENT_SIZE[:1], 2, ENVIRONMENT_SIZE[1], 2, 3).mean((1, 3))
    inputs = (colour, torch.zeros_like(colour), 0.5 * colour, roughness, normal, wo)
    by_turn = shade_split_sum(*inputs, filter_environment(sky.radiance), light_from_world=TURN)
    in_world = shade_split_sum(*inputs, filter_environment(turned))
    relative = (by_turn / in_world - 1).abs()  # what resampling the table leaves
    assert float(relative.mean()) < 0.01 and float(relative.max()) < 0.05


def test_each_photograph_has_its_own_light_only_where_light_turns() -> None:
    mesh = spheres(0.5)
    tracer, tables, ones = build_tracer(mesh), filter_environment(smooth_sky().radiance), torch.ones_like(mesh.vertices)
    camera = Camera(torch.eye(4), torch.eye(3), 4, 4, "a")
    photo = torch.zeros(4, 4, 3)
    one, other = (
        ViewTarget(camera, photo, photo, photo[..., 0], slice(0, 4), slice(0, 4), light_from_world=turn) for turn in (torch.eye(3), TURN)
    )
    still, turning = (light_of_views(tables, ones, mesh.albedo, sky) for sky in (None, seen_sky(tracer)))
    assert still(one) is still(other) and still(one).light_from_world is None
    assert not torch.allclose(turning(one).open_share, turning(other).open_share)
    assert torch.equal(turning(other).light_from_world, TURN)


def test_directions_are_even() -> None:
    directions = even_directions(192)
    nearest = (directions @ directions.T - 2 * torch.eye(192)).max(1).values.acos()
    spacing = math.sqrt(4 * math.pi / 192)
    assert float(nearest.min()) > 0.7 * spacing and float(nearest.max()) < 1.3 * spacing
    assert float(directions.mean(0).norm()) < 0.01
