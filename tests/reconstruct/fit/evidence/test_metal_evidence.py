"""Metal told from paint by pictures of both, drawn by the very formula that is inverted."""

import dataclasses
from collections.abc import Sequence

import pytest
import torch

from drgs.maths.brdf import f0_from_base
from drgs.maths.color import srgb_from_linear
from drgs.maths.constants import F0
from drgs.reconstruct.fit.evidence import metal_evidence as module
from drgs.reconstruct.fit.evidence.metal_evidence import ViewSums, light_scale, metal_evidence, view_sums
from drgs.reconstruct.fit.light.mesh_light import LightOf, at_corners, corner_weights
from drgs.reconstruct.fit.light.split_sum import filter_environment, shade_split_sum
from drgs.reconstruct.fit.light.turned_light import light_of_views, seen_sky
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.mesh import TriangleMesh
from tests.reconstruct.geometry.test_integrate_normals import views_of_a_unit_sphere
from tests.render.closed_form_scenes import sphere_mesh


def light() -> torch.Tensor:
    """(128, 256, 3): a dim room with windows."""
    radiance = torch.full((128, 256, 3), 0.2)
    generator = torch.Generator().manual_seed(1)
    for row, column in zip(
        torch.randint(10, 100, (14,), generator=generator), torch.randint(0, 236, (14,), generator=generator), strict=True
    ):
        radiance[row : row + 14, column : column + 18] = 2 * torch.rand(3, generator=generator)
    return radiance


def open_light(mesh: TriangleMesh, tables: torch.Tensor) -> LightOf:
    """Light that nothing keeps from arriving."""
    return light_of_views(tables, torch.ones_like(mesh.vertices), mesh.albedo, None)


def pictures(mesh: TriangleMesh, tables: torch.Tensor, turned: bool = False, cameras: Sequence[Camera] = ()) -> list[ViewTarget]:
    """Of the sphere, all around.

    Args:
        turned: the light stands still with the camera. cameras: other ones.
    """
    tracer, targets = build_tracer(mesh), []
    for camera in cameras or views_of_a_unit_sphere()[0]:
        turn = camera.camera_from_world[:3, :3] if turned else None
        origin, directions = pixel_rays_world(camera)
        flat = directions.reshape(-1, 3)
        hits = trace_rays(origin.expand_as(flat), flat, tracer)
        hit = hits.hit.nonzero().squeeze(1)
        corners, weights = mesh.faces[hits.face[hit].long()].long(), corner_weights(hits.barycentric[hit])
        normal = torch.nn.functional.normalize(at_corners(mesh.normals, corners, weights), dim=-1)
        albedo, metallic = at_corners(mesh.albedo, corners, weights), at_corners(mesh.metallic, corners, weights)
        radiance = shade_split_sum(
            albedo * (1 - metallic)[:, None], 0 * albedo, f0_from_base(albedo, metallic), at_corners(mesh.roughness, corners, weights),
            normal, -flat[hit], tables, light_from_world=turn,
        )  # fmt: skip
        photo, mask = torch.zeros(len(flat), 3), torch.zeros(len(flat))
        photo[hit], mask[hit] = srgb_from_linear(radiance).clamp(0, 1), 1.0
        size = (camera.height, camera.width)
        photo, mask = photo.view(*size, 3), mask.view(size)
        targets.append(ViewTarget(camera, photo, photo, mask, slice(0, size[0]), slice(0, size[1]), light_from_world=turn))
    return targets


def evidence_of(mesh: TriangleMesh, targets: list[ViewTarget], tables: torch.Tensor) -> torch.Tensor:
    """Under light that nothing keeps from arriving and that stands still."""
    return metal_evidence(view_sums(build_tracer(mesh), targets, open_light(mesh, tables)), mesh_edges(mesh.faces), False)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_each_is_known_for_what_it_is_whatever_was_thought_before(metallic: float):
    mesh = dataclasses.replace(sphere_mesh(subdivisions=3, albedo=0.6, roughness=0.25), metallic=torch.full((642,), metallic))
    tables = filter_environment(light())
    targets = pictures(mesh, tables)
    guessed = dataclasses.replace(mesh, metallic=torch.full((642,), 0.5), albedo=torch.full((642, 3), 0.3))
    evidence = evidence_of(guessed, targets, tables)
    seen = evidence != 0  # the twelve views go around the equator
    assert float(seen.float().mean()) > 0.3
    assert float(((2 * metallic - 1) * evidence > 0.5)[seen].float().mean()) > 0.95


def test_a_sphere_half_of_metal_is_divided_where_it_is():
    mesh = sphere_mesh(subdivisions=4, albedo=0.6, roughness=0.3)
    mesh = dataclasses.replace(mesh, metallic=(mesh.vertices[:, 2] > 0).float())
    tables = filter_environment(light())
    evidence = evidence_of(mesh, pictures(mesh, tables), tables)
    away = (mesh.vertices[:, 2].abs() > 0.3) & (evidence != 0)
    assert int(away.sum()) > 200
    right = (evidence > 0) == (mesh.vertices[:, 2] > 0)
    assert float(right[away].float().mean()) > 0.95


