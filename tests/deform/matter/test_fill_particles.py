"""Interior particles agree with the true solid, however broken the mesh is."""

import math

import pytest
import torch
import trimesh

from drgs.deform.matter.fill_particles import SPACINGS_A_CELL, FillSettings, fill_particles


def sphere(radius=0.5, center=(0.0, 0.0, 0.0)):
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    return torch.tensor(mesh.vertices + center, dtype=torch.float32), torch.tensor(mesh.faces, dtype=torch.int32)


def broken(kind):
    """A sphere's mesh, damaged, and whether points lie in the solid it stands for."""
    vertices, faces = sphere()
    heights = vertices[faces.long()].mean(1)[:, 2]
    generator = torch.Generator().manual_seed(1)
    inside = lambda p: p.norm(dim=-1) < 0.5  # noqa: E731
    if kind == "holed":
        faces = faces[torch.rand(len(faces), generator=generator) > 0.05]
    elif kind == "capless":
        faces = faces[heights > -0.43]
    elif kind == "flipped":
        turned = torch.rand(len(faces), generator=generator) < 0.1
        faces = torch.where(turned[:, None], faces.flip(1), faces)
    elif kind == "inside out":
        faces = faces.flip(1)
    elif kind == "overlapping":
        other, more = sphere(center=(0.4, 0.0, 0.0))
        vertices, faces = torch.cat([vertices, other]), torch.cat([faces, more + len(vertices)])
        inside = lambda p: (p.norm(dim=-1) < 0.5) | ((p - torch.tensor([0.4, 0, 0])).norm(dim=-1) < 0.5)  # noqa: E731
    elif kind == "floaters":
        other, more = sphere(0.01, (2.0, 0.0, 0.0))
        vertices, faces = torch.cat([vertices, other]), torch.cat([faces, more + len(vertices)])
    return vertices, faces, inside


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["closed", "holed", "capless", "flipped", "inside out", "overlapping", "floaters"])
def test_the_filled_volume_agrees_with_the_true_solid(kind):
    vertices, faces, inside = broken(kind)
    filled = fill_particles(vertices, faces, FillSettings(particles=4000, surface="none"))
    assert filled.interior == len(filled.positions) and 3000 < filled.interior <= 4400
    assert inside(filled.positions).float().mean() > 0.98  # next to nothing outside the solid
    truth = 4 / 3 * math.pi / 8
    if kind == "overlapping":
        cap = 0.5 - 0.2
        truth = 2 * truth - 2 * math.pi * cap**2 * (3 * 0.5 - cap) / 3
    assert float(filled.volumes.sum()) == pytest.approx(truth, rel=0.05 if kind == "capless" else 0.02)


def test_the_mass_of_a_cube_is_right_within_one_percent_and_the_filling_is_repeatable():
    mesh = trimesh.creation.box((1.0, 2.0, 0.5))
    vertices, faces = torch.tensor(mesh.vertices, dtype=torch.float32), torch.tensor(mesh.faces, dtype=torch.int32)
    filled = fill_particles(vertices, faces, FillSettings(particles=5000, surface="none"))
    assert float(filled.volumes.sum()) == pytest.approx(1.0, rel=1e-5) and 4500 < len(filled.positions) < 5500
    again = fill_particles(vertices, faces, FillSettings(particles=5000, surface="none"))
    assert torch.equal(filled.positions, again.positions)
    other = fill_particles(vertices, faces, FillSettings(particles=5000, seed=4, surface="none"))
    assert not torch.equal(filled.positions, other.positions)


@pytest.mark.slow
def test_tracers_lie_on_the_surface_one_a_voxel_and_weigh_next_to_nothing():
    vertices, faces, _ = broken("closed")
    filled = fill_particles(vertices, faces, FillSettings(particles=3000))
    tracers = filled.positions[filled.interior :]
    assert 100 < len(tracers) <= len(vertices)
    assert torch.allclose(tracers.norm(dim=-1), torch.tensor(0.5), atol=1e-5)
    assert float(filled.volumes[filled.interior :].sum() / filled.volumes.sum()) < 1e-3
    paper = fill_particles(vertices, faces, FillSettings(particles=3000, surface="particles"))
    assert len(paper.positions) == paper.interior + len(vertices)
    assert float(paper.volumes.min() / paper.volumes.max()) == pytest.approx(1)


def test_thin_parts_are_reported():
    plate = trimesh.creation.box((2.0, 2.0, 0.02))
    vertices, faces = torch.tensor(plate.vertices, dtype=torch.float32), torch.tensor(plate.faces, dtype=torch.int32)
    plate = fill_particles(vertices, faces, FillSettings(particles=2000))
    assert plate.thin_share == pytest.approx(8 / (8 + 8 * 0.02))  # all but the rim
    ball = fill_particles(*sphere(), FillSettings(particles=2000))
    assert ball.thin_share < 0.01 and ball.torn_parts == ()


def test_thin_parts_of_a_tiny_object_are_found():
    plate = trimesh.creation.box((2.0, 2.0, 0.02)).subdivide_loop(3)
    vertices, faces = torch.tensor(plate.vertices, dtype=torch.float32), torch.tensor(plate.faces, dtype=torch.int32)
    large, tiny = (fill_particles(size * vertices, faces, FillSettings(particles=2000)) for size in (1.0, 2.0**-20))
    assert tiny.thin_share == pytest.approx(large.thin_share, abs=0.01) and large.thin_share > 0.9


def test_a_handle_thinner_than_a_cell_is_found_until_there_are_particles_enough():
    body, handle = trimesh.creation.box((1.0, 1.0, 1.0)), trimesh.creation.box((1.0, 0.1, 0.1))
    handle.apply_translation((0.5, 0.3, 0.3))
    mesh = trimesh.util.concatenate([body, handle])
    vertices, faces = torch.tensor(mesh.vertices, dtype=torch.float32), torch.tensor(mesh.faces, dtype=torch.int32)
    coarse = fill_particles(vertices, faces, FillSettings(particles=300))
    (part,) = coarse.torn_parts
    assert part.thickness == pytest.approx(0.1, rel=1e-3) and part.share == pytest.approx(0.4 / 6.42, rel=1e-5)
    assert part.middle == pytest.approx((0.5, 0.3, 0.3), abs=1e-5)
    enough = 300 * (SPACINGS_A_CELL * coarse.spacing / part.thickness) ** 3
    assert len(fill_particles(vertices, faces, FillSettings(particles=int(0.9 * enough))).torn_parts) == 1
    assert fill_particles(vertices, faces, FillSettings(particles=int(1.1 * enough))).torn_parts == ()


def test_a_sheet_encloses_nothing_and_is_refused():
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    with pytest.raises(ValueError, match="flat"):
        fill_particles(corners, torch.tensor([[0, 1, 2], [0, 2, 3]], dtype=torch.int32))


def test_a_single_particle_carries_the_whole_volume():
    filled = fill_particles(*sphere(), FillSettings(particles=1, surface="none"))
    assert 1 <= len(filled.positions) <= 8
    assert float(filled.volumes.sum()) == pytest.approx(4 / 3 * math.pi / 8, rel=0.03)
