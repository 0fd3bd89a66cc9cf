"""How far a built mesh lies from the true one, where training cameras see the true one.

Lengths are percent of the true mesh's radius (farthest vertex from the middle of its box); samples are uniform by area. The figures that
score_mesh.py of the benchmark has are defined as there and drawn with its random numbers: both agree but for rounding.

    accuracy_*        built surface -> nearest true surface
    completeness_*    true surface seen by at least two training cameras -> nearest built surface
    normal_*          angle [degrees] at those true points to the built face there
    recall            share of those true points with a built point within 0.5 %
    offset_median     signed: of the nearest built point along the true normal at those true points; below 0 the built surface lies inside
    offset_mean_abs   mean of its absolute value; unlike the distances it has no floor from the samples' spacing (0.15 % on a perfect mesh)
    share_inside      share of those true points where it lies inside
    components, watertight, faces   of the built mesh
"""

from dataclasses import dataclass

import numpy as np
import torch
import trimesh
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh

Array = NDArray[np.float64]
COUNT = 100_000
DENSE = 10
"""Times as many samples stand for the surface that distances are measured to."""
FACING = 0.1
"""Smallest cosine at which a camera sees a point."""
LIFT = 1e-3
"""Of the rays from a point to the cameras [share of the radius]."""


@dataclass(frozen=True, eq=False)
class SurfaceSamples:
    """Points uniform by area."""

    points: Array
    """(sample, 3)"""
    normals: Array
    """(sample, 3) of their faces."""
    face: NDArray[np.int64]
    barycentric: Array
    """(sample, 3)"""


def sample_surface(mesh: TriangleMesh, count: int, seed: int) -> SurfaceSamples:
    corners = mesh.vertices.double().numpy()[mesh.faces.long().numpy()]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    random = np.random.default_rng(seed)
    face = random.choice(len(length), count, p=length / length.sum())
    a, b = np.sqrt(random.random(count)), random.random(count)
    barycentric = np.stack([1 - a, a * (1 - b), a * b], -1)
    points = (barycentric[:, :, None] * corners[face]).sum(1)
    return SurfaceSamples(points, normals[face] / length[face, None], face, barycentric)


def mesh_radius(mesh: TriangleMesh) -> float:
    """Farthest vertex from the middle of the mesh's box [world units]."""
    middle = (mesh.vertices.amin(0) + mesh.vertices.amax(0)) / 2
    return float((mesh.vertices - middle).norm(dim=1).max())


def mesh_figures(true: TriangleMesh, built: TriangleMesh, cameras: list[Camera], count: int = COUNT) -> dict:
    """The figures above.

    Args:
        cameras: the training cameras.

    Raises:
        ValueError: no point of the true mesh is seen by two cameras.
    """
    radius = mesh_radius(true)
    truth, found = sample_surface(true, count, 1), sample_surface(built, count, 2)
    dense_truth, dense_found = sample_surface(true, DENSE * count, 3), sample_surface(built, DENSE * count, 4)
    seen = count_cameras(true, truth, cameras, radius) >= 2
    if not seen.any():
        raise ValueError("no point of the true mesh is seen by two training cameras")
    points, normals = truth.points[seen], truth.normals[seen]
    accuracy = cKDTree(dense_truth.points).query(found.points, workers=-1)[0] / radius * 100
    distance, nearest = cKDTree(dense_found.points).query(points, workers=-1)
    completeness = distance / radius * 100
    angle = np.degrees(np.arccos(np.clip((normals * dense_found.normals[nearest]).sum(1), -1, 1)))
    # Along the normal: the sideways part of the way to the nearest sample is the samples' spacing, not an error.
    offset = ((dense_found.points[nearest] - points) * normals).sum(1) / radius * 100
    welded = trimesh.Trimesh(built.vertices.numpy(), built.faces.numpy(), process=False)
    welded.merge_vertices(merge_tex=True, merge_norm=True)
    return {
        "accuracy_mean": float(accuracy.mean()),
        "accuracy_p95": float(np.percentile(accuracy, 95)),
        "completeness_mean": float(completeness.mean()),
        "completeness_p95": float(np.percentile(completeness, 95)),
        "normal_mean": float(angle.mean()),
        "normal_median": float(np.median(angle)),
        "recall": float((completeness < 0.5).mean()),
        "offset_median": float(np.median(offset)),
        "offset_mean_abs": float(np.abs(offset).mean()),
        "share_inside": float((offset < 0).mean()),
        "components": int(welded.body_count),
        "watertight": bool(welded.is_watertight),
        "faces": len(built.faces),
    }


def count_cameras(mesh: TriangleMesh, samples: SurfaceSamples, cameras: list[Camera], radius: float) -> NDArray[np.int64]:
    """(sample,) how many cameras see each point of the mesh; pictures' borders are not looked at."""
    tracer = build_tracer(mesh)
    count = np.zeros(len(samples.points), np.int64)
    for camera in cameras:
        way = camera.center_world.double().numpy() - samples.points
        length = np.linalg.norm(way, axis=1, keepdims=True)
        facing = (way * samples.normals).sum(1) > FACING * length[:, 0]
        start = samples.points[facing] + LIFT * radius * samples.normals[facing]
        origins, directions = (torch.from_numpy(np.ascontiguousarray(values, np.float32)) for values in (start, (way / length)[facing]))
        count[facing] += ~trace_rays(origins, directions, tracer).hit.numpy()
    return count
