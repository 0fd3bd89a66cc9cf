"""Handles: some vertices are dragged, the rest of the object follows as rigidly as it can.

In: a mesh, the vertices held, and any points to carry along (its own vertices, surfel centres). Each drag gives the points' positions and
deformation gradients, and depends on its targets alone: it starts at the rest pose, placed as the targets lie, goes to them in a few
steps on a coarse mesh, then to rest on a finer one. Both are prepared once; libigl minimises the energy, moving least squares carry the
pose from mesh to mesh and to the points. Source: docs/sources.md (sorkine2007).
"""

import threading
from dataclasses import dataclass

import fast_simplification
import igl
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import coo_matrix, diags
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.deform.carry.gmls import GmlsSettings, Weights, build_weights, interpolate, polar_rotation

SLIVER = 1e-9
"""Faces with less area than this part of the mean are left out: their cotangents mean nothing."""
WORTH_TWO_MESHES = 1.5
"""A mesh with fewer faces than this many coarse ones is solved by itself."""
FARTHEST = 1e3
"""Sizes of the object that a handle may go."""


@dataclass(frozen=True)
class ArapSettings:
    control_faces: int = 20_000
    """Of the control mesh; a mesh with fewer faces is its own."""
    coarse_faces: int = 1_500
    """Of the mesh on which drags are found."""
    steps: int = 3
    """From rest to the targets, on the coarse mesh."""
    coarse_iterations: int = 8
    """Of each step; the last takes twice as many."""
    iterations: int = 2
    """On the control mesh, from where the coarse one leads."""
    neighbours: int = 12
    """Vertices that carry a point."""


class ArapHandles:
    """A mesh held by some of its vertices. Final; drags leave no trace in it."""

    def __init__(
        self,
        vertices: Float[Tensor, "vertex 3"],
        faces: Int[Tensor, "face 3"],
        handles: Int[Tensor, "handle"],
        points: Float[Tensor, "point 3"],
        settings: ArapSettings | None = None,
    ) -> None:
        """Prepare the mesh (vertex, 3), (face, 3) for drags of the vertices that `handles` (handle,) names, and points (point, 3) to carry.

        Parts of the object without a handle stay where they are.

        Raises:
            ValueError: no handle, or one that names no vertex.
        """
        settings = settings or ArapSettings()
        if not len(handles) or int(handles.min()) < 0 or int(handles.max()) >= len(vertices):
            raise ValueError(f"handles name vertices 0 to {len(vertices) - 1}, at least one; found {handles.tolist()[:8]}")
        self._settings = settings
        mesh, triangles = vertices.detach().cpu().numpy(), faces.cpu().numpy()
        self._handles = vertices[handles.long()].detach().cpu().double()
        self._control = _Level(mesh, triangles, settings.control_faces, self._handles)
        self._coarse = self._control
        self._refine: Weights | None = None
        gmls = GmlsSettings(neighbours=settings.neighbours)
        if len(self._control.corners) > WORTH_TWO_MESHES * settings.coarse_faces:
            self._coarse = _Level(mesh, triangles, settings.coarse_faces, self._handles)
            self._refine = build_weights(self._coarse.rest.float(), self._control.rest.float(), gmls)
        self._device = points.device
        self._weights = build_weights(self._control.rest.float(), points.detach().cpu(), gmls)

    @property
    def control_faces(self) -> int:
        """How many faces the control mesh has."""
        return len(self._control.corners)

    def drag(self, targets: Float[Tensor, "handle 3"]) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 3 3"]]:
        """Positions (point, 3) and gradients (point, 3, 3) of the points when the handles are at targets (handle, 3).

        Raises:
            ValueError: targets are not finite, or far beyond the object's size.
        """
        far = FARTHEST * float((self._control.rest.amax(0) - self._control.rest.amin(0)).norm())
        if not bool(((targets.detach().cpu() - self._handles).abs() <= far).all()):
            raise ValueError(f"the targets of handles must be finite, and not too far away: within {far:.3g} of where the handles are")
        settings, coarse, control = self._settings, self._coarse, self._control
        goal = targets.detach().cpu().double()
        turn, shift = _rigid_fit(self._handles, goal)
        begin = self._handles @ turn.T + shift
        pose, turns = coarse.rest @ turn.T + shift, turn.expand(len(coarse.held), 3, 3)
        for step in range(1, settings.steps + 1):
            iterations = settings.coarse_iterations * (2 if step == settings.steps else 1)
            pose = coarse.solve(begin + (goal - begin) * (step / settings.steps), turns, pose, iterations)
            gradients = coarse.gradients(pose)
            turns = polar_rotation(gradients[coarse.held])
        if self._refine is not None:
            pose, gradients = interpolate(self._refine, pose.float(), gradients.float())
            pose = control.solve(goal, polar_rotation(gradients[control.held].double()), pose.double(), settings.iterations)
            gradients = control.gradients(pose)
        position, gradient = interpolate(self._weights, pose.float(), gradients.float())
        return position.to(self._device), gradient.to(self._device)


