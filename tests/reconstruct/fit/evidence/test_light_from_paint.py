"""Light that was taken for paint is found again, for paint is alike on all sides."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from drgs.reconstruct.fit.evidence.light_from_paint import (
    PaintLightSettings,
    _non_negative,
    light_from_paint,
    spread_of_paint,
    weighted_median,
)
from drgs.reconstruct.fit.light.environment_pyramid import upsampled
from drgs.reconstruct.fit.light.mesh_light import MeshLight
from drgs.reconstruct.fit.light.split_sum import filter_environment, shade_split_sum
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.environment import direction_from_uv
from drgs.scene.mesh import TriangleMesh
from tests.render.closed_form_scenes import sphere_mesh

PAINTS = torch.tensor([[0.5, 0.2, 0.1], [0.1, 0.2, 0.4], [0.3, 0.35, 0.3]])


def lamp_above(strength: float = 12.0) -> torch.Tensor:
    """(128, 256, 3): an even room with a lamp somewhat aside of the pole."""
    v, u = torch.meshgrid((torch.arange(128) + 0.5) / 128, (torch.arange(256) + 0.5) / 256, indexing="ij")
    towards = torch.nn.functional.normalize(torch.tensor([0.5, 0.2, 1.0]), dim=0)
    cosine = (direction_from_uv(torch.stack([u, v], -1)) * towards).sum(-1)
    return 0.3 + strength * (cosine > 0.95).float()[..., None].expand(128, 256, 3)


def irradiance(mesh: TriangleMesh, radiance: torch.Tensor) -> torch.Tensor:
    """(vertex, 3), over pi, where nothing is in the way."""
    black, one = torch.zeros_like(mesh.normals), torch.ones_like(mesh.normals)
    tables, rough = filter_environment(radiance), one[:, 0].contiguous()
    return shade_split_sum(one, black, black, rough, mesh.normals, mesh.normals, tables) - shade_split_sum(
        black, black, black, rough, mesh.normals, mesh.normals, tables
    )


def misread_sphere(true_light: torch.Tensor) -> tuple[TriangleMesh, torch.Tensor, torch.Tensor]:
    """A sphere in patches of three paints, what each vertex truly is, and an even light under which other paint looks the same."""
    mesh = sphere_mesh(subdivisions=4, albedo=0.5, roughness=0.9)
    place = (3 * mesh.vertices).floor().long()
    paint = PAINTS[(place * torch.tensor([1, 2, 5])).sum(1) % 3]
    even = torch.full((128, 256, 3), 1.2)
    taken = paint * irradiance(mesh, true_light) / irradiance(mesh, even)
    return replace(mesh, albedo=taken.clamp(max=0.99), metallic=torch.zeros(len(paint))), paint, even


def found_under(mesh: TriangleMesh, light: torch.Tensor, settings: PaintLightSettings) -> torch.Tensor | None:
    """The environment after light_from_paint."""
    open_light = MeshLight(filter_environment(light), torch.ones_like(mesh.vertices))
    paint = mesh.metallic < 0.5
    factor = light_from_paint(build_tracer(mesh), light, open_light, paint, settings, torch.Generator().manual_seed(0))
    return None if factor is None else light * upsampled(factor.log().permute(2, 0, 1)[None], 128)[0].permute(1, 2, 0).exp()


def unlikeness(mesh: TriangleMesh, paint: torch.Tensor, before: torch.Tensor, after: torch.Tensor) -> float:
    """Standard deviation of the logarithm of albedo over what is true, once the light has changed."""
    albedo = mesh.albedo * irradiance(mesh, before) / irradiance(mesh, after)
    return float((albedo / paint).log().std())


@pytest.mark.slow
def test_a_lamp_that_was_painted_on_is_light_again_after_a_few_calls():
    true_light = lamp_above()
    mesh, paint, light = misread_sphere(true_light)
    first = light
    for _ in range(4):
        found = found_under(
            replace(mesh, albedo=mesh.albedo * irradiance(mesh, first) / irradiance(mesh, light)), light, PaintLightSettings()
        )
        assert found is not None
        light = found
    assert unlikeness(mesh, paint, first, first) > 0.25
    assert unlikeness(mesh, paint, first, light) < 0.08
    lamp = true_light[..., 0] > 1
    assert float(light[lamp].mean()) > 3 * float(light[~lamp].mean())


def underside_after(settings: PaintLightSettings) -> float:
    """Standard deviation of the logarithm of a disc's albedo over what is true, after three calls that began with light from below that is too bright and of
    another colour, under which the disc's lower side was taken for black."""
    ball, squash = sphere_mesh(subdivisions=4, albedo=0.5, roughness=0.9), torch.tensor([1.0, 1.0, 0.12])
    paint = PAINTS[((3 * ball.vertices).floor().long() * torch.tensor([1, 2, 5])).sum(1) % 3]
    disc = replace(
        ball,
        vertices=ball.vertices * squash,
        normals=torch.nn.functional.normalize(ball.normals / squash, dim=1),
        metallic=torch.zeros(len(paint)),
    )
    above = direction_from_uv(torch.stack(torch.meshgrid(*(torch.arange(n) / n for n in (128, 256)), indexing="ij")[::-1], -1))[..., 2:] > 0
    true_light, light = (torch.where(above, torch.ones(3), torch.tensor(below)) for below in ((0.06, 0.05, 0.02), (0.3, 0.3, 0.3)))
    gloss = PaintLightSettings().gloss
    sent = (paint + gloss) * irradiance(disc, true_light)

    def seen_under(light: torch.Tensor) -> torch.Tensor:
        return (sent / irradiance(disc, light) - gloss).clamp(0.004, 0.99)

    assert float((seen_under(light) / paint).log().std()) > 1.4
    for _ in range(3):
        found = found_under(replace(disc, albedo=seen_under(light)), light, settings)
        assert found is not None
        light = found
    return float((seen_under(light) / paint).log().std())


