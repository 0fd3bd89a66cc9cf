"""What fills a hollow is taken out where photographs show the hollow, and nowhere else."""

import dataclasses
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from drgs.reconstruct.fit.surface import try_sheets as sheets
from drgs.reconstruct.fit.surface.fit_surface import SurfaceRates, SurfaceSettings, start_surface
from drgs.reconstruct.fit.surface.try_depths import TrialSettings
from drgs.reconstruct.fit.surface.try_sheets import SheetSettings, TriedSheets, try_sheets
from drgs.reconstruct.geometry.extract_mesh import MeshSettings
from drgs.scene.mesh import TriangleMesh, vertex_normals
from drgs.scene.views import Views
from tests.reconstruct.fit.painted_sphere import CENTER, grey_light, painted_views, placed_sphere
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.reconstruct.tiny_capture import SPHERE_RADIUS

PIXEL = 1 / 16
"""Of a photograph, as a share of the sphere's radius."""
FILLED = 0.12
"""Of the sphere's radius."""
SETTINGS = SheetSettings(
    shares=(0.5, 1.0),
    trials=TrialSettings(steps=24, rates=SurfaceRates(normals=0.005, albedo_logits=0.2, environment=0.0), share_rays=4, spread=0.06),
)
MESH = MeshSettings(resolution=60, face_limit=8000, smoothing_passes=0)


@pytest.fixture(scope="module")
def views(tmp_path_factory: pytest.TempPathFactory) -> Views:
    return painted_views(tmp_path_factory.mktemp("painted"), 12)


def patch_of(mesh: TriangleMesh, side: float) -> Tensor:
    """(vertex,) 0..1: how much of a patch around one end of the first axis each vertex has."""
    return ((side * (mesh.vertices - CENTER)[:, 0] / SPHERE_RADIUS - 0.6) / 0.2).clamp(0, 1)


def with_filling() -> TriangleMesh:
    """The painted sphere, fatter on one side."""
    sphere = placed_sphere(subdivisions=4)
    vertices = CENTER + (1 + FILLED * patch_of(sphere, 1.0))[:, None] * (sphere.vertices - CENTER)
    return dataclasses.replace(sphere, vertices=vertices, normals=vertex_normals(vertices, sphere.faces))


def tried(views: Views, mesh: TriangleMesh, monkeypatch: pytest.MonkeyPatch, should_stop=None, told=None, metal=1.0) -> TriedSheets | None:
    """With fillings all over two sides, of which one was filled."""
    patch = torch.maximum(patch_of(placed_sphere(subdivisions=4), 1.0), patch_of(placed_sphere(subdivisions=4), -1.0))
    inward = -torch.nn.functional.normalize(mesh.vertices - CENTER, dim=-1)

    def emptied(vertices, fillings, share, around):
        return vertices + (FILLED * share * SPHERE_RADIUS * patch)[:, None] * inward, patch > 0

    monkeypatch.setattr(sheets, "find_fillings", lambda *_: [SimpleNamespace(vertices=patch.nonzero().squeeze(1))])
    monkeypatch.setattr(sheets, "emptied", emptied)
    surfels = surfel_sphere(600, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    parameters = dict(start_surface(surfels, mesh, grey_light(), SurfaceSettings(), SPHERE_RADIUS).parameters)
    parameters["metal"] = torch.full_like(parameters["metal"], metal)
    return try_sheets(views, parameters, mesh.faces, SETTINGS, MESH, SPHERE_RADIUS, 3, told, should_stop)


@pytest.mark.slow
def test_what_was_filled_is_emptied_by_the_right_share_and_what_was_right_stays(views: Views, monkeypatch: pytest.MonkeyPatch):
    mesh = with_filling()
    told: list[tuple[int, int]] = []
    found = tried(views, mesh, monkeypatch, told=lambda r: told.append((r.iteration, r.iterations)))
    assert found is not None
    off = (found.parameters["vertices"] - CENTER).norm(dim=1) / SPHERE_RADIUS - 1
    was_filled, right = patch_of(mesh, 1.0) > 0.99, patch_of(mesh, -1.0) > 0.9
    assert float(off[was_filled].abs().mean()) < 0.2 * FILLED
    assert float(off[right].abs().mean()) < 0.1 * PIXEL and float(found.moved[right].float().mean()) < 0.1
    assert told[-1] == (SETTINGS.iterations, SETTINGS.iterations) and [done for done, _ in told] == list(range(1, len(told) + 1))


@pytest.mark.slow
def test_told_to_stop_they_move_nothing(views: Views, monkeypatch: pytest.MonkeyPatch):
    told: list[int] = []
    stops = (SETTINGS.trials.steps // 2, SETTINGS.trials.steps + 2)
    for after in stops:
        told.clear()
        found = tried(views, with_filling(), monkeypatch, lambda after=after: len(told) >= after, lambda r: told.append(r.iteration))
        assert found is None and len(told) == after


def test_fillings_of_paint_are_not_tried(monkeypatch: pytest.MonkeyPatch):
    mesh = with_filling()
    found = tried(Views((), (), (), None, None, False, "none"), mesh, monkeypatch, metal=-1.0)
    assert found is not None and not found.moved.any() and torch.equal(found.parameters["vertices"], mesh.vertices)


def test_a_surface_without_fillings_stays():
    mesh = placed_sphere()
    surfels = surfel_sphere(60, radius=SPHERE_RADIUS, center=tuple(CENTER.tolist()))
    parameters = dict(start_surface(surfels, mesh, grey_light(), SurfaceSettings(), SPHERE_RADIUS).parameters)
    found = try_sheets(Views((), (), (), None, None, False, "none"), parameters, mesh.faces, SETTINGS, MESH, SPHERE_RADIUS, 3)
    assert found is not None and not found.moved.any()
    assert all(torch.equal(found.parameters[name], value) for name, value in parameters.items())
