"""Factors between the vertices: what is stored is what is found, at corners, along edges and inside."""

import pytest
import torch

from drgs.reconstruct.geometry.face_samples import face_samples
from drgs.scene.albedo_detail import (
    MOST_PARTS,
    ONE,
    AlbedoDetail,
    chosen_faces,
    codes_of,
    detailed_albedo,
    factors_of,
    parts_of,
    sample_places,
    samples_of,
)
from tests.render.closed_form_scenes import sphere_mesh


def test_a_factor_of_one_is_exact_and_others_are_right_to_the_step():
    assert torch.equal(factors_of(codes_of(torch.ones(1, 3))), torch.ones(1, 3))
    factors = torch.linspace(0, 3.96, 997)[:, None].repeat(1, 3)
    error = (factors_of(codes_of(factors)) - factors).abs()
    assert bool((error <= 1e-3 + factors.sqrt() / ONE).all())
    assert codes_of(torch.tensor([[9.0, -1.0, 1.0]])).tolist() == [[255, 0, ONE]]


def test_a_grid_knows_its_size():
    for parts in range(1, MOST_PARTS + 1):
        assert parts_of(samples_of(parts)) == parts and len(sample_places(parts)) == samples_of(parts)
    for samples in (0, 1, 2, 4, 7, 44):
        with pytest.raises(ValueError, match="samples of detail"):
            parts_of(samples)


@pytest.mark.parametrize("parts", [1, 2, 3, 5, 8])
def test_between_three_samples_factors_are_linear(parts: int):
    """A function that is linear on the face comes back wherever one looks, the rims included."""
    places = sample_places(parts).double() / parts
    factors = 0.25 + 1.5 * places[:, :1] + 0.75 * places[:, 1:]
    detail = AlbedoDetail(codes_of(factors.repeat(1, 3))[None].repeat(3, 1, 1))
    faces = torch.tensor([[0, 1, 2]] * 3)
    uniform = torch.rand(4000, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    inside = torch.where(uniform.sum(1, keepdim=True) > 1, 1 - uniform, uniform)
    rims = torch.tensor([[0, 0], [1, 0], [0, 1], [0.5, 0.5], [0.5, 0], [0, 0.5], [1 / 3, 2 / 3]], dtype=torch.float64)
    where = torch.cat([inside, rims])
    face = torch.full((len(where),), 2)
    found = detailed_albedo(torch.full((len(where), 3), 0.25, dtype=torch.float64), detail, faces, face, where)
    expected = 0.25 * (0.25 + 1.5 * where[:, :1] + 0.75 * where[:, 1:])
    torch.testing.assert_close(found, expected.repeat(1, 3), rtol=0, atol=0.25 * 2 / ONE)


def test_nothing_is_seen_of_an_edge_between_faces():
    mesh = sphere_mesh(subdivisions=1)
    samples = face_samples(mesh.faces, len(mesh.vertices), 5)
    factors = 3 * torch.rand(len(samples.corners), 3, generator=torch.Generator().manual_seed(1))
    detail = AlbedoDetail(codes_of(factors)[samples.number])
    along = torch.linspace(0, 1, 37)
    places = {
        0: torch.stack([along, torch.zeros_like(along)], 1),
        1: torch.stack([1 - along, along], 1),
        2: torch.stack([torch.zeros_like(along), 1 - along], 1),
    }
    found: dict[tuple[int, int], torch.Tensor] = {}
    compared = 0
    for number, corners in enumerate(mesh.faces.tolist()):
        for side, where in places.items():
            ends = corners[side], corners[(side + 1) % 3]
            face = torch.full((len(along),), number)
            values = detailed_albedo(torch.full((len(along), 3), 0.2), detail, mesh.faces, face, where)
            if ends[::-1] in found:
                torch.testing.assert_close(values, found[ends[::-1]].flip(0))
                compared += 1
            found[ends] = values
    assert compared == len(mesh.faces) * 3 // 2


def test_vertices_wear_as_much_as_their_share_says():
    detail = AlbedoDetail(codes_of(torch.full((1, 6, 3), 2.25)), torch.tensor([1.0, 0.0, 0.5]))
    where = torch.tensor([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0], [0.5, 0.5]])
    found = detailed_albedo(torch.full((4, 3), 0.2), detail, torch.tensor([[0, 1, 2]]), torch.zeros(4, dtype=torch.long), where)
    torch.testing.assert_close(found[:, 0], 0.2 * (1 + 1.25 * torch.tensor([1.0, 0.0, 0.5, 0.25])))


def test_albedo_stays_within_what_sends_light_back():
    detail = AlbedoDetail(codes_of(torch.full((1, 3, 3), 3.9)))
    found = detailed_albedo(
        torch.full((1, 3), 0.9), detail, torch.tensor([[0, 1, 2]]), torch.zeros(1, dtype=torch.long), torch.full((1, 2), 0.3)
    )
    assert found.tolist() == [[1.0, 1.0, 1.0]]


def test_new_faces_behind_chosen_ones_have_none():
    detail = AlbedoDetail(codes_of(torch.tensor([0.5, 2.0, 3.0])[:, None, None].repeat(1, 3, 3)), torch.tensor([0.0, 0.5, 1.0]))
    kept = chosen_faces(detail, torch.tensor([2, 0]), 4, torch.tensor([0, 1, 2, 2]))
    torch.testing.assert_close(factors_of(kept.codes)[:, 0, 0], torch.tensor([3.0, 0.5, 1.0, 1.0]), rtol=0, atol=0.02)
    assert kept.share is not None and kept.share.tolist() == [0.0, 0.5, 1.0, 1.0]