@pytest.mark.slow
def test_the_lower_side_of_a_disc_over_dim_coloured_ground_is_of_the_paint_above():
    """One that hardly any side joins to what is lit from above; paint that is near black comes back only if its gloss is counted, and paint of another colour only
    if it counts as alike at first."""
    assert underside_after(PaintLightSettings()) < 0.06
    assert underside_after(PaintLightSettings(gloss=0.0)) > 0.5
    assert underside_after(PaintLightSettings(alike_at_first=0.0)) > 0.5


@pytest.mark.slow
def test_of_two_lights_the_one_with_fewer_paints_is_taken(monkeypatch: pytest.MonkeyPatch):
    asked = []

    def most(*given: object) -> float:
        asked.append(spread_of_paint(*given))
        return -asked[-1]

    monkeypatch.setattr("drgs.reconstruct.fit.evidence.light_from_paint.spread_of_paint", most)
    assert underside_after(PaintLightSettings()) > 0.5
    assert len(asked) == 6 and asked[0] > asked[1] + 0.1


def test_paint_is_spread_by_how_many_there_are_near_each_other():
    settings = PaintLightSettings()
    two = torch.tensor([[-1.0, -1.0, -1.0], [-1.0, -3.0, -1.0]]).repeat(50, 1)
    here = torch.zeros(100, 3)
    assert spread_of_paint(two[:1].expand(100, 3), here, settings) == pytest.approx(0, abs=1e-5)
    assert spread_of_paint(two, here, settings) == pytest.approx(np.log(2), abs=1e-3)
    apart = torch.tensor([[0.0, 0.0, 0.0], [10.0, 0.0, 0.0]]).repeat(50, 1)
    assert spread_of_paint(two, apart, settings) == pytest.approx(0, abs=1e-3)


def test_the_kernel_narrows_from_round_to_round():
    settings = PaintLightSettings()
    widths = [(own.alike_chroma, own.alike_brightness) for own in map(settings.at_round, range(settings.rounds))]
    assert widths[0] == (settings.alike_at_first, settings.alike_at_first)
    assert widths[-1] == (settings.alike_chroma, settings.alike_brightness)
    assert all(later < sooner for pair in pairwise(widths) for sooner, later in zip(*pair, strict=True))
    wide = PaintLightSettings(alike_chroma=1.0)
    assert {wide.at_round(number).alike_chroma for number in range(wide.rounds)} == {1.0}


def test_the_weighted_median_has_half_of_the_weight_on_either_side():
    values = torch.tensor([[3.0, 1.0], [1.0, 2.0], [2.0, 3.0]])
    assert weighted_median(values, torch.ones(3)).tolist() == [2.0, 2.0]
    assert weighted_median(values, torch.tensor([3.0, 1.0, 1.0])).tolist() == [3.0, 1.0]
    assert weighted_median(values[:1], torch.tensor([0.5])).tolist() == [3.0, 1.0]


