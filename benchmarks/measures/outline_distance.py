"""How far an outline lies from the true one, in pixels, from the two coverages.

The area between two outlines over the length of the true one is their mean distance: signed (outside counts above 0) from the difference of the
areas, where in and out may cancel, and absolute from the area that only one of them covers. Coverages are antialiased, so both are exact
well below a pixel; the length is that of the true coverage's level set at one half.
"""

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import maximum_filter, minimum_filter
from skimage.measure import find_contours

from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.visible.rasterize import rasterize_gbuffer
from drgs.render.visible.trace_primary import trace_primary_points
from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedSurfels

Array = NDArray[np.float64]
RAYS_A_PIXEL = 16


def outline_figures(pairs: list[tuple[Array, Array]]) -> dict:
    """Mean distances [pixels] over (found, true) coverages (height, width) in 0..1 of all views.

    Raises:
        ValueError: no true coverage has an outline.
    """
    length = sum(outline_length(true) for _, true in pairs)
    if length == 0:
        raise ValueError("the true masks have no outline; expected masks that the object does not fill")
    differences = [found - true for found, true in pairs]
    return {
        "signed_pixels": float(sum(difference.sum() for difference in differences) / length),
        "absolute_pixels": float(sum(np.abs(difference).sum() for difference in differences) / length),
    }


def outline_length(coverage: Array) -> float:
    """Of the level set at one half [pixels]; a border of the picture that cuts the object is no outline."""
    contours = find_contours(coverage, 0.5)
    return float(sum(np.linalg.norm(np.diff(contour, axis=0), axis=1).sum() for contour in contours))


def mesh_coverages(mesh: TriangleMesh, cameras: tuple[Camera, ...]) -> list[Array]:
    tracer = build_tracer(mesh)
    return [_mesh_coverage(tracer, camera) for camera in cameras]


def _mesh_coverage(tracer: AbstractTracer, camera: Camera) -> Array:
    """(height, width) share of the rays through each pixel that meet the mesh: one ray tells the pixels that hold no edge."""
    middle = trace_primary_points(tracer, camera, seed=0, pass_index=0, jitter=False).points.pixel.long()
    coverage = np.zeros(camera.height * camera.width)
    coverage[middle.numpy()] = 1.0
    picture = coverage.reshape(camera.height, camera.width)
    edges = np.flatnonzero(maximum_filter(picture, 3) > minimum_filter(picture, 3))
    pixels = torch.from_numpy(edges.astype(np.int32)).repeat(RAYS_A_PIXEL)
    rounds = torch.arange(RAYS_A_PIXEL, dtype=torch.int32).repeat_interleave(len(edges))
    hits = trace_primary_points(tracer, camera, seed=0, pass_index=0, pixels=pixels, rounds=rounds).points.pixel.long()
    coverage[edges] = torch.bincount(hits, minlength=len(coverage)).numpy()[edges] / RAYS_A_PIXEL
    return picture


def surfel_coverages(surfels: PosedSurfels, cameras: tuple[Camera, ...]) -> list[Array]:
    return [rasterize_gbuffer(surfels, camera).coverage.double().numpy() for camera in cameras]