class _Level:
    """A control mesh, held where the handles are, and factorised. Final; nothing in it changes."""

    def __init__(
        self, vertices: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"], most_faces: int, handles: Float[Tensor, "handle 3"]
    ) -> None:
        where, corners = _control_mesh(vertices, faces, most_faces)
        _, nearest = cKDTree(where).query(handles.numpy())
        held, group = np.unique(nearest, return_inverse=True)
        self.rest, self.corners = torch.from_numpy(where), torch.from_numpy(corners.astype(np.int32))
        self.held, self._group = torch.from_numpy(held).long(), torch.from_numpy(group.reshape(-1)).long()
        # Several handles may share a vertex, which then goes with their mean; what it lies beside that goes along, turned as it was.
        self._beside = self.rest[self.held] - self._mean(handles)
        loose = _without_handle(len(where), corners, held)
        self._pinned = where[loose]
        # F of a vertex is a sum over its faces, as in drive_mesh; what of it does not change is kept, since every drag needs it often.
        area, frames = _face_frames(where, corners)
        self._inverse_frames = np.linalg.inv(frames)
        spread = coo_matrix(
            (np.repeat(area, 3), (corners.reshape(-1), np.repeat(np.arange(len(corners)), 3))), shape=(len(where), len(corners))
        )
        self._vertex_from_faces = (diags(1 / np.maximum(np.asarray(spread.sum(1))[:, 0], 1e-300)) @ spread).tocsr()
        self._data, self._lock = igl.ARAPData(), threading.Lock()
        igl.arap_precomputation(where, corners.astype(np.int64), 3, np.concatenate([held, loose]).astype(np.int32), self._data)

    def solve(
        self, targets: Float[Tensor, "handle 3"], turns: Float[Tensor, "held 3 3"], start: Float[Tensor, "vertex 3"], iterations: int
    ) -> Float[Tensor, "vertex 3"]:
        """Pose (vertex, 3) from one nearby, with handles at targets (handle, 3) and what held vertices lie beside them turned (held, 3, 3)."""
        goal = self._mean(targets) + (turns @ self._beside[..., None])[..., 0]
        with self._lock:
            self._data.max_iter = iterations
            pose = igl.arap_solve(np.concatenate([goal.numpy(), self._pinned]), self._data, np.ascontiguousarray(start.numpy()))
        moved = torch.from_numpy(np.ascontiguousarray(pose))
        if not bool(torch.isfinite(moved).all()):
            raise ValueError("these handles cannot be solved for: the mesh is degenerate")
        return moved

    def gradients(self, pose: Float[Tensor, "vertex 3"]) -> Float[Tensor, "vertex 3 3"]:
        """(vertex, 3, 3) deformation gradients of a pose (vertex, 3): the means over their faces by area."""
        _, frames = _face_frames(pose.numpy(), self.corners.numpy())
        return torch.from_numpy((self._vertex_from_faces @ (frames @ self._inverse_frames).reshape(-1, 9)).reshape(-1, 3, 3))

    def _mean(self, values: Float[Tensor, "handle 3"]) -> Float[Tensor, "held 3"]:
        """(held, 3) means of (handle, 3)."""
        count = torch.bincount(self._group, minlength=len(self.held)).double()
        return torch.zeros(len(self.held), 3, dtype=torch.float64).index_add_(0, self._group, values) / count[:, None]


def _rigid_fit(points: Float[Tensor, "n 3"], targets: Float[Tensor, "n 3"]) -> tuple[Float[Tensor, "3 3"], Float[Tensor, "3"]]:
    """Rotation (3, 3) and shift (3,) that take points (n, 3) nearest to targets; no turn beyond what they tell."""
    middle, goal = points.mean(0), targets.mean(0)
    spread = (targets - goal).T @ (points - middle)
    # What a point or a line leaves open stays as it is: the identity, by a little.
    turn = polar_rotation((spread + 1e-6 * (spread.norm() + 1e-30) * torch.eye(3, dtype=spread.dtype))[None])[0]
    return turn, goal - turn @ middle


def _face_frames(
    points: Float[ndarray, "vertex 3"], corners: Int[ndarray, "face 3"]
) -> tuple[Float[ndarray, "face"], Float[ndarray, "face 3 3"]]:
    """Twice the areas (face,), and (face, 3, 3) with columns e1, e2 and the unit normal times the square root of that."""
    a, b, c = (points[corners[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    size = np.linalg.norm(normal, axis=1)
    return size, np.stack([b - a, c - a, normal / np.sqrt(np.maximum(size, 1e-300))[:, None]], -1)


def _control_mesh(
    vertices: Float[ndarray, "vertex 3"], faces: Int[ndarray, "face 3"], most_faces: int
) -> tuple[Float[ndarray, "control_vertex 3"], Int[ndarray, "control_face 3"]]:
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


def _without_handle(count: int, corners: Int[ndarray, "face 3"], held: Int[ndarray, "held"]) -> Int[ndarray, "loose"]:
    """Vertices of connected parts that no handle holds."""
    pairs = np.concatenate([corners[:, [0, 1]], corners[:, [1, 2]]])
    _, part = connected_components(
        coo_matrix((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count)), directed=False
    )
    return np.flatnonzero(~np.isin(part, part[held]))