@pytest.mark.slow
def test_light_that_is_right_stays_about_as_it_is():
    light = lamp_above(4.0)
    mesh = misread_sphere(light)[0]
    mesh = replace(mesh, albedo=misread_sphere(light)[1])
    found = found_under(mesh, light, PaintLightSettings())
    assert found is not None
    change = (irradiance(mesh, found) / irradiance(mesh, light)).log()
    assert float(change.std()) < 0.03 and abs(float(change.mean())) < 0.02


@pytest.mark.slow
def test_a_white_ball_on_a_grey_one_keeps_its_light():
    light = lamp_above(4.0)
    ball = sphere_mesh(subdivisions=4, albedo=0.75, roughness=0.9)
    count = len(ball.vertices)
    mesh = TriangleMesh(
        torch.cat([ball.vertices, ball.vertices - torch.tensor([0.0, 0.0, 2.1])]),
        torch.cat([ball.faces, ball.faces + count]),
        ball.normals.repeat(2, 1),
        torch.cat([ball.albedo, 0.5 * ball.albedo]),
        ball.roughness.repeat(2),
        torch.zeros(2 * count),
    )

    def change(alike_place: float) -> float:
        """Standard deviation of the logarithm of what irradiance has become."""
        found = found_under(mesh, light, PaintLightSettings(alike_place=alike_place))
        assert found is not None
        return float((irradiance(mesh, found) / irradiance(mesh, light)).log().std())

    kept = change(PaintLightSettings().alike_place)
    assert kept < 0.05
    assert change(1e3) > 2 * kept


@pytest.mark.slow
def test_as_a_whole_it_is_as_bright_as_it_was_but_for_paint_that_would_be_white():
    mesh, _, light = misread_sphere(lamp_above(4.0))
    dim = replace(mesh, albedo=0.5 * mesh.albedo / mesh.albedo.max())
    found = found_under(dim, light, PaintLightSettings())
    assert found is not None
    assert abs(float((irradiance(dim, found) / irradiance(dim, light)).log().mean())) < 0.03
    bright = replace(mesh, albedo=0.99 * mesh.albedo / mesh.albedo.max())
    found = found_under(bright, light, PaintLightSettings(brightest=0.3))
    assert found is not None
    assert float((bright.albedo * irradiance(bright, light) / irradiance(bright, found)).quantile(0.95)) < 0.33


def test_nothing_follows_from_metal_with_little_paint():
    mesh, _, light = misread_sphere(lamp_above())
    metal = replace(mesh, metallic=(mesh.vertices[:, 2] < 0.98).float())
    assert found_under(metal, light, PaintLightSettings()) is None


@pytest.mark.parametrize("dark", ["paint", "light", "all but a lamp's red"])
def test_factors_are_finite_in_the_dark(dark: str):
    mesh, _, light = misread_sphere(lamp_above())
    mesh = replace(mesh, metallic=(mesh.vertices[:, 0] > 0.5).float())
    if dark == "paint":
        mesh = replace(mesh, albedo=torch.full_like(mesh.albedo, 0.005))
    elif dark == "light":
        light = torch.full_like(light, 3e-4)
    else:
        light = lamp_above() * torch.tensor([1.0, 1e-4, 1e-4])
    found = found_under(mesh, light, PaintLightSettings())
    assert found is not None and bool(found.isfinite().all())
    most = PaintLightSettings().most
    assert float((found / light).max()) <= 1.001 * most and float((found / light).min()) >= 0.999 / most


@pytest.mark.parametrize("hold", [0.0, 0.1])
def test_the_solve_is_that_of_active_sets(hold: float):
    random = np.random.default_rng(0)
    matrix, wanted = random.uniform(0, 1, (60, 12)), random.normal(0.4, 1, 60)
    home, held = random.uniform(0, 1, 12), hold * random.uniform(0.5, 1, 12)
    rows = np.concatenate([matrix / np.sqrt(60), np.diag(np.sqrt(held))])
    right = nnls(rows, np.concatenate([wanted / np.sqrt(60), np.sqrt(held) * home]))[0]
    found = _non_negative(*(torch.from_numpy(part) for part in (matrix, wanted, held, home, home)), 4000)
    assert float(np.abs(found.numpy() - right).max()) < 1e-3 and (right == 0).any()
