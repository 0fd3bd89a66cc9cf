"""A texture atlas of a mesh, and pictures painted into it from values at the vertices.

Up to MAX_UNWRAP_FACES faces: charts by xatlas, few seams, pictures a person can retouch. Above, where unwrapping takes minutes: every
two faces share a square cell, which is instant and as exact, but has a seam at every edge. Cells near one another in the picture hold faces near
one another on the surface, for programs that draw a picture small mix what is near in it.
In and out: numpy arrays. Rows of a picture run down, as glTF's texture coordinates do.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import xatlas
from scipy.ndimage import distance_transform_edt

MAX_UNWRAP_FACES = 60_000
MIN_SIZE, MAX_SIZE = 64, 4096
TEXELS_PER_FACE = 40
"""What a face gets on average; values are linear within a face, so more would add nothing."""
GUTTER = 4
"""Texels between charts, so that filtering and the first mip levels do not mix them."""
_SORTED_CELLS = 12
"""Side of the squares of cells in which faces are sorted, no longer halved."""
_CHUNK = 1 << 19
"""Texels painted at once: some 200 bytes each."""
_EDGE = 1e-3
"""Slack of a face's border, in texels and weights: float32 coordinates must not lose a corner that lies on a texel's centre."""


@dataclass(frozen=True, eq=False)
class Atlas:
    """Where each face lies in the picture. Vertices at seams are doubled."""

    vertex_of: np.ndarray
    """(corner,) int64 vertex of the mesh that each atlas vertex copies."""
    faces: np.ndarray
    """(face, 3) int32 into the atlas vertices; the mesh's faces in their order and winding."""
    uv: np.ndarray
    """(corner, 2) float32 in 0..1, v down."""
    width: int
    height: int


