"""Textures of exports: occlusion against closed forms, and what shrunken meshes keep of what was left out of them."""

import igl
import numpy as np
import pytest
import torch
import trimesh

from drgs.convert import bake_transfer
from drgs.convert.bake_textures import SKY_SLOPE, TexturedMesh, bake_textures
from drgs.maths.sampling import sphere_lattice
from drgs.scene.mesh import TriangleMesh, vertex_normals


def plain_mesh(vertices: np.ndarray, faces: np.ndarray, albedo: float = 0.0) -> TriangleMesh:
    points, corners = torch.tensor(np.asarray(vertices), dtype=torch.float32), torch.tensor(np.asarray(faces), dtype=torch.int32)
    count = len(points)
    return TriangleMesh(
        points, corners, vertex_normals(points, corners), torch.full((count, 3), albedo), torch.full((count,), 0.5), torch.zeros(count)
    )


def bowl(subdivisions: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """The inner side of the lower half of a unit sphere."""
    ball = trimesh.creation.icosphere(subdivisions)
    below = ball.vertices[ball.faces].mean(1)[:, 2] < 0
    return np.asarray(ball.vertices), np.asarray(ball.faces)[below][:, ::-1].copy()


def face_middles(textured: TexturedMesh, picture: np.ndarray) -> np.ndarray:
    """(face, k) of a picture in the middle of each face."""
    height, width, _ = picture.shape
    middles = textured.atlas.uv[textured.atlas.faces].mean(1)
    at = np.clip((middles * [width, height]).astype(int), 0, [width - 1, height - 1])
    return picture[at[:, 1], at[:, 0]].astype(float)


@pytest.mark.slow
@pytest.mark.parametrize("shape", [trimesh.creation.icosphere(3), trimesh.creation.box()], ids=["ball", "box"])
def test_nothing_is_darker_on_what_sees_no_part_of_itself(shape):
    corners = shape.vertices[shape.faces].reshape(-1, 3)  # a box with sharp edges
    mesh = (
        plain_mesh(corners, np.arange(len(corners)).reshape(-1, 3)) if len(shape.faces) == 12 else plain_mesh(shape.vertices, shape.faces)
    )
    textured = bake_textures(mesh)
    assert face_middles(textured, textured.surface)[:, 0].min() >= 254
    assert textured.normal is None and textured.tangents is None, "the vertices' normals are all there is"


@pytest.mark.slow
@pytest.mark.parametrize("albedo", [0.0, 0.8])
def test_a_bowl_is_as_bright_as_a_sphere_says(albedo):
    """From any place of a sphere, equal parts of it are equally much of what it sees: half a sphere sees itself with 1/2 and the rim's other side
    with as much, under the sky in that direction; of light that the places reflect r comes back, in the mean over them: e = d + r e / 2."""
    vertices, faces = bowl()
    textured = bake_textures(plain_mesh(vertices, faces, albedo))
    found = face_middles(textured, textured.surface)[:, 0] / 255
    places = unit(vertices[faces].mean(1))
    inner = places[:, 2] < -0.1  # triangles at the rim see past one another
    sphere = sphere_lattice(4000).numpy()
    through = unit(sphere[sphere[:, 2] > 0] - places[:, None])
    direct = 0.5 * (1 + SKY_SLOPE * through[..., 2]).mean(1)
    # Three bounces of many: what is left of a series of albedo / 2.
    wanted = direct + direct.mean() * sum((albedo / 2) ** bounce for bounce in range(1, bake_transfer.BOUNCES + 1))
    wanted = np.minimum(wanted / (1 - SKY_SLOPE * 2 / 3 * places[:, 2]), 1)  # white walls of a bowl outshine the open
    assert abs((found - wanted)[inner].mean()) < 0.01 and np.abs(found - wanted)[inner].max() < 0.04


def wavy_ball() -> TriangleMesh:
    ball = trimesh.creation.icosphere(5)
    x, y, z = ball.vertices.T
    height = 1 + 0.03 * np.sin(9 * x) * np.sin(9 * y) * np.sin(9 * z)
    mesh = plain_mesh(ball.vertices * height[:, None], ball.faces, 0.5)
    stripes = torch.from_numpy(0.5 + 0.4 * np.sin(12 * z)).float()
    return TriangleMesh(mesh.vertices, mesh.faces, mesh.normals, stripes[:, None].expand(-1, 3).contiguous(), stripes, 1 - stripes)


@pytest.fixture(scope="module")
def wavy() -> tuple[TriangleMesh, TexturedMesh]:
    mesh = wavy_ball()
    return mesh, bake_textures(mesh, 1500)


@pytest.mark.slow
def test_a_shrunken_mesh_has_in_its_textures_what_the_large_one_is(wavy):
    mesh, textured = wavy
    small, atlas = textured.mesh, textured.atlas
    assert 1000 < len(small.faces) <= 1500
    middles = small.vertices[small.faces.long()].mean(1).numpy()
    points, triangles = mesh.vertices.double().numpy(), mesh.faces.numpy()
    _, face, place = igl.point_mesh_squared_distance(middles.astype(float), points, triangles)
    large = triangles[face]
    weights = igl.barycentric_coordinates(place, *(points[large[:, corner]] for corner in range(3)))[..., None]
    rough = (mesh.roughness.numpy()[large, None] * weights).sum(1)[:, 0]
    found = face_middles(textured, textured.surface)[:, 1:] / 255
    assert np.abs(found - np.stack([rough, 1 - rough], -1)).mean() < 0.02
    # Normals as a program that draws the file would shade them, from the file's own frames.
    assert textured.normal is not None and textured.tangents is not None
    corners = atlas.faces
    normals = unit(small.normals.numpy()[atlas.vertex_of[corners]].mean(1))
    tangents = unit(textured.tangents[corners].mean(1)[:, :3])
    ups = unit(np.cross(normals, tangents)) * textured.tangents[corners[:, 0], 3:]
    x, y, z = (2 * face_middles(textured, textured.normal) / 255 - 1).T[..., None]
    shaded, wanted = unit(x * tangents + y * ups + z * normals), unit((mesh.normals.numpy()[large] * weights).sum(1))
    off = np.degrees(np.arccos(np.clip((shaded * wanted).sum(-1), -1, 1)))
    plain = np.degrees(np.arccos(np.clip((normals * wanted).sum(-1), -1, 1)))
    assert off.mean() < 0.25 * plain.mean(), f"{off.mean():.2f} degrees, {plain.mean():.2f} without the texture"


@pytest.mark.slow
def test_tangents_run_along_u_across_the_normal_and_name_the_side_of_v(wavy):
    _, textured = wavy
    assert textured.tangents is not None
    atlas, axes, signs = textured.atlas, textured.tangents[:, :3], textured.tangents[:, 3]
    normals = textured.mesh.normals.numpy()[atlas.vertex_of]
    assert np.allclose(np.linalg.norm(axes, axis=1), 1, atol=1e-5) and set(np.unique(signs)) <= {-1.0, 1.0}
    assert np.abs((axes * normals).sum(1)).max() < 1e-5
    points = textured.mesh.vertices.numpy()[atlas.vertex_of]
    for start, end in ((0, 1), (1, 2), (2, 0)):
        a, b = atlas.faces[:, start], atlas.faces[:, end]
        step, turned = points[b] - points[a], atlas.uv[b] - atlas.uv[a]
        ups = np.cross(normals[a], axes[a]) * signs[a, None]
        along = np.stack([(step * axes[a]).sum(1), (step * ups).sum(1)], -1)
        same = (unit(along) * unit(turned * [1, -1])).sum(-1)
        assert np.median(same) > 0.99, "charts keep angles nearly, and rows run down"


def unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-30)
