"""Poses and sequences of moved vertices, as other programs write them."""

import numpy as np
import pytest
import torch

from drgs.deform.displace.vertex_sequence import vertices_at
from drgs.exchange.obj import parse_obj
from drgs.exchange.ply import encode_ply
from drgs.scene.mesh import TriangleMesh
from tests.deform.test_pose_scene import plate_asset, pose


def obj_text(vertices, faces) -> str:
    return "".join(f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in vertices) + "".join(
        f"f {a + 1}/1/1 {b + 1}//2 {c + 1}\n" for a, b, c in faces
    )


def plate() -> tuple[TriangleMesh, np.ndarray, np.ndarray]:
    mesh = plate_asset().mesh
    return mesh, mesh.vertices.numpy(), mesh.faces.numpy()


def test_obj_keeps_the_order_of_vertices_and_fans_polygons():
    vertices, faces = parse_obj(b"# x\nv 0 0 0\nv 1 0 0 1.0\nvn 0 0 1\nv 1 1 0\nv 0 1 0\nf 1/2/3 2//1 3 4\nf -4 -3 \\\n-2\n")
    assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2]]


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (b"hello", "has 0 vertices"),
        (b"v 0 0\n", "fewer than three|no number"),
        (b"v 0 0 x\n", "no number"),
        (b"v 0 0 0\nf 1 2 3\n", "names vertex 3, but there are 1"),
        (b"v 0 0 0\nf 1 a 1\n", "is not understood"),
    ],
)
def test_a_damaged_obj_is_refused_with_a_sentence(text, sentence):
    with pytest.raises(ValueError, match=sentence):
        parse_obj(text)


def test_an_array_of_frames_plays_by_time_and_holds_at_its_end(tmp_path):
    mesh, vertices, _ = plate()
    path = tmp_path / "wave.npz"
    np.savez_compressed(path, vertices=np.stack([vertices + k for k in range(4)]))
    for seconds, expected in ((0.0, 0.0), (1.0, 2.0), (0.75, 1.5), (1.5, 3.0), (9.0, 3.0), (1.25, 2.5)):
        found = vertices_at(path, seconds, 2.0, mesh)
        assert torch.allclose(found, mesh.vertices + expected, atol=1e-6), seconds


@pytest.mark.parametrize("kind", ["obj", "ply"])
def test_a_folder_of_meshes_is_a_sequence_in_the_order_of_its_numbers(tmp_path, kind):
    mesh, vertices, faces = plate()
    for frame in (1, 2, 10):
        moved, path = vertices + frame, tmp_path / f"pose_{frame}.{kind}"
        if kind == "obj":
            path.write_text(obj_text(moved, faces[::-1, [1, 2, 0]]))  # faces in another order, from another corner: the same mesh
        else:
            path.write_bytes(encode_ply({"vertex": dict(zip("xyz", moved.T, strict=True))}, faces))
    (tmp_path / "notes.txt").write_text("")
    assert torch.allclose(vertices_at(tmp_path, 2.0, 1.0, mesh), mesh.vertices + 10, atol=1e-5)
    assert torch.allclose(vertices_at(tmp_path, 1.5, 1.0, mesh), mesh.vertices + 6, atol=1e-5)
    assert torch.allclose(vertices_at(tmp_path / f"pose_2.{kind}", 5.0, 1.0, mesh), mesh.vertices + 2, atol=1e-5)


def test_a_deform_edit_takes_a_folder_and_a_time_and_sees_a_changed_frame(tmp_path):
    asset = plate_asset()
    vertices, faces = asset.mesh.vertices.numpy(), asset.mesh.faces.numpy()
    (tmp_path / "walk").mkdir()
    for frame in (0, 1):
        (tmp_path / "walk" / f"{frame}.obj").write_text(obj_text(vertices + frame, faces))
    edit = {"op": "deform", "vertices": "walk", "time": 0.25, "frames_per_second": 2}
    assert torch.allclose(pose(asset, edit, base_directory=tmp_path).surfels.centers, asset.gaussians.centers + 0.5, atol=1e-5)
    (tmp_path / "walk" / "1.obj").write_text(obj_text(vertices + 3.5, faces))
    assert torch.allclose(pose(asset, edit, base_directory=tmp_path).surfels.centers, asset.gaussians.centers + 1.75, atol=1e-5)
    with pytest.raises(ValueError, match="outside the folder"):
        pose(asset, edit | {"vertices": ".."}, base_directory=tmp_path / "walk", confine=True)


def test_another_topology_is_refused_with_a_sentence(tmp_path):
    mesh, vertices, faces = plate()
    swapped = faces.copy()
    swapped[[0, 1]] = swapped[[0, 1]][:, [1, 0, 2]]
    bad = vertices.copy()
    bad[0, 0] = np.nan
    cases = {
        "few.obj": (obj_text(vertices[:5], faces[:0]), r"has 5 vertices; expected the 81"),
        "flipped.obj": (obj_text(vertices, faces[:, ::-1]), "turn the other way round"),
        "cut.obj": (obj_text(vertices, faces[1:]), "join other vertices"),
        "swapped.obj": (obj_text(vertices, swapped), "join other vertices"),
        "nan.obj": (obj_text(bad, faces), "1 coordinates that are not finite"),
    }
    for name, (text, sentence) in cases.items():
        (tmp_path / name).write_text(text)
        with pytest.raises(ValueError, match=sentence):
            vertices_at(tmp_path / name, 0.0, 24.0, mesh)
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="holds no OBJ or PLY"):
        vertices_at(tmp_path / "empty", 0.0, 24.0, mesh)
    np.savez(tmp_path / "frames.npz", vertices=np.stack([vertices, bad]))
    with pytest.raises(ValueError, match="1 values that are not finite"):
        vertices_at(tmp_path / "frames.npz", 5.0, 24.0, mesh)
    assert torch.equal(vertices_at(tmp_path / "frames.npz", 0.0, 24.0, mesh), mesh.vertices)  # only the frames that are shown are read
