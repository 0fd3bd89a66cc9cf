"""Edges over a picture: where a mesh's are, and only those that the camera sees."""

import numpy as np
import torch
import trimesh

from benchmarks.paper.wires import with_wires
from drgs.scene.camera import pixel_rays_world
from tests.render.closed_form_scenes import front_camera, mesh_of

SIZE = 64


def test_lines_lie_on_the_edges_that_are_seen():
    camera, white = front_camera(SIZE), np.ones((SIZE, SIZE, 3))
    origin, directions = pixel_rays_world(camera)
    towards = torch.nn.functional.normalize(-origin, dim=0)
    side = torch.nn.functional.normalize(torch.linalg.cross(towards, torch.tensor([0.0, 0.0, 1.0])), dim=0)
    up = torch.linalg.cross(side, towards)
    # A square before the camera, cut from corner to corner, and a small one hidden behind it.
    square = torch.stack([-side - up, side - up, side + up, up - side]) * 0.5
    vertices = torch.cat([square, 0.4 * square + 0.3 * towards])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [4, 6, 7]])
    mesh = mesh_of(trimesh.Trimesh(vertices.numpy(), faces, process=False), 0.5, 0.5, 0.0)
    drawn = with_wires(white, mesh, camera)
    alone = with_wires(white, mesh_of(trimesh.Trimesh(square.numpy(), faces[:2], process=False), 0.5, 0.5, 0.0), camera)
    assert np.array_equal(drawn, alone), "what is behind is not seen"
    dark = drawn[..., 0] < 0.9
    distance = (-(origin @ towards) / (directions @ towards))[..., None]
    places = origin + distance * directions
    across, above = (places @ side).numpy(), (places @ up).numpy()
    pixel = float(across[SIZE // 2, 1] - across[SIZE // 2, 0])
    inside = np.maximum(abs(across), abs(above)) < 0.5
    near = np.minimum(0.5 - np.maximum(abs(across), abs(above)), abs(across - above) / 2**0.5)
    assert not dark[~inside].any() and dark[inside & (near < 0.4 * abs(pixel))].all() and not dark[inside & (near > 1.3 * abs(pixel))].any()
