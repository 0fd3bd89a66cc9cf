"""Fine patterns of albedo from pictures drawn by the very formula that is inverted."""

import dataclasses

import pytest
import torch

from drgs.reconstruct.fit.evidence.solve_albedo import DetailSettings, SolvedAlbedo, parts_for, solve_albedo
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.albedo_detail import MOST_PARTS, detailed_albedo, sample_places
from drgs.scene.camera import scaled_camera
from drgs.scene.mesh import TriangleMesh
from tests.reconstruct.fit.evidence.test_metal_evidence import light, open_light, pictures
from tests.render.closed_form_scenes import sphere_mesh

RINGS = 8


def striped(metallic: float) -> tuple[TriangleMesh, TriangleMesh]:
    """A ball with stripes four edges wide, and the same with its albedo blurred and a quarter too dark."""
    mesh = sphere_mesh(subdivisions=4, albedo=0.5, roughness=0.4)
    azimuth = torch.atan2(mesh.vertices[:, 1], mesh.vertices[:, 0])
    albedo = (0.5 + 0.25 * torch.sign(torch.sin(10 * azimuth)))[:, None].repeat(1, 3)
    blurred = averaged(averaging_matrix(mesh_edges(mesh.faces), len(albedo)), albedo, 3 * RINGS)
    mesh = dataclasses.replace(mesh, albedo=albedo, metallic=torch.full_like(mesh.metallic, metallic))
    return mesh, dataclasses.replace(mesh, albedo=0.75 * blurred)


def solved(mesh: TriangleMesh, targets: list[ViewTarget], tables: torch.Tensor, parts: int = 1, rings: int = RINGS) -> SolvedAlbedo:
    """Under light that nothing keeps from arriving, from photographs that were no larger when they were taken."""
    return solve_albedo(build_tracer(mesh), targets, targets.__getitem__, open_light(mesh, tables), mesh_edges(mesh.faces), rings, parts)


@pytest.mark.parametrize("metallic", [0.0, 1.0])
def test_stripes_come_back_and_what_is_wrong_everywhere_stays(metallic: float) -> None:
    mesh, blurred = striped(metallic)
    tables = filter_environment(light())
    solution = solved(blurred, pictures(mesh, tables), tables)
    assert solution.detail is None, "at vertices alone there is nothing between them"
    found = solution.albedo
    seen = mesh.vertices[:, 2].abs() < 0.5
    wanted = 0.75 * mesh.albedo[seen, 0]
    before, after = ((albedo[seen, 0] - wanted).square().mean().sqrt() for albedo in (blurred.albedo, found))
    assert float(after) < 0.45 * float(before)
    assert abs(float(found[seen].mean() / blurred.albedo[seen].mean()) - 1) < 0.05


def test_what_photographs_from_both_sides_contradict_is_not_painted() -> None:
    """The surface lies 15 % of its radius too deep: each photograph shows other stripes there. Their plain mean keeps half of the contrast."""
    mesh, blurred = striped(0.0)
    tables = filter_environment(light())
    deep = dataclasses.replace(blurred, vertices=0.85 * blurred.vertices)
    shown = pictures(mesh, tables)
    right, wrong = (solved(fitted, shown, tables).albedo / fitted.albedo - 1 for fitted in (blurred, deep))
    seen = mesh.vertices[:, 2].abs() < 0.5
    assert float(wrong[seen].std()) < 0.15 * float(right[seen].std())


def test_what_no_photograph_shows_keeps_its_albedo() -> None:
    _, blurred = striped(0.0)
    tables = filter_environment(light())
    found = solved(blurred, [], tables, parts=3)
    assert torch.equal(found.albedo, blurred.albedo) and found.detail is None


def coarse(blurred: TriangleMesh) -> TriangleMesh:
    """A ball whose edges are as wide as two stripes."""
    mesh = sphere_mesh(subdivisions=2, albedo=0.5, roughness=0.4)
    return dataclasses.replace(mesh, albedo=torch.full_like(mesh.albedo, float(blurred.albedo.mean())))


def test_stripes_narrower_than_faces_come_back_between_the_vertices() -> None:
    mesh, blurred = striped(0.0)
    tables = filter_environment(light())
    ball = coarse(blurred)
    found = solved(ball, pictures(mesh, tables), tables, parts=6, rings=2)
    assert found.detail is not None
    shares = sample_places(6).float() / 6
    face = torch.arange(len(ball.faces)).repeat_interleave(len(shares))
    where = shares.repeat(len(ball.faces), 1)
    corners, weights = ball.faces.long()[face], torch.cat([1 - where.sum(1, keepdim=True), where], 1)
    places = (weights[..., None] * ball.vertices[corners]).sum(1)
    between = (weights[..., None] * found.albedo[corners]).sum(1)
    shown = detailed_albedo(between, found.detail, ball.faces, face, where)[:, 0]
    true = 0.5 + 0.25 * torch.sign(torch.sin(10 * torch.atan2(places[:, 1], places[:, 0])))
    seen = places[:, 2].abs() < 0.4

    def alike(values: torch.Tensor) -> float:
        return float(torch.corrcoef(torch.stack([values[seen], true[seen]]))[0, 1])

    # Measured: 0.946 and 0.787.
    assert alike(shown) > 0.92 and alike(between[:, 0]) < 0.82


def test_the_photographs_are_looked_up_at_the_size_at_which_they_were_taken() -> None:
    mesh, blurred = striped(0.0)
    tables = filter_environment(light())
    large, ball = pictures(mesh, tables), coarse(blurred)

    def reduced(target: ViewTarget) -> ViewTarget:
        """An eighth as large: stripes are a pixel or two wide."""
        camera = scaled_camera(target.camera, 1 / 8)
        planes = torch.cat([target.photo, target.mask[..., None]], -1).permute(2, 0, 1)[None]
        small = torch.nn.functional.interpolate(planes, (camera.height, camera.width), mode="area")[0].permute(1, 2, 0).contiguous()
        whole = slice(0, camera.height), slice(0, camera.width)
        return ViewTarget(camera, small[..., :3], small[..., :3], small[..., 3].contiguous(), *whole)

    small = [reduced(target) for target in large]
    contrasts = []
    for as_taken in (small, large):
        found = solve_albedo(build_tracer(ball), small, as_taken.__getitem__, open_light(ball, tables), mesh_edges(ball.faces), 2, 6)
        assert found.detail is not None
        contrasts.append(float(found.detail.codes.float().std()))
    assert contrasts[1] > 1.5 * contrasts[0]


def test_samples_lie_as_far_apart_as_pixels_but_are_no_more_than_allowed() -> None:
    ball = sphere_mesh(subdivisions=2)
    cameras = tuple(target.camera for target in pictures(ball, filter_environment(light())))
    edge = float((ball.vertices[ball.faces[:, 0].long()] - ball.vertices[ball.faces[:, 1].long()]).norm(dim=1).mean())
    pixel = float(cameras[0].center_world.norm() / cameras[0].intrinsics[0, 0])
    assert parts_for(ball, cameras, DetailSettings()) == min(MOST_PARTS, round(edge / pixel))
    vertices = len(ball.vertices)
    assert parts_for(ball, cameras, DetailSettings(most_samples=4 * vertices + 8)) == 2
    assert parts_for(ball, cameras, DetailSettings(most_samples=0)) == 1
