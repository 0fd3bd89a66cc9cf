"""Faces divided into four: the same surface, the same places on it."""

import torch
import trimesh

from drgs.reconstruct.geometry.bind_gaussians import points_from_binding
from drgs.reconstruct.geometry.divide_faces import DivisionSettings, divided_binding, divided_faces, divisions, undivided_faces
from drgs.scene.binding import Binding
from tests.render.closed_form_scenes import front_camera, sphere_mesh


def test_the_divided_mesh_is_the_same_closed_surface() -> None:
    ball = trimesh.creation.icosphere(2)
    vertices, faces = torch.tensor(ball.vertices, dtype=torch.float32), torch.tensor(ball.faces, dtype=torch.int32)
    divided = divided_faces(faces, len(vertices))
    new = trimesh.Trimesh(divided.carried(vertices).numpy(), divided.faces.numpy(), process=False)
    assert divided.faces.dtype == torch.int32 and len(divided.faces) == 4 * len(faces)
    assert new.is_watertight and new.is_winding_consistent
    torch.testing.assert_close(torch.tensor([new.area, new.volume]), torch.tensor([ball.area, ball.volume]))
    normals, old = torch.tensor(new.face_normals), torch.tensor(ball.face_normals)
    torch.testing.assert_close(normals, old.repeat(4, 1), atol=1e-5, rtol=0)  # each child in its parent's plane
    assert torch.equal(undivided_faces(divided.faces), faces)


def test_what_is_bound_stays_where_it_is() -> None:
    ball = trimesh.creation.icosphere(1)
    vertices, faces = torch.tensor(ball.vertices, dtype=torch.float32), torch.tensor(ball.faces, dtype=torch.int32)
    generator = torch.Generator().manual_seed(0)
    count = 500
    weights = torch.rand(count, 3, generator=generator) ** 3 + 1e-3
    binding = Binding(
        torch.randint(len(faces), (count,), generator=generator).int(),
        weights / weights.sum(1, keepdim=True),
        0.1 * torch.randn(count, generator=generator),
    )
    divided = divided_faces(faces, len(vertices))
    moved = divided_binding(binding, len(faces))
    assert moved.face.dtype == torch.int32 and moved.barycentric.min() > -1e-6
    assert len(moved.face.long().div(len(faces), rounding_mode="floor").unique()) == 4  # all four children occur
    before = points_from_binding(binding, vertices, faces)
    after = points_from_binding(moved, divided.carried(vertices), divided.faces)
    torch.testing.assert_close(after, before, atol=1e-6, rtol=0)


def test_faces_are_divided_until_they_are_as_small_as_pixels_or_too_many() -> None:
    mesh = sphere_mesh(subdivisions=3)  # 1280 faces, edges of 0.15
    camera = front_camera()
    pixel = float(camera.center_world.norm() / camera.intrinsics[0, 0])
    edge = 0.15 / pixel
    assert divisions(mesh, (camera,), DivisionSettings(edge_pixels=2 * edge)) == 0
    assert divisions(mesh, (camera,), DivisionSettings(edge_pixels=edge / 3)) == 2
    assert divisions(mesh, (camera,), DivisionSettings(edge_pixels=edge / 3, most_faces=4 * 1280)) == 1
    assert divisions(mesh, (camera,), DivisionSettings(edge_pixels=edge / 3, most_faces=0)) == 0
