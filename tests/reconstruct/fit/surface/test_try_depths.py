"""Trials sink what is too fat, raise what is too thin, leave what is right, and move nothing when they are stopped."""

import dataclasses

import pytest
import torch
from torch import Tensor

from drgs.reconstruct.fit.surface.fit_surface import SurfaceRates, SurfaceSettings, start_surface
from drgs.reconstruct.fit.surface.try_depths import TrialSettings, TriedDepths, agreed_depth, preferred_depth, try_depths
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs.scene.views import Views
from tests.reconstruct.fit.painted_sphere import CENTER, grey_light, painted_views, placed_sphere
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.reconstruct.tiny_capture import SPHERE_RADIUS

PIXEL = 1 / 16
"""Of a photograph, as a share of the sphere's radius."""
SETTINGS = TrialSettings(
    screen=(-0.06, 0.06),
    depths=(-0.12, -0.08, -0.04, 0.04, 0.08, 0.12, 0.16),
    steps=20,
    rates=SurfaceRates(normals=0.005, albedo_logits=0.2, environment=0.0),  # the paint is not known at the start
    share_rays=4,
    spread=0.06,
)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Views:
    return painted_views(tmp_path_factory.mktemp("painted"), 8)


def with_bump(height: float) -> tuple[TriangleMesh, Tensor]:
    """The painted sphere, fatter by `height` of its radius on one side, and how much of the bump each vertex has (0..1)."""
    sphere = placed_sphere(subdivisions=4)
    direction = (sphere.vertices - CENTER) / SPHERE_RADIUS
    share = ((direction[:, 0] - 0.6) / 0.2).clamp(0, 1)
    vertices = sphere.vertices + (height * SPHERE_RADIUS * share)[:, None] * direction
    return dataclasses.replace(sphere, vertices=vertices, normals=vertex_normals(vertices, sphere.faces)), share


def start(mesh: TriangleMesh) -> dict[str, Tensor]:
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    return dict(start_surface(surfels, mesh, grey_light(), SurfaceSettings(), SPHERE_RADIUS).parameters)


def tried(views: Views, mesh: TriangleMesh, settings: TrialSettings) -> TriedDepths:
    found = try_depths(views, start(mesh), mesh.faces, settings, SPHERE_RADIUS, seed=3)
    assert found is not None
    return found


def off(vertices: Tensor) -> Tensor:
    """(vertex,) how far out, of the radius."""
    return (vertices - CENTER).norm(dim=1) / SPHERE_RADIUS - 1


@pytest.mark.slow
@pytest.mark.parametrize("height", [0.12, -0.08])
def test_what_is_too_far_out_or_in_moves_to_where_it_belongs_and_the_rest_stays(views: Views, height: float):
    mesh, share = with_bump(height)
    # Each depth is a fit of its own: those of the other side are left to the other bump, but for one.
    settings = dataclasses.replace(SETTINGS, depths=tuple(depth for depth in SETTINGS.depths if height * depth > 0 or abs(depth) < 0.05))
    found = tried(views, mesh, settings)
    top, rest = share > 0.9, share == 0
    ratios = dict(zip(settings.depths, found.ratios[top].nanmedian(0).values.tolist(), strict=True))
    assert min(ratios, key=ratios.__getitem__) == height
    assert abs(float(off(found.parameters["vertices"])[top].mean())) < 0.6 * abs(height)
    assert float(off(found.parameters["vertices"])[rest].abs().mean()) < 0.1 * PIXEL


@pytest.mark.slow
@pytest.mark.parametrize("loose", [0.0, 1e9])
def test_no_place_may_be_loose_and_every_place_may(views: Views, loose: float):
    """Of a view that sees none of the loose places nothing is compared."""
    mesh = placed_sphere()
    settings = dataclasses.replace(SETTINGS, loose=loose, steps=2, depths=(-0.04, 0.04))
    found = try_depths(views, start(mesh), mesh.faces, settings, SPHERE_RADIUS, 3)
    assert found is not None and bool((found.loose == (loose > 0)).all())
    assert torch.isfinite(found.parameters["vertices"]).all() and (loose > 0 or not found.depth.any())


@pytest.mark.slow
def test_trials_that_are_told_to_stop_move_nothing(views: Views):
    mesh, _ = with_bump(0.12)
    told: list[int] = []
    found = try_depths(
        views, start(mesh), mesh.faces, SETTINGS, SPHERE_RADIUS, 3, lambda r: told.append(r.iteration), lambda: len(told) >= 2
    )
    assert found is None and told == [1, 2]


def test_the_preferred_depth_is_the_parabolas_and_what_is_not_known_weighs_nothing():
    depths = torch.tensor([-0.02, -0.008, 0.0, 0.008, 0.02, 0.035])
    at = torch.tensor([0.006, -0.012, 0.05])
    ratios = 0.9 + 0.25 * ((depths - at[:, None]) / 0.01) ** 2
    best, curvature = preferred_depth(depths, torch.cat([ratios, torch.full((1, 6), torch.nan)]))
    torch.testing.assert_close(best[:2], at[:2])
    assert float(best[2]) == pytest.approx(0.035)  # no deeper than was tried
    torch.testing.assert_close(curvature[:2], torch.tensor([0.25, 0.25]))
    assert float(curvature[3]) == 0


def test_only_minima_between_what_was_tried_are_followed():
    settings = TrialSettings(depths=(-0.02, 0.02, 0.04))
    between, at_deepest, at_shallowest = [2.0, 0.5, 1.5], [2.0, 0.8, 0.4], [0.4, 1.5, 2.0]
    ratios = torch.tensor([between, at_deepest, at_shallowest])
    depth = agreed_depth(ratios, torch.ones(3, dtype=torch.bool), settings, lambda weight, wish: wish)
    assert depth[0] > 0.01
    assert depth[1] == depth[2] == 0
