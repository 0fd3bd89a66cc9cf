"""Make a raw isosurface fit for use: one component, smooth, few faces, no slivers of zero area, wound outward."""

from dataclasses import dataclass

import fast_simplification
import numpy as np
import torch
from jaxtyping import Float, Int
from numpy import ndarray
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from drgs.maths.unique_rows import unique_rows
from drgs.reconstruct.geometry.extract_mesh.records import MeshSettings

TAUBIN_SHRINK, TAUBIN_GROW = 0.5, -0.53
"""Taubin's lambda and mu: pass band 0.11, so bumps longer than a few edges keep their height."""
SIMPLIFY_ATTEMPTS = (4.0, 5.0, 3.0, 6.0, 7.0)
"""Aggressiveness of quadric simplification in the order tried: 4 is as fast as the library's 7 and closer to the input."""


@dataclass(frozen=True)
class MeshReport:
    """What to tell the user about a mesh."""

    vertex_count: int
    face_count: int
    watertight: bool
    component_count: int
    area: float
    """[world units squared]"""
    volume: float
    """[world units cubed]; means nothing unless watertight."""


def clean_mesh(
    vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"], settings: MeshSettings, shortest_edge: float
) -> tuple[Float[Tensor, "new_vertex 3"], Int[Tensor, "new_face 3"]]:
    """Components chosen, smoothed, simplified; vertices closer than `shortest_edge` [world units] along an edge are merged."""
    points, triangles = vertices.double().cpu().numpy(), faces.long().cpu().numpy()
    points, triangles = keep_components(points, triangles, settings.keep_component_fraction)
    for _ in range(settings.smoothing_passes):
        points = taubin_pass(points, triangles)
    if len(triangles) > settings.face_limit:
        points, triangles = simplify(points, triangles, settings.face_limit, shortest_edge)
    else:
        points, triangles = drop_degenerate(points, triangles, shortest_edge)
    points, triangles = keep_components(points, triangles, settings.keep_component_fraction)
    if signed_volume(points, triangles) < 0:
        triangles = triangles[:, ::-1]
    return (
        torch.from_numpy(np.ascontiguousarray(points, np.float32)).to(vertices.device),
        torch.from_numpy(np.ascontiguousarray(triangles, np.int32)).to(faces.device),
    )


def keep_components(
    points: Float[ndarray, "vertex 3"], triangles: Int[ndarray, "face 3"], fraction: float
) -> tuple[Float[ndarray, "new_vertex 3"], Int[ndarray, "new_face 3"]]:
    """Components whose area is at least `fraction` of the largest one's, without unused vertices."""
    labels = component_labels(len(points), triangles)[triangles[:, 0]]
    areas = np.bincount(labels, weights=face_areas(points, triangles))
    if fraction >= 1.0:
        return used_only(points, triangles[labels == areas.argmax()])
    return used_only(points, triangles[(areas >= fraction * areas.max())[labels]])


def component_labels(vertex_count: int, triangles: Int[ndarray, "face 3"]) -> Int[ndarray, "{vertex_count}"]:
    """(vertex,) component of each vertex."""
    start, end = triangles.reshape(-1), np.roll(triangles, -1, 1).reshape(-1)
    graph = csr_matrix((np.ones(len(start), np.int8), (start, end)), shape=(vertex_count, vertex_count))
    return connected_components(graph, directed=False)[1]


def taubin_pass(points: Float[ndarray, "vertex 3"], triangles: Int[ndarray, "face 3"]) -> Float[ndarray, "vertex 3"]:
    """One shrinking and one growing step towards the neighbours' mean."""
    start, end = triangles.reshape(-1), np.roll(triangles, -1, 1).reshape(-1)
    adjacency = csr_matrix((np.ones(len(start)), (start, end)), shape=(len(points), len(points)))
    adjacency = adjacency + adjacency.T
    degree = np.asarray(adjacency.sum(1)).reshape(-1, 1)
    for step in (TAUBIN_SHRINK, TAUBIN_GROW):
        points = points + step * (adjacency @ points / degree - points)
    return points


