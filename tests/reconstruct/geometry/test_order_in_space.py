"""A mesh in the order of a curve: the same surface, with everything where it was, and neighbours nearer in memory."""

from dataclasses import replace

import torch

from drgs.reconstruct.geometry.bind_gaussians import points_from_binding
from drgs.reconstruct.geometry.order_in_space import order_in_space
from drgs.scene.albedo_detail import AlbedoDetail, detailed_albedo
from drgs.scene.binding import Binding
from drgs.scene.certainty import Certainty
from drgs.scene.mesh import TriangleMesh
from tests.render.closed_form_scenes import sphere_mesh


def shuffled_sphere() -> TriangleMesh:
    """Vertices and faces in any order, one vertex of no face, and detail."""
    generator = torch.Generator().manual_seed(0)
    mesh = sphere_mesh(3)
    vertices = torch.cat([mesh.vertices, torch.zeros(1, 3)])
    order = torch.randperm(len(vertices), generator=generator)
    place = torch.empty_like(order)
    place[order] = torch.arange(len(order))
    faces = place[mesh.faces.long()][torch.randperm(len(mesh.faces), generator=generator)].int()
    at = vertices[order]
    codes = torch.randint(0, 255, (len(faces), 6, 3), dtype=torch.uint8, generator=generator)
    return TriangleMesh(at, faces, at, at.abs(), at[:, 0], at[:, 1], detail=AlbedoDetail(codes, at[:, 2].abs()))


def test_faces_keep_their_corners_and_all_that_these_carry() -> None:
    mesh = shuffled_sphere()
    order = order_in_space(mesh)
    new = order.of_mesh(mesh)
    for name, values in mesh.columns.items():
        if name != "faces":
            torch.testing.assert_close(getattr(new, name)[new.faces.long()], values[mesh.faces.long()][order.faces], rtol=0, atol=0)
    assert sorted(order.vertices.tolist()) == list(range(len(mesh.vertices))) and sorted(order.faces.tolist()) == list(
        range(len(mesh.faces))
    )
    inside = torch.tensor([[0.2, 0.3]]).expand(len(mesh.faces), 2)
    every = torch.arange(len(mesh.faces))
    flat = torch.ones(len(mesh.faces), 3)
    before = detailed_albedo(flat, mesh.detail, mesh.faces, every, inside)
    torch.testing.assert_close(detailed_albedo(flat, new.detail, new.faces, every, inside), before[order.faces], rtol=0, atol=0)


def test_surfels_stay_where_they_are_and_certainty_with_its_vertices() -> None:
    mesh = shuffled_sphere()
    order = order_in_space(mesh)
    new = order.of_mesh(mesh)
    face = torch.tensor([5, 17, 200], dtype=torch.int32)
    binding = Binding(face, torch.tensor([[0.2, 0.3, 0.5]]).expand(3, 3), torch.zeros(3))
    moved = order.of_binding(binding)
    assert moved.face.dtype == torch.int32
    where = points_from_binding(binding, mesh.vertices, mesh.faces)
    torch.testing.assert_close(points_from_binding(moved, new.vertices, new.faces), where, rtol=0, atol=0)
    values = mesh.vertices[:, 0].half()
    certainty = order.of_certainty(Certainty(values, values + 1, values, values))
    torch.testing.assert_close(certainty.albedo, new.vertices[:, 0].half() + 1, rtol=0, atol=0)


def test_corners_of_a_face_and_of_the_next_are_near_in_memory() -> None:
    def spread(mesh: TriangleMesh) -> float:
        corners = mesh.faces.long().float()
        return float((corners[1:] - corners[:-1]).abs().median())

    mesh = shuffled_sphere()
    assert spread(order_in_space(mesh).of_mesh(mesh)) < 0.1 * spread(mesh)


def test_without_detail_there_is_none() -> None:
    mesh = replace(shuffled_sphere(), detail=None)
    assert order_in_space(mesh).of_mesh(mesh).detail is None
