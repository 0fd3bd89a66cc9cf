import pytest
import torch

from drgs.reconstruct.geometry.face_samples import face_samples
from drgs.scene.albedo_detail import sample_places
from tests.render.closed_form_scenes import sphere_mesh


@pytest.mark.parametrize("parts", [1, 2, 3, 6])
def test_each_place_of_a_closed_mesh_is_one_sample_and_lies_where_its_corners_say(parts: int):
    mesh = sphere_mesh(subdivisions=2)
    samples = face_samples(mesh.faces, len(mesh.vertices), parts)
    vertices, edges, faces = len(mesh.vertices), 3 * len(mesh.faces) // 2, len(mesh.faces)
    assert len(samples.corners) == vertices + (parts - 1) * edges + (parts - 1) * (parts - 2) // 2 * faces
    assert torch.equal(samples.number.unique(), torch.arange(len(samples.corners)))
    shares = sample_places(parts).float() / parts
    weights = torch.cat([1 - shares.sum(1, keepdim=True), shares], 1)
    by_face = torch.einsum("pc,fcx->fpx", weights, mesh.vertices[mesh.faces.long()])
    torch.testing.assert_close(samples.at(mesh.vertices)[samples.number], by_face, rtol=0, atol=1e-6)
    assert torch.equal(samples.at(mesh.vertices)[:vertices], mesh.vertices), "vertices come first"


def test_means_around_vertices_keep_what_is_the_same_everywhere():
    mesh = sphere_mesh(subdivisions=1)
    samples = face_samples(mesh.faces, len(mesh.vertices), 4)
    outwards, inwards = samples.averaging(len(mesh.vertices))
    torch.testing.assert_close(torch.from_numpy(outwards.sum(1)).squeeze(1), torch.ones(len(samples.corners), dtype=torch.float64))
    torch.testing.assert_close(torch.from_numpy(inwards.sum(1)).squeeze(1), torch.ones(len(mesh.vertices), dtype=torch.float64))
    torch.testing.assert_close(torch.from_numpy(outwards @ mesh.vertices.numpy()).float(), samples.at(mesh.vertices))


def test_a_sample_lies_between_marked_vertices_if_those_that_count_are_marked():
    samples = face_samples(torch.tensor([[0, 1, 2]]), 3, 2)
    marked = samples.between(torch.tensor([True, True, False]))
    places = samples.number[0]
    by_place = dict(zip(map(tuple, sample_places(2).tolist()), marked[places].tolist(), strict=True))
    assert by_place == {(0, 0): True, (1, 0): True, (2, 0): True, (0, 1): False, (1, 1): False, (0, 2): False}


def test_a_vertex_that_no_face_has_is_left_alone():
    samples = face_samples(torch.tensor([[0, 1, 3]]), 5, 3)
    assert len(samples.corners) == 5 + 2 * 3 + 1