def simplify(
    points: Float[ndarray, "vertex 3"], triangles: Int[ndarray, "face 3"], face_limit: int, shortest_edge: float
) -> tuple[Float[ndarray, "new_vertex 3"], Int[ndarray, "new_face 3"]]:
    """At most `face_limit` faces by quadric edge collapse, closed if the input is closed and one of the attempts keeps it so.

    Collapsing edges can fold a few faces onto each other; another aggressiveness takes another order and mostly does not.
    """
    must_close = is_watertight(len(points), triangles)
    fallback: tuple[np.ndarray, np.ndarray] | None = None
    for aggressiveness in SIMPLIFY_ATTEMPTS:
        simple, simple_triangles = fast_simplification.simplify(
            points.astype(np.float32), triangles, target_count=face_limit, agg=aggressiveness
        )
        simple, simple_triangles = drop_degenerate(simple.astype(np.float64), simple_triangles.astype(np.int64), shortest_edge)
        within_limit = len(simple_triangles) <= face_limit
        if within_limit and (not must_close or is_watertight(len(simple), simple_triangles)):
            return simple, simple_triangles
        if fallback is None or (within_limit and len(fallback[1]) > face_limit):
            fallback = simple, simple_triangles
    assert fallback is not None
    return fallback


def drop_degenerate(
    points: Float[ndarray, "vertex 3"], triangles: Int[ndarray, "face 3"], shortest_edge: float
) -> tuple[Float[ndarray, "new_vertex 3"], Int[ndarray, "new_face 3"]]:
    """Merge the ends of edges shorter than `shortest_edge`, then drop faces that lost a corner and pairs of equal faces."""
    start, end = triangles.reshape(-1), np.roll(triangles, -1, 1).reshape(-1)
    short = np.linalg.norm(points[start] - points[end], axis=1) < shortest_edge
    if short.any():
        graph = csr_matrix((np.ones(int(short.sum()), np.int8), (start[short], end[short])), shape=(len(points), len(points)))
        label = connected_components(graph, directed=False)[1]
        _, representative = np.unique(label, return_index=True)
        points, triangles = points[representative], label[triangles].astype(np.int64)
    distinct = (triangles != np.roll(triangles, -1, 1)).all(1)
    triangles = triangles[distinct]
    # Two faces on the same three vertices enclose nothing: drop both, and what is left stays closed.
    number = unique_rows(torch.from_numpy(np.sort(triangles, 1)))[1].numpy()
    return used_only(points, triangles[np.bincount(number)[number] == 1])


def used_only(
    points: Float[ndarray, "vertex 3"], triangles: Int[ndarray, "face 3"]
) -> tuple[Float[ndarray, "new_vertex 3"], Int[ndarray, "face 3"]]:
    """Without vertices that no face uses."""
    used = np.zeros(len(points), bool)
    used[triangles.reshape(-1)] = True
    new_index = np.cumsum(used) - 1
    return points[used], new_index[triangles]


def face_areas(points: Float[ndarray, "vertex 3"], triangles: Int[ndarray, "face 3"]) -> Float[ndarray, "face"]:
    """(face,)"""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def signed_volume(points: Float[ndarray, "vertex 3"], triangles: Int[ndarray, "face 3"]) -> float:
    """Enclosed volume, positive when faces are counter-clockwise seen from outside."""
    a, b, c = (points[triangles[:, k]] - points.mean(0) for k in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def is_watertight(vertex_count: int, triangles: Int[ndarray, "face 3"]) -> bool:
    """Every edge belongs to exactly two faces that run along it in opposite directions."""
    start, end = triangles.reshape(-1), np.roll(triangles, -1, 1).reshape(-1)
    forward, backward = np.sort(start * vertex_count + end), np.sort(end * vertex_count + start)
    return bool((np.diff(forward) > 0).all() and (forward == backward).all())


def mesh_report(vertices: Float[Tensor, "vertex 3"], faces: Int[Tensor, "face 3"]) -> MeshReport:
    """Counts, closedness, area and volume of any triangle mesh."""
    points, triangles = vertices.double().cpu().numpy(), faces.long().cpu().numpy()
    return MeshReport(
        vertex_count=len(points),
        face_count=len(triangles),
        watertight=is_watertight(len(points), triangles),
        component_count=len(np.unique(component_labels(len(points), triangles)[triangles[:, 0]])),
        area=float(face_areas(points, triangles).sum()),
        volume=signed_volume(points, triangles),
    )