def unwrap(vertices: np.ndarray, faces: np.ndarray, texels_per_face: int = TEXELS_PER_FACE) -> Atlas:
    """Atlas of a mesh with vertices (vertex, 3) and faces (face, 3); the picture's size follows from the number of faces."""
    # Charts fill about 0.65 of the picture; the size is the nearest power of two.
    size = int(np.clip(2 ** np.round(np.log2(np.sqrt(len(faces) * texels_per_face / 0.65))), MIN_SIZE, MAX_SIZE))
    if len(faces) > MAX_UNWRAP_FACES:
        return _cells(vertices, faces)
    atlas = xatlas.Atlas()
    atlas.add_mesh(_with_faces_of_unit_area(vertices, faces), np.ascontiguousarray(faces, np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding = int(size * 0.85), GUTTER  # the packer overshoots its resolution by up to a sixth
    atlas.generate(xatlas.ChartOptions(), options)
    vertex_of, atlas_faces, uv = atlas.get_mesh(0)
    if not np.array_equal(vertex_of[atlas_faces], faces) or not np.isfinite(uv).all():
        return _cells(vertices, faces)  # xatlas left faces out or moved corners: it does so with faces of no area
    # Charts keep their texels where they fit into the power of two, and shrink a little where they do not.
    uv = uv * np.array([atlas.width, atlas.height]) / max(size, atlas.width, atlas.height)
    return Atlas(vertex_of.astype(np.int64), atlas_faces.astype(np.int32), uv.astype(np.float32), size, size)


def _with_faces_of_unit_area(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """(vertex, 3) float32, moved and scaled: xatlas takes what is small in absolute numbers for nothing, whatever the unit."""
    points = np.asarray(vertices, np.float64) - np.mean(vertices, axis=0, dtype=np.float64)
    corners = points[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).mean() / 2
    return np.ascontiguousarray(points / np.sqrt(area) if area > 0 else points, np.float32)


def _cells(vertices: np.ndarray, faces: np.ndarray) -> Atlas:
    """Two faces are the lower-left and upper-right halves of each square cell, a gutter apart."""
    count = len(faces)
    columns = int(np.ceil(np.sqrt((count + 1) // 2)))
    rows = max(int(np.ceil(((count + 1) // 2) / columns)), 1)
    cell = min(MAX_SIZE // columns, 12)
    if cell < 4:
        raise ValueError(
            f"a mesh of {count} faces has no room in a texture of {MAX_SIZE}x{MAX_SIZE}; simplify it to {2 * (MAX_SIZE // 4) ** 2} faces"
        )
    low, high, gap = 0.5, cell - 0.5, 2.0
    # Corners at texel centres; the halves keep a gap between their diagonals.
    lower = [(low, low + gap), (high - gap, high), (low, high)]
    upper = [(low + gap, low), (high, low), (high, high - gap)]
    places = _near_in_picture(np.asarray(vertices, np.float64)[faces].mean(1), columns, rows)
    halves = np.where((places[:, 2] == 0)[:, None, None], np.array(lower), np.array(upper))
    width, height = columns * cell, rows * cell
    uv = (halves + cell * places[:, None, :2]).reshape(-1, 2) / np.array([width, height])
    return Atlas(
        faces.reshape(-1).astype(np.int64), np.arange(3 * count, dtype=np.int32).reshape(-1, 3), uv.astype(np.float32), width, height
    )


def _near_in_picture(centers: np.ndarray, columns: int, rows: int) -> np.ndarray:
    """(face, 3) column, row and half of a cell: the picture and the faces are halved together, until few are left to be sorted."""
    places = np.zeros((len(centers), 3), np.int64)
    waiting = [(np.arange(len(centers)), 0, 0, columns, rows)]
    while waiting:
        members, left, top, wide, tall = waiting.pop()
        if max(wide, tall) <= _SORTED_CELLS:
            spread = np.argsort(-np.ptp(centers[members], axis=0)) if len(members) else np.arange(2)
            downwards = members[np.argsort(centers[members, spread[0]], kind="stable")]
            for row in range(tall):
                across = downwards[2 * wide * row : 2 * wide * (row + 1)]
                across = across[np.argsort(centers[across, spread[1]], kind="stable")]
                number = np.arange(len(across))
                places[across] = np.stack([left + number // 2, np.full(len(across), top + row), number % 2], -1)
            continue
        first = (wide // 2, tall) if wide >= tall else (wide, tall // 2)
        room, room_left = 2 * wide * tall, 2 * first[0] * first[1]
        # As full as the whole; neither half gets more than it has room for.
        taken = max(len(members) * room_left // room, len(members) - (room - room_left))
        axis = int(np.ptp(centers[members], axis=0).argmax()) if len(members) else 0
        order = members[np.argpartition(centers[members, axis], taken)] if 0 < taken < len(members) else members
        waiting.append((order[:taken], left, top, *first))
        if wide >= tall:
            waiting.append((order[taken:], left + first[0], top, wide - first[0], tall))
        else:
            waiting.append((order[taken:], left, top + first[1], wide, tall - first[1]))
    return places


def _as_they_are(values: np.ndarray) -> np.ndarray:
    return values


def paint(atlas: Atlas, values: np.ndarray, texel: Callable[[np.ndarray], np.ndarray] = _as_they_are) -> np.ndarray:
    """(height, width, j) picture of values (vertex, k), linear over each face; the rest takes the nearest painted texel.

    Args:
        texel: from float32 values (n, k) to what is kept of them, (n, j) of any type: a large picture is never there in another form.
    """
    kept = texel(np.zeros((0, values.shape[1]), np.float32))
    picture = np.zeros((atlas.height, atlas.width, kept.shape[1]), kept.dtype)
    painted = np.zeros((atlas.height, atlas.width), bool)
    triangles = atlas.uv[atlas.faces].astype(np.float64) * np.array([atlas.width, atlas.height]) - 0.5  # texel centres at whole numbers
    corner_values = values[atlas.vertex_of[atlas.faces]]
    low = np.maximum(np.ceil(triangles.min(1) - _EDGE), 0).astype(np.int64)
    high = np.minimum(np.floor(triangles.max(1) + _EDGE), np.array([atlas.width, atlas.height]) - 1).astype(np.int64)
    spans = np.maximum(high - low + 1, 0)
    areas = spans.prod(-1)
    start = 0
    while start < len(areas):
        # As many faces as have their boxes within a chunk of texels, at least one.
        stop = start + max(int(np.searchsorted(np.cumsum(areas[start:]), _CHUNK, "right")), 1)
        face = np.repeat(np.arange(start, stop), areas[start:stop])
        step = np.arange(len(face)) - np.repeat(np.cumsum(areas[start:stop]) - areas[start:stop], areas[start:stop])
        x, y = low[face, 0] + step % spans[face, 0], low[face, 1] + step // spans[face, 0]
        weights = _barycentric(triangles[face], np.stack([x, y], -1).astype(np.float64))
        inside = (weights >= -_EDGE).all(-1)
        face, x, y, weights = face[inside], x[inside], y[inside], weights[inside]
        picture[y, x] = texel((corner_values[face] * weights[..., None]).sum(1).astype(np.float32))
        painted[y, x] = True
        start = stop
    if not painted.any():
        return picture
    rows, columns = distance_transform_edt(~painted, return_distances=False, return_indices=True)
    for row in range(atlas.height):
        bare = ~painted[row]
        picture[row, bare] = picture[rows[row, bare], columns[row, bare]]
    return picture


def _barycentric(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """(n, 3) weights of points (n, 2) in triangles (n, 3, 2); nan for triangles without area."""
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    u, v, p = b - a, c - a, points - a
    area = u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        second = (p[:, 0] * v[:, 1] - p[:, 1] * v[:, 0]) / area
        third = (u[:, 0] * p[:, 1] - u[:, 1] * p[:, 0]) / area
    return np.stack([1 - second - third, second, third], -1)
