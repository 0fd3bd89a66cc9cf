import tracemalloc

import numpy as np
import pytest
import trimesh

from drgs.exchange import texture_atlas
from drgs.exchange.texture_atlas import paint, unwrap


@pytest.fixture(params=["charts", "cells"])
def sphere(request, monkeypatch):
    if request.param == "cells":
        monkeypatch.setattr(texture_atlas, "MAX_UNWRAP_FACES", 0)
    mesh = trimesh.creation.icosphere(3)
    return np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces, np.int32)


def sample(picture, uv):
    """Bilinear, rows down, clamped at the border."""
    height, width, _ = picture.shape
    x, y = uv[:, 0] * width - 0.5, uv[:, 1] * height - 0.5
    x0, y0 = np.clip(np.floor(x).astype(int), 0, width - 2), np.clip(np.floor(y).astype(int), 0, height - 2)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    top, bottom = picture[y0, x0] * (1 - fx) + picture[y0, x0 + 1] * fx, picture[y0 + 1, x0] * (1 - fx) + picture[y0 + 1, x0 + 1] * fx
    return top * (1 - fy) + bottom * fy


def test_the_atlas_keeps_faces_corners_and_the_unit_square(sphere):
    atlas = unwrap(*sphere)
    assert np.array_equal(atlas.vertex_of[atlas.faces], sphere[1])
    assert atlas.uv.min() >= 0 and atlas.uv.max() <= 1


@pytest.mark.parametrize(("radius", "center"), [(1e-5, 0.0), (0.01, 0.0), (1e6, 0.0), (0.01, 5.0)])
def test_an_object_of_any_size_fills_its_picture(radius, center):
    mesh = trimesh.creation.icosphere(3, radius)
    atlas = unwrap(np.asarray(mesh.vertices + center, np.float32), np.asarray(mesh.faces, np.int32))
    first, second = np.moveaxis(np.diff(atlas.uv[atlas.faces].astype(float), axis=1), 1, 0)
    covered = np.abs(first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum() / 2
    assert covered > 0.4 and len(atlas.uv) < 1.5 * len(mesh.vertices), "charts, not single faces"


def test_no_two_faces_share_a_place_in_the_picture(sphere):
    vertices, faces = sphere
    atlas = unwrap(vertices, faces)
    corners = atlas.uv[atlas.faces].astype(float)
    triangles = corners.mean(1, keepdims=True) + 0.98 * (corners - corners.mean(1, keepdims=True))
    points = np.random.default_rng(0).random((1_000, 2))
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]

    def side(p, q):
        return (q[:, 0] - p[:, 0]) * (points[:, None, 1] - p[:, 1]) - (q[:, 1] - p[:, 1]) * (points[:, None, 0] - p[:, 0])

    signs = np.stack([side(a, b), side(b, c), side(c, a)])
    owners = ((signs > 0).all(0) | (signs < 0).all(0)).sum(1)
    assert owners.max() == 1 and owners.mean() > 0.3


def test_painted_values_are_read_back_within_every_face_and_at_every_corner(sphere):
    vertices, faces = sphere
    atlas = unwrap(vertices, faces)
    picture = paint(atlas, vertices)
    corners = atlas.uv[atlas.faces]
    inner = np.einsum("k,fkc->fc", [0.5, 0.3, 0.2], corners)
    expected = np.einsum("k,fkc->fc", [0.5, 0.3, 0.2], vertices[faces])
    assert np.abs(sample(picture, inner) - expected).max() < 0.02
    assert np.abs(sample(picture, atlas.uv) - vertices[atlas.vertex_of]).max() < 0.05


def test_no_texel_stays_unpainted(sphere):
    assert (paint(unwrap(*sphere), np.ones((len(sphere[0]), 1))) == 1).all()


def test_faces_without_area_fall_back_to_cells_instead_of_being_lost():
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 3, 0]], np.int32)
    atlas = unwrap(vertices, faces)
    assert np.array_equal(atlas.vertex_of[atlas.faces], faces)
    assert np.isfinite(paint(atlas, vertices)).all()


@pytest.mark.parametrize("count", [1, 2, 3, 577, 5120])
def test_cells_that_are_near_in_the_picture_hold_faces_that_are_near_on_the_surface(count, monkeypatch):
    """Who draws a picture small mixes its texels, eight by eight and more: whatever the order of the faces, they are of one place."""
    monkeypatch.setattr(texture_atlas, "MAX_UNWRAP_FACES", 0)
    mesh = trimesh.creation.icosphere(4)
    faces = np.random.default_rng(0).permutation(np.asarray(mesh.faces, np.int32))[:count]
    atlas = unwrap(np.asarray(mesh.vertices, np.float32), faces)
    middles = atlas.uv[atlas.faces].mean(1) * [atlas.width, atlas.height]
    cells = np.floor(middles / 12).astype(int) * 2 + [1, 0] * (middles[:, :1] % 12 > middles[:, 1:] % 12)
    assert len(np.unique(cells, axis=0)) == count, "a half of a cell each"
    if count == 5120:
        picture = paint(atlas, np.asarray(mesh.vertices, np.float32))
        height, width = (side // 8 * 8 for side in picture.shape[:2])
        small = picture[:height, :width].reshape(height // 8, 8, width // 8, 8, 3).mean((1, 3))
        column, row = np.minimum(middles.T // 8, [[width // 8 - 1], [height // 8 - 1]]).astype(int)
        off = np.linalg.norm(small[row, column] - np.asarray(mesh.vertices)[faces].mean(1), axis=1)
        assert off.mean() < 0.1, "two edges' length; 0.9 where cells are in the order of the faces"


@pytest.mark.slow
def test_painting_takes_memory_in_proportion_to_the_picture():
    mesh = trimesh.creation.icosphere(6)  # 81 920 faces, in cells
    atlas = unwrap(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    tracemalloc.start()
    picture = paint(atlas, np.asarray(mesh.vertices, np.float32))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 4 * picture.nbytes  # 208 MiB of 68; all faces at once took 903
