"""A mesh of even triangles in the place of one whose triangles were pulled, folded or pushed through each other.

The surface is sampled again: signed distances on a grid near it, inside by the generalised winding number, which forgives folds and
self-intersections; their zero set; fewer faces by quadrics. What vertices carry is interpolated at the nearest places of the old mesh.
Sources: Barill et al. 2018 (fast winding numbers), Lewiner et al. 2003 (marching cubes); docs/sources.md: barill2018, lewiner2003.
"""

from dataclasses import dataclass

import igl
import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import binary_dilation, binary_erosion, label
from skimage.measure import marching_cubes
from torch import Tensor

from drgs.reconstruct.geometry.extract_mesh import MeshSettings
from drgs.reconstruct.geometry.extract_mesh.clean_mesh import clean_mesh

BAND = 3
"""Cells around the surface in which distances are computed; beyond, only inside and outside are told apart."""
SHORTEST_EDGE = 0.05
"""Of a cell: vertices closer than that are one."""
INSIDE = 0.5
"""Winding number."""


class NothingEnclosed(ValueError):
    """A mesh has no inside at the resolution asked for; the text is a sentence."""


@dataclass(frozen=True, eq=False)
class Remeshed:
    """Even triangles, and where their vertices lie on the old mesh."""

    vertices: Float[Tensor, "vertex 3"]
    faces: Int[Tensor, "face 3"]
    corners: Int[Tensor, "vertex 3"]
    """Old vertices around each new one."""
    weights: Float[Tensor, "vertex 3"]

    def carried(self, values: Tensor) -> Tensor:
        """(vertex, ...) of what the old vertices carried (old vertex, ...)."""
        return torch.einsum("vk,vk...->v...", self.weights, values[self.corners])


def remesh(vertices: Tensor, faces: Tensor, settings: MeshSettings) -> Remeshed:
    """The surface of a closed mesh in at most settings.face_limit even triangles.

    Args:
        vertices: (vertex, 3). faces: (face, 3). settings: its resolution counts cells along the longest side.

    Raises:
        ValueError: a vertex is not finite.
        NothingEnclosed: the mesh encloses nothing at this resolution.
    """
    old = vertices.detach().cpu().double().numpy()
    lost = np.flatnonzero(~np.isfinite(old).all(1))
    if len(lost):
        raise ValueError(
            f"{len(lost)} of {len(old)} vertices of the mesh are not finite, the first is number {lost[0]}; expected finite coordinates"
        )
    triangles = faces.cpu().numpy().astype(np.int64)
    low, high = old.min(0), old.max(0)
    cell = float((high - low).max()) / settings.resolution
    origin = low - (BAND + 1) * cell
    shape = tuple((np.ceil((high - low) / cell).astype(int) + 2 * (BAND + 1) + 1).tolist())
    near = _near(old, triangles, origin, cell, shape)
    at = origin + cell * np.argwhere(near)
    squared = igl.point_mesh_squared_distance(at, old, triangles)[0]
    distance = np.ones(shape)
    distance[near] = np.sqrt(squared)
    inside = _inside(old, triangles, near, at, distance > cell)
    distance[near] *= np.where(inside, -1, 1)
    if not inside.any():
        raise NothingEnclosed(
            f"the mesh of {len(triangles)} faces encloses nothing at {settings.resolution} cells; expected a closed surface"
        )
    # Cubes all of whose corners were computed; none of the surface lies in others.
    whole = binary_erosion(near, np.ones((3, 3, 3), bool))
    found, found_faces, _, _ = marching_cubes(distance, 0.0, spacing=(cell,) * 3, mask=whole)
    points = torch.from_numpy(found + origin)
    clean, new_faces = clean_mesh(points, torch.from_numpy(found_faces.copy()), settings, SHORTEST_EDGE * cell)
    new = clean.double().numpy()
    _, face, closest = igl.point_mesh_squared_distance(new, old, triangles)
    corners = triangles[face]
    weights = igl.barycentric_coordinates(closest, *(np.ascontiguousarray(old[corners[:, k]]) for k in range(3)))
    device = vertices.device
    weights = np.nan_to_num(weights, nan=1 / 3).clip(0, 1)
    weights /= weights.sum(1, keepdims=True)
    return Remeshed(
        clean.to(vertices),
        new_faces.to(faces),
        torch.from_numpy(corners).to(device),
        torch.from_numpy(weights.astype(np.float32)).to(vertices),
    )


def _inside(vertices: np.ndarray, triangles: np.ndarray, near: np.ndarray, at: np.ndarray, far: np.ndarray) -> np.ndarray:
    """(near node,) bool. Between two neighbouring nodes that are farther from the surface than from each other it does not pass: of all that hang
    together so, one is asked. That leaves three nodes in ten.

    Args:
        near: nodes that are asked about, on the grid. at: where they are. far: nodes more than a cell from the surface.
    """
    part = label(near & far)[0][near]
    in_parts = np.flatnonzero(part)
    examples = in_parts[np.unique(part[in_parts], return_index=True)[1]]
    asked = np.concatenate([np.flatnonzero(part == 0), examples])
    inside = np.zeros(len(at), bool)
    inside[asked] = igl.fast_winding_number(vertices, triangles, at[asked]) > INSIDE
    inside[in_parts] = inside[examples][part[in_parts] - 1]
    return inside


def _near(vertices: np.ndarray, triangles: np.ndarray, origin: np.ndarray, cell: float, shape: tuple[int, ...]) -> np.ndarray:
    """Of the grid's nodes, those within BAND cells of the surface: around samples of it no farther apart than a cell."""
    corners = vertices[triangles]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(1)
    parts = np.ceil(longest / cell).astype(int).clip(1)
    near = np.zeros(shape, bool)
    for count in np.unique(parts):
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        u, v = (x[i + j <= count] / count for x in (i, j))
        a, b, c = (corners[parts == count][:, k, None] for k in range(3))
        points = (a + u[None, :, None] * (b - a) + v[None, :, None] * (c - a)).reshape(-1, 3)
        nodes = np.floor((points - origin) / cell + 0.5).astype(int)
        near[tuple(nodes.T)] = True
    return binary_dilation(near, np.ones((3, 3, 3), bool), BAND - 1)
