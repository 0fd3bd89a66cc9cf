"""Handles: some vertices are dragged, the rest of the object follows as rigidly as it can.

In: a mesh, the vertices held, and any points to carry along (its own vertices, surfel centres). Each drag gives the points' positions and
deformation gradients. The energy is minimised on a coarser control mesh by libigl; moving least squares carry it to the points. Source:
docs/sources.md (sorkine2007).
"""

from dataclasses import dataclass

import fast_simplification
import igl
import numpy as np
import torch
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.deform.drive_mesh import vertex_gradients
from drgs.deform.gmls import GmlsSettings, build_weights, interpolate, polar_rotation

SLIVER = 1e-9
"""Faces with less area than this part of the mean are left out: their cotangents mean nothing."""


@dataclass(frozen=True)
class ArapSettings:
    control_faces: int = 20_000
    """Of the control mesh; a mesh with fewer faces is its own."""
    iterations: int = 4
    """Of each drag, which starts from the one before."""
    neighbours: int = 12
    """Control vertices that carry a point."""


class ArapHandles:
    """A mesh held by some of its vertices. Final; remembers its last pose, so that small drags take few iterations."""

    def __init__(self, vertices: Tensor, faces: Tensor, handles: Tensor, points: Tensor, settings: ArapSettings | None = None) -> None:
        """Prepare the mesh (vertex, 3), (face, 3) for drags of the vertices that `handles` (handle,) names, and points (point, 3) to carry.

        Parts of the object without a handle stay where they are.

        Raises:
            ValueError: no handle, or one that names no vertex.
        """
        settings = settings or ArapSettings()
        if not len(handles) or int(handles.min()) < 0 or int(handles.max()) >= len(vertices):
            raise ValueError(f"handles name vertices 0 to {len(vertices) - 1}, at least one; found {handles.tolist()[:8]}")
        where, corners = _control_mesh(vertices.detach().cpu().numpy(), faces.cpu().numpy(), settings.control_faces)
        _, nearest = cKDTree(where).query(vertices[handles.long()].detach().cpu().double().numpy())
        self._held, first = np.unique(nearest, return_index=True)
        self._first = torch.from_numpy(first)
        # Where a handle lies beside the control vertex that stands for it, the difference goes along, turned as that vertex last was.
        beside = where[self._held] - vertices[handles.long()].detach().cpu().double().numpy()[first]
        self._beside = torch.from_numpy(beside)[..., None]
        self._turn = torch.eye(3, dtype=torch.float64).expand(len(beside), 3, 3)
        loose = _without_handle(len(where), corners, self._held)
        self._pinned = where[loose]
        self._data = igl.ARAPData()
        self._data.max_iter = settings.iterations
        self._rest, self._pose, self._corners = where, where.copy(), torch.from_numpy(corners.astype(np.int32))
        igl.arap_precomputation(where, corners.astype(np.int64), 3, np.concatenate([self._held, loose]).astype(np.int32), self._data)
        control = torch.from_numpy(where).float()
        self._device = points.device
        self._weights = build_weights(control, points.detach().cpu(), GmlsSettings(neighbours=settings.neighbours))

    def drag(self, targets: Tensor) -> tuple[Tensor, Tensor]:
        """Positions (point, 3) and gradients (point, 3, 3) of the points when the handles are at targets (handle, 3).

        Raises:
            ValueError: targets are not finite.
        """
        if not bool(torch.isfinite(targets).all()):
            raise ValueError("the targets of handles must be finite")
        goal = (targets.detach().cpu().double()[self._first] + (self._turn @ self._beside)[..., 0]).numpy()
        bounds = np.concatenate([goal, self._pinned])
        self._pose = np.ascontiguousarray(igl.arap_solve(bounds, self._data, self._pose))
        rest, moved = torch.from_numpy(self._rest), torch.from_numpy(self._pose)
        gradients = vertex_gradients(rest, moved, self._corners)
        self._turn = polar_rotation(gradients[torch.from_numpy(self._held)])
        position, gradient = interpolate(self._weights, moved.float(), gradients.float())
        return position.to(self._device), gradient.to(self._device)


def _control_mesh(vertices: np.ndarray, faces: np.ndarray, most_faces: int) -> tuple[np.ndarray, np.ndarray]:
    """At most about `most_faces` faces, none of them a sliver, and only the vertices that they use; float64."""
    points, corners = vertices.astype(np.float64), faces.astype(np.int64)
    if len(corners) > most_faces:
        coarse, corners = fast_simplification.simplify(points.astype(np.float32), corners.astype(np.int32), target_count=most_faces)
        points, corners = coarse.astype(np.float64), corners.astype(np.int64)
    a, b, c = (points[corners[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    corners = corners[area > SLIVER * area.mean()]
    used, renumbered = np.unique(corners, return_inverse=True)
    return np.ascontiguousarray(points[used]), renumbered.reshape(-1, 3)


def _without_handle(count: int, corners: np.ndarray, held: np.ndarray) -> np.ndarray:
    """Vertices of connected parts that no handle holds."""
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]])
    _, part = connected_components(
        coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count)), directed=False
    )
    return np.flatnonzero(~np.isin(part, part[held]))
