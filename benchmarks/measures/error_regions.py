"""Where the squared error of test views lies: shares by region of the picture.

A pixel belongs to the first of these that it fits:

    hollow      the true surface lies more than two cells behind the visual hull: silhouettes say nothing of it
    outline     within three pixels of the true outline, on either side
    grazing     the true surface is seen at n.v below 0.3
    brightest   of the brightest 2 % of the object's pixels (true luminance, over all views)
    metal       true metallic above one half
    paint       the rest of the object
    rest        background

Brightest comes before metal and paint, which would leave it nothing.
"""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from benchmarks.scenes.bench_scene import Array, TrueMaps
from drgs.evaluate.metrics import on_white
from drgs.maths.color import linear_from_srgb, luminance
from drgs.reconstruct.capture.visual_hull import VisualHull
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.visible.trace_primary import trace_primary
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.mesh import TriangleMesh, vertex_normals

REGIONS = ("hollow", "outline", "grazing", "brightest", "metal", "paint", "rest")
HOLLOW_CELLS = 2.0
OUTLINE_PIXELS = 3.0
GRAZING_COSINE = 0.3
BRIGHTEST_SHARE = 0.02


@dataclass(frozen=True, eq=False)
class TestView:
    """One test picture with its truth."""

    __test__ = False  # pytest collects by name

    camera: Camera
    rendered: Array
    """(height, width, 4) straight alpha, sRGB."""
    true: Array
    maps: TrueMaps


def region_figures(views: list[TestView], hull: VisualHull) -> dict:
    """For each region the share of the squared error, the share of the pixels, and what the mean PSNR over all views' pixels would gain [dB]
    were it without error."""
    errors, regions = [], []
    brightest = brightest_luminance(views)
    for view, hull_depth in zip(views, hull_depths(hull, [view.camera for view in views]), strict=True):
        errors.append(np.square(on_white(view.rendered) - on_white(view.true)).sum(-1).ravel())
        regions.append(label_regions(view, hull_depth, hull.cell, brightest).ravel())
    error, region = np.concatenate(errors), np.concatenate(regions)
    total = max(float(error.sum()), 1e-12)
    figures = {}
    for index, name in enumerate(REGIONS):
        share = float(error[region == index].sum()) / total
        figures[name] = {
            "error_share": share,
            "pixel_share": float((region == index).mean()),
            "gain_db": float(-10 * np.log10(max(1 - share, 1e-12))),
        }
    return figures


def label_regions(view: TestView, hull_depth: Array, cell: float, brightest: float) -> NDArray[np.int64]:
    """(height, width) index into REGIONS.

    Args:
        hull_depth: (height, width) of the visual hull along the viewing axis; +inf where it is not seen.
        cell: of the hull [world units]. brightest: least luminance that counts as bright.
    """
    maps = view.maps
    inside = maps.alpha > 0.5
    _, directions = pixel_rays_world(view.camera)
    cosine = -(maps.normal_world * directions.double().numpy()).sum(-1)
    conditions = (
        inside & (maps.depth - hull_depth > HOLLOW_CELLS * cell),
        outline_distance(inside) < OUTLINE_PIXELS,
        inside & (cosine < GRAZING_COSINE),
        inside & (_luminance(view.true) >= brightest),
        inside & (maps.metallic > 0.5),
        inside,
    )
    return np.select(conditions, range(len(conditions)), default=len(conditions))


def outline_distance(inside: NDArray[np.bool_]) -> Array:
    """(height, width) of each pixel's centre from the mask's outline [pixels]; +inf where there is none."""
    if inside.all() or not inside.any():
        return np.full(inside.shape, np.inf)
    return np.where(inside, distance_transform_edt(inside), distance_transform_edt(~inside)) - 0.5


def brightest_luminance(views: list[TestView]) -> float:
    """The luminance that BRIGHTEST_SHARE of the object's pixels reach."""
    return float(np.quantile(np.concatenate([_luminance(view.true)[view.maps.alpha > 0.5] for view in views]), 1 - BRIGHTEST_SHARE))


def hull_depths(hull: VisualHull, cameras: list[Camera]) -> list[Array]:
    """(height, width) each, through pixel centres."""
    vertices = torch.from_numpy(np.ascontiguousarray(hull.vertices_world, np.float32))
    faces = torch.from_numpy(hull.faces.astype(np.int32))
    grey = torch.full((len(vertices),), 0.5)
    mesh = TriangleMesh(vertices, faces, vertex_normals(vertices, faces), grey[:, None].expand(-1, 3).contiguous(), grey, grey)
    tracer = build_tracer(mesh)
    return [trace_primary(mesh, camera, tracer=tracer).depth.double().numpy() for camera in cameras]


def _luminance(rgba: Array) -> Array:
    return luminance(linear_from_srgb(torch.from_numpy(rgba[..., :3]))).numpy()