def sums_of_metal_with_a_spot_of_paint(mesh: TriangleMesh, paint_albedo: tuple[float, float, float] = (0.3, 0.3, 0.3)) -> ViewSums:
    """Of twelve views, in each of which metal has another light in its mirror: all is metal but what lies within 0.16 of the pole."""
    count, random = len(mesh.vertices), torch.Generator().manual_seed(0)
    paint = ((mesh.vertices - torch.tensor([0.0, 0.0, 1.0])).norm(dim=1) < 0.16)[:, None]
    e, b = torch.ones(count, 3), torch.zeros(count, 3)
    a = torch.rand(12, 1, 3, generator=random).expand(12, count, 3)
    p = [torch.where(paint, torch.tensor(paint_albedo) * e + F0 * mirrored, 0.7 * mirrored) for mirrored in a]
    terms = [(photo, e, mirrored, b) for photo, mirrored in zip(p, a, strict=True)]
    products = (sum(term[k] * term[m] for term in terms) for k in range(4) for m in range(k, 4))
    return ViewSums(*products, torch.full((count,), 12.0))


def in_random_order(mesh: TriangleMesh) -> TriangleMesh:
    """The same mesh with its vertices renamed, which the solve takes a fortieth of the time for (`factored`)."""
    order = torch.randperm(len(mesh.vertices), generator=torch.Generator().manual_seed(0))
    named = torch.empty_like(order).scatter_(0, order, torch.arange(len(order)))
    by_vertex = {name: getattr(mesh, name)[order] for name in ("vertices", "normals", "albedo", "roughness", "metallic")}
    return dataclasses.replace(mesh, faces=named[mesh.faces.long()].int(), **by_vertex)


@pytest.mark.parametrize("subdivisions", [4, 5, 6])
def test_finer_meshes_decide_alike(monkeypatch: pytest.MonkeyPatch, subdivisions: int):
    """A spot that its surroundings outvote on one mesh is outvoted on meshes of four and sixteen times its faces, too."""
    mesh, coarse = in_random_order(sphere_mesh(subdivisions=subdivisions)), sphere_mesh(subdivisions=4)
    monkeypatch.setattr(module, "EDGES", len(mesh_edges(coarse.faces).vertices))
    told = metal_evidence(sums_of_metal_with_a_spot_of_paint(mesh), mesh_edges(mesh.faces), False)
    assert (
        float(told[mesh.vertices[:, 2].argmax()]) > 0.9
    )  # it was -0.9 on the finest one, and on the next, when each mesh asked three rings


def test_a_spot_of_another_colour_is_not_outvoted(monkeypatch: pytest.MonkeyPatch):
    mesh = sphere_mesh(subdivisions=4)
    edges = mesh_edges(mesh.faces)
    monkeypatch.setattr(module, "EDGES", len(edges.vertices))
    spot = (mesh.vertices - torch.tensor([0.0, 0.0, 1.0])).norm(dim=1) < 0.16
    told = metal_evidence(sums_of_metal_with_a_spot_of_paint(mesh, (0.4, 0.05, 0.03)), edges, False)
    assert float(told[spot].max()) < -0.9 and float(told[~spot].min()) > 0.9


@pytest.mark.parametrize("same_paint", [True, False])
def test_where_light_is_known_badly_what_is_painted_alike_elsewhere_says_of_which_kind(monkeypatch: pytest.MonkeyPatch, same_paint: bool):
    """Around a pole the photographs vary by a tenth as a dim mirror does; all else is paint without doubt."""
    mesh, random = sphere_mesh(subdivisions=4), torch.Generator().manual_seed(0)
    count, edges = len(mesh.vertices), mesh_edges(mesh.faces)
    monkeypatch.setattr(module, "EDGES", len(edges.vertices))
    odd = (mesh.vertices - torch.tensor([0.0, 0.0, 1.0])).norm(dim=1) < 0.5
    paint, elsewhere = torch.tensor([0.4, 0.2, 0.15]), torch.tensor([0.4, 0.2, 0.15] if same_paint else [0.1, 0.2, 0.4])
    e, b, terms = torch.ones(count, 3), torch.zeros(count, 3), []
    for _ in range(12):
        varies = 1 + 0.1 * torch.randn(1, 3, generator=random)
        mirrored = torch.where(odd[:, None], 0.5 * varies, torch.rand(1, 3, generator=random))
        terms.append((torch.where(odd[:, None], paint * varies, elsewhere + F0 * mirrored), e, mirrored, b))
    products = [sum(term[k] * term[m] for term in terms) for k in range(4) for m in range(k, 4)]
    sums = ViewSums(*products, torch.full((count,), 12.0))
    told = metal_evidence(sums, edges, False)
    assert float(told[~odd].max()) < -0.9
    if same_paint:
        assert float(told[odd].median()) < -0.7 and float((told[odd] < 0).float().mean()) > 0.9
        monkeypatch.setattr(module, "ALIKE_ANYWHERE", 0.0)
        told = metal_evidence(sums, edges, False)
    assert float(told[mesh.vertices[:, 2].argmax()]) > 0.5


