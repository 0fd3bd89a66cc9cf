"""How thick things are, and that both sides of a thin part stay apart."""

import numpy as np
import pytest
import torch
import trimesh

from drgs.reconstruct.geometry.integrate_normals import IntegrationSettings, integrate_normals
from drgs.reconstruct.geometry.mask_outlines import outline_rays, outline_residuals
from drgs.reconstruct.geometry.mesh_edges import mesh_edges
from drgs.reconstruct.geometry.thickness import OtherSide, other_side, thickness
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.mesh import TriangleMesh, vertex_normals
from tests.render.closed_form_scenes import sphere_mesh

THICK = 0.06


def plate(cells: int = 24) -> TriangleMesh:
    """Of 1 by 1, across z."""
    box = trimesh.creation.box((1, 1, THICK))
    fine = box.subdivide_to_size(1 / cells)
    vertices, faces = torch.from_numpy(np.array(fine.vertices, np.float32)), torch.from_numpy(np.array(fine.faces, np.int32))
    one = torch.ones(len(vertices))
    return TriangleMesh(vertices, faces, vertex_normals(vertices, faces), torch.full_like(vertices, 0.5), one, 0 * one)


def middle_of(mesh: TriangleMesh) -> torch.Tensor:
    """Vertices of the large sides, away from their rim."""
    return ((mesh.vertices[:, :2].abs() < 0.3).all(1)).nonzero().squeeze(1)


def test_a_plate_is_as_thick_as_it_is():
    mesh = plate()
    chosen = middle_of(mesh)
    found = thickness(build_tracer(mesh), chosen, -mesh.normals[chosen])
    torch.testing.assert_close(found, torch.full_like(found, THICK), rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize(("above", "below"), [(-0.05, -0.05), (-0.09, 0.0), (-0.09, 0.02), (-0.02, -0.08)])
def test_sides_give_way_until_what_is_left_is_as_thick_as_asked_for(above: float, below: float):
    mesh = plate()
    chosen, least = middle_of(mesh), 0.02
    up = mesh.vertices[:, 2] > 0
    step = torch.where(up, above, below)
    kept = other_side(build_tracer(mesh), least).kept_apart(step)
    left = THICK + kept[chosen][up[chosen]].mean() + kept[chosen][~up[chosen]].mean()
    assert abs(float(left) - least) < 1e-3
    # Nobody is pushed outwards, and what goes outwards goes as far as it wants.
    assert bool((kept[chosen] <= step[chosen].clamp(min=0) + 1e-6).all())
    assert bool((kept[chosen][step[chosen] > 0] == step[chosen][step[chosen] > 0]).all())


def test_a_plate_moves_as_a_whole_by_more_than_it_is_thick():
    mesh = plate()
    step = torch.where(mesh.vertices[:, 2] > 0, -0.2, 0.2)
    kept = other_side(build_tracer(mesh), 0.02).kept_apart(step)[middle_of(mesh)]
    torch.testing.assert_close(kept, step[middle_of(mesh)])


def test_what_is_thinner_than_asked_for_gets_no_thinner_and_no_thicker():
    mesh = plate()
    kept = other_side(build_tracer(mesh), 2 * THICK).kept_apart(torch.full_like(mesh.roughness, -0.03))[middle_of(mesh)]
    assert float(kept.abs().max()) < 1e-4


def test_what_is_thick_goes_inwards_freely():
    mesh = sphere_mesh(subdivisions=3)
    step = torch.full_like(mesh.roughness, -0.3)
    torch.testing.assert_close(other_side(build_tracer(mesh), 0.1).kept_apart(step), step)


def test_wrong_normals_do_not_push_a_plate_through_itself():
    mesh = plate()
    # Both sides are called bowls: a vertex in their middle would have to lie .05 below the rim.
    wanted = torch.nn.functional.normalize(mesh.normals - 0.4 * mesh.vertices * torch.tensor([1.0, 1.0, 0.0]), dim=-1)
    edges, none = mesh_edges(mesh.faces), outline_rays((), [], mesh.vertices.device)

    def middle_after(behind: OtherSide | None) -> float:
        """Least distance of the upper side from the lower one, around the middle."""
        settings = IntegrationSettings(longest_move=9.0)
        moved = integrate_normals(
            mesh.vertices, mesh.faces, wanted, edges, outline_residuals(build_tracer(mesh), none), settings, behind=behind
        )
        near = (mesh.vertices[:, :2].abs() < 0.2).all(1)
        above, below = (moved[near & (mesh.vertices[:, 2] * side > 0), 2] for side in (1, -1))
        return float(above.min() - below.max())

    assert middle_after(None) < 0
    assert middle_after(other_side(build_tracer(mesh), 0.02)) > 0.015
