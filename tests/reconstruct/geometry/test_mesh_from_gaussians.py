"""The mesh around surfels: which of its parts are the object."""

import dataclasses

import pytest
import torch

from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.geometry.extract_mesh import MeshSettings, mesh_report
from drgs.reconstruct.geometry.face_surfels import surfels_on_faces_of
from drgs.reconstruct.geometry.mesh_from_gaussians import mesh_from_gaussians, parts_in_hull, reduced_mesh
from drgs.scene.mesh import TriangleMesh, vertex_normals
from tests.reconstruct.geometry.test_extract_mesh import orbit_camera, sphere_directions
from tests.render.closed_form_scenes import sphere_mesh

PLACES = ((-0.55, 0.0, 0.0), (0.6, 0.0, 0.0), (0.0, 0.9, 0.3))
RADII = (0.4, 0.3, 0.15)
SETTINGS = MeshSettings(resolution=96, face_limit=8000)


def balls(count: int) -> TriangleMesh:
    """The first `count` of three that stand apart."""
    ball = sphere_mesh(subdivisions=3)
    vertices = torch.cat(
        [radius * ball.vertices + torch.tensor(place) for place, radius in zip(PLACES[:count], RADII[:count], strict=True)]
    )
    faces = torch.cat([ball.faces + k * len(ball.vertices) for k in range(count)])
    plain = torch.full((len(vertices),), 0.5)
    return TriangleMesh(vertices, faces, vertex_normals(vertices, faces), plain[:, None].repeat(1, 3), plain, torch.zeros_like(plain))


def points_in(hull: TriangleMesh | None) -> InitialPoints:
    nothing = torch.zeros(0, 3)
    hulls = (None, None) if hull is None else (hull.vertices, hull.faces.long())
    return InitialPoints(nothing, None, nothing, torch.zeros(3), 1.2, "hull", *hulls)


@pytest.fixture(scope="module")
def fused() -> dict[str, TriangleMesh]:
    gaussians, _ = surfels_on_faces_of(balls(3))
    cameras = tuple(orbit_camera(4 * direction) for direction in sphere_directions(24))
    points = {"hull of two": points_in(balls(2)), "no hull": points_in(None)}
    return {name: mesh_from_gaussians(gaussians, cameras, given, SETTINGS) for name, given in points.items()}


def parts(mesh: TriangleMesh) -> int:
    return mesh_report(mesh.vertices, mesh.faces).component_count


@pytest.mark.slow
def test_things_that_stand_apart_are_kept_and_what_floats_outside_the_hull_is_not(fused: dict[str, TriangleMesh]) -> None:
    mesh = fused["hull of two"]
    assert parts(mesh) == 2
    off = torch.stack(
        [((mesh.vertices - torch.tensor(place)).norm(dim=1) - radius).abs() for place, radius in zip(PLACES, RADII, strict=True)]
    )
    assert float(off[:2].amin(0).max()) < 0.03
    assert all(int((own < 0.03).sum()) > 100 for own in off[:2])


@pytest.mark.slow
def test_without_a_hull_the_largest_is_the_object(fused: dict[str, TriangleMesh]) -> None:
    mesh = fused["no hull"]
    assert parts(mesh) == 1
    assert float(mesh.vertices[:, 0].max()) < 0.0


def test_where_nothing_lies_in_the_hull_the_largest_part_is_kept() -> None:
    mesh, far = balls(3), dataclasses.replace(balls(1), vertices=balls(1).vertices + 10)
    vertices, faces = parts_in_hull(mesh.vertices, mesh.faces, far.vertices, far.faces, 0.02)
    assert len(faces) == len(mesh.faces) // 3
    assert float(vertices[:, 0].max()) < 0.0


def test_the_largest_part_is_kept_beside_one_that_a_wrong_hull_holds() -> None:
    mesh = balls(3)
    small = dataclasses.replace(balls(1), vertices=0.5 * (balls(1).vertices - torch.tensor(PLACES[0])) + torch.tensor(PLACES[2]))
    vertices, faces = parts_in_hull(mesh.vertices, mesh.faces, small.vertices, small.faces, 0.02)
    assert len(faces) == 2 * len(mesh.faces) // 3
    assert float(vertices[:, 0].min()) < -0.9


def test_fewer_faces_are_of_all_parts() -> None:
    assert parts(reduced_mesh(balls(3), 2000, 1.2)) == 3
