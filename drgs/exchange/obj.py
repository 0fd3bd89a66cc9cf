"""OBJ files: positions and triangles in the file's own order, which is all that a moved mesh needs.

In: the bytes of a file. Out: plain numpy arrays. Vertices are never merged, split or reordered (a mesh of an animation must keep
them as they are); polygons become fans. It does not read materials, normals or texture coordinates.
"""

import itertools

import numpy as np

MAX_VERTICES = 20_000_000


def parse_obj(data: bytes, name: str = "OBJ") -> tuple[np.ndarray, np.ndarray]:
    """Vertices (vertex, 3) float32 and triangles (face, 3) int32; `name` is what error messages call the file.

    Raises:
        ValueError: no vertices, a line that is not understood, or a face that names a vertex which does not exist.
    """
    positions: list[list[bytes]] = []
    polygons: list[list[int]] = []
    for line in data.replace(b"\\\n", b" ").splitlines():
        words = line.split()
        if not words:
            continue
        if words[0] == b"v":
            positions.append(words[1:4])
        elif words[0] == b"f":
            try:
                corners = [int(word.partition(b"/")[0]) for word in words[1:]]
            except ValueError as error:
                raise ValueError(f"{name}: the face {line[:60]!r} is not understood") from error
            # Negative numbers count back from the last vertex so far.
            polygons.append([corner - 1 if corner > 0 else len(positions) + corner for corner in corners])
    if not 0 < len(positions) <= MAX_VERTICES:
        raise ValueError(f"{name}: has {len(positions)} vertices; expected 1 to {MAX_VERTICES}")
    try:
        vertices = np.array(positions, "S").astype(np.float64).astype(np.float32)
    except ValueError as error:
        raise ValueError(f"{name}: a vertex has a coordinate that is no number ({error})") from error
    if vertices.shape != (len(positions), 3):
        raise ValueError(f"{name}: a vertex has fewer than three coordinates")
    triangles = [[polygon[0], b, c] for polygon in polygons for b, c in itertools.pairwise(polygon[1:])]
    faces = np.array(triangles, np.int64).reshape(-1, 3)
    if faces.size and (faces.min() < 0 or faces.max() >= len(vertices)):
        raise ValueError(f"{name}: a face names vertex {int(faces.max()) + 1}, but there are {len(vertices)} vertices")
    return vertices, faces.astype(np.int32)