def test_what_no_view_shows_is_left_open():
    mesh = sphere_mesh(subdivisions=3)
    tables = filter_environment(light())
    evidence = evidence_of(mesh, pictures(mesh, tables)[:1], tables)
    assert float(evidence.abs().max()) == 0.0


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_wrong_normals_do_not_turn_one_into_the_other(metallic: float):
    mesh = dataclasses.replace(sphere_mesh(subdivisions=4, albedo=0.6, roughness=0.25), metallic=torch.full((2562,), metallic))
    tables = filter_environment(light())
    targets = pictures(mesh, tables)
    tilt = 0.15 * torch.sin(9 * mesh.vertices.roll(1, 1))
    tilted = dataclasses.replace(mesh, normals=torch.nn.functional.normalize(mesh.normals + tilt, dim=-1))
    evidence = evidence_of(tilted, targets, tables)
    around = mesh.vertices[:, 2].abs() < 0.6
    assert float(((2 * metallic - 1) * evidence > 0)[around].float().mean()) > 0.98


def test_paint_that_looks_the_same_from_everywhere_is_not_called_metal_for_want_of_proof():
    mesh = sphere_mesh(subdivisions=3, albedo=0.6, roughness=1.0)
    tables = filter_environment(torch.ones(128, 256, 3))
    evidence = evidence_of(mesh, pictures(mesh, tables), tables)
    assert float(evidence.max()) < 0.3


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_under_light_that_turns_with_the_camera_each_is_known_as_well(metallic: float):
    mesh = dataclasses.replace(sphere_mesh(subdivisions=4, albedo=0.6, roughness=0.25), metallic=torch.full((2562,), metallic))
    tables = filter_environment(light())
    targets = pictures(mesh, tables, turned=True)
    tilt = 0.05 * torch.sin(9 * mesh.vertices.roll(1, 1))
    tilted = dataclasses.replace(mesh, normals=torch.nn.functional.normalize(mesh.normals + tilt, dim=-1))
    tracer = build_tracer(tilted)
    light_of = light_of_views(tables, torch.ones_like(mesh.vertices), mesh.albedo, seen_sky(tracer))
    evidence = metal_evidence(view_sums(tracer, targets, light_of), mesh_edges(mesh.faces), True)
    around = mesh.vertices[:, 2].abs() < 0.6
    assert float(((2 * metallic - 1) * evidence > 0)[around].float().mean()) > 0.95


@pytest.mark.parametrize("metallic", [0.0, 1.0])
@pytest.mark.parametrize("wrong", [0.3, 1.0, 3.0])
def test_light_is_found_as_bright_as_it_is_whatever_the_paint_was_thought_to_be(metallic: float, wrong: float):
    mesh = dataclasses.replace(sphere_mesh(subdivisions=3, albedo=0.3, roughness=0.25), metallic=torch.full((642,), metallic))
    targets = pictures(mesh, filter_environment(light()))
    guessed = dataclasses.replace(mesh, albedo=mesh.albedo / wrong if wrong > 1 else mesh.albedo)
    tables = filter_environment(wrong * light())
    sums = view_sums(build_tracer(guessed), targets, open_light(guessed, tables))
    assert light_scale(sums) == (1.0 if wrong == 1 else pytest.approx(1 / wrong, rel=0.1))
    assert light_scale(view_sums(build_tracer(guessed), [], open_light(guessed, tables))) == 1.0  # of nothing nothing follows


@pytest.mark.parametrize(("albedo", "called_metal"), [(0.08, False), (0.4, True)])
def test_no_metal_is_dark(albedo: float, called_metal: bool):
    mesh = dataclasses.replace(sphere_mesh(subdivisions=3, albedo=albedo, roughness=0.25), metallic=torch.ones(642))
    tables = filter_environment(light())
    targets = pictures(mesh, tables)
    tilted = dataclasses.replace(
        mesh, normals=torch.nn.functional.normalize(mesh.normals + 0.15 * torch.sin(9 * mesh.vertices.roll(1, 1)), dim=-1)
    )
    evidence = evidence_of(tilted, targets, tables)
    around = mesh.vertices[:, 2].abs() < 0.6
    assert float(((evidence > 0) == called_metal)[around].float().mean()) > 0.9


def test_what_is_black_in_all_photographs_does_not_dim_the_light():
    mesh = sphere_mesh(subdivisions=3, albedo=0.3, roughness=0.25)
    tables = filter_environment(light())
    black = [dataclasses.replace(target, photo=0 * target.photo, saturation=0 * target.saturation) for target in pictures(mesh, tables)]
    sums = view_sums(build_tracer(mesh), black, open_light(mesh, tables))
    assert light_scale(sums) == 1.0
    assert bool(torch.isfinite(metal_evidence(sums, mesh_edges(mesh.faces), False)).all())
