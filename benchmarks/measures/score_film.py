"""What a build made of a film alone (draw_film), held against the truth beside the film.

In: an asset and the film's folder. Out, as plain numbers:

    poses     pictures that were given and placed; how far the placed cameras are from the true ones after the best similarity of their centres:
              angles [degrees], distances of centres [percent of the true camera's distance from the middle of the object's box]
    masks     silhouettes of the built mesh from the asset's cameras against the true masks: intersection over union, true pixels that are
              missed and false ones that are too many [percent of the true ones], means over the scored pictures
    mesh      mean distances [percent of the true mesh's radius] of the built surface from the true one and of the true from the built one, moved by
              the similarity of the cameras, and once more after STEPS steps of ICP (a similarity too): the first has errors of the cameras in it,
              the second is the shape's alone
    views     PSNR [dB] of the asset's own pictures at its cameras against the film's frames before it was compressed, no factor, over the pixels
              that the object fills; a missed one is white

Every sixth of the asset's cameras is scored. The build undistorts its pictures by a lens that it found, so truth is looked up through that lens.
True points count that two scored cameras see, that face down by at most 60 degrees and are higher above the table than 2 % of the radius;
built points count that are not that near to the table, and whose nearest true point is none of an underside.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree

from benchmarks.measures.mesh_accuracy import DENSE, SurfaceSamples, count_cameras, mesh_radius, sample_surface
from benchmarks.measures.outline_distance import mesh_coverages
from benchmarks.scenes.bench_scene import read_rgba
from benchmarks.scenes.draw_film import read_film_cameras
from drgs.deform.pose_scene import pose_scene
from drgs.evaluate.metrics import on_white, psnr
from drgs.maths.constants import STILL_BOUNCES
from drgs.render.records import RenderSettings
from drgs.render.render_cameras import render_cameras
from drgs.scene.asset import Asset, light_from_world, load_asset
from drgs.scene.camera import Camera
from drgs.scene.lens import Lens, pixels_from_plane
from drgs.scene.mesh import TriangleMesh

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
EVERY = 6
"""Of the asset's cameras, one in so many is scored."""
SAMPLES = 50_000
"""Points on each surface."""
STEPS = 10
"""Of ICP."""
NEAR_TABLE = 0.02
"""[share of the radius]"""
DOWNWARDS = np.sin(np.radians(60))
"""Below minus this, a normal's upward part is that of an underside."""
PLACES = 3
"""A pixel is the mean of so many times as many places of the film's frame."""
FILLED = 0.999
"""Coverage of a pixel that the object fills."""
SHOWN = 4
"""Frames of the picture to look at."""


@dataclass(frozen=True, eq=False)
class Similarity:
    """From one world to another: scale * rotation @ point + translation."""

    scale: float
    rotation: Array
    translation: Array

    def points(self, points: Array) -> Array:
        """(point, 3), moved."""
        return self.scale * points @ self.rotation.T + self.translation


@dataclass(frozen=True, eq=False)
class ScoredView:
    """One of the asset's cameras, and what is true there, all of the camera's size."""

    camera: Camera
    frame: Array
    """(height, width, 3), sRGB in 0..1."""
    coverage: Array
    """(height, width), of the true object."""
    silhouette: Mask
    """(height, width), of the built mesh."""
    render: Array
    """(height, width, 3), on white, sRGB in 0..1."""


def score_film(asset_path: Path, film: Path, mesh: TriangleMesh, renders: Path, samples_per_pixel: int, picture: Path) -> dict:
    """The figures above, and a picture to look at.

    Args:
        mesh: the true one.
        renders: a folder for the asset's own pictures.
    """
    asset = load_asset(asset_path)
    poses = asset.provenance["poses"]
    cameras = read_film_cameras(film)
    true = [cameras[frame_number(camera)] for camera in asset.cameras]
    middle = ((mesh.vertices.amin(0) + mesh.vertices.amax(0)) / 2).double().numpy()
    similarity, off = camera_figures(list(asset.cameras), true, middle)
    views = scored_views(asset, film, renders, samples_per_pixel)
    draw_outlines(views, picture)
    return {
        "poses": {"frames": len(cameras), "given": poses["given"], "placed": poses["placed"], "pixels_off": poses["pixels_off"]} | off,
        "masks": mask_figures([(view.silhouette, view.coverage > 0.5) for view in views]),
        "mesh": surface_figures(mesh, asset.mesh, similarity, true[::EVERY]),
        "views": {"pictures": len(views), "psnr": float(np.mean([_filled_psnr(view) for view in views]))},
    }


def frame_number(camera: Camera) -> int:
    """In the film, from the name that builds give to a frame's camera."""
    return int(re.sub(r"\D", "", camera.name))


def fit_similarity(source: Array, target: Array) -> Similarity:
    """The one, never a mirror, that brings (point, 3) `source` nearest to `target` in the sense of least squares."""
    middle, aim = source.mean(0), target.mean(0)
    u, sizes, vt = np.linalg.svd((target - aim).T @ (source - middle))
    signs = np.array([1, 1, np.sign(np.linalg.det(u @ vt))])
    rotation = u * signs @ vt
    scale = float((sizes * signs).sum() / np.square(source - middle).sum())
    return Similarity(scale, rotation, aim - scale * rotation @ middle)


def camera_figures(found: Sequence[Camera], true: Sequence[Camera], middle: Array) -> tuple[Similarity, dict]:
    """The best similarity from the found world to the true one, and medians of what remains.

    Args:
        middle: of the true object.
    """
    centers, true_centers = (np.array([camera.center_world.double().numpy() for camera in cameras]) for cameras in (found, true))
    similarity = fit_similarity(centers, true_centers)
    turns, true_turns = (np.array([camera.camera_from_world[:3, :3].double().numpy() for camera in cameras]) for cameras in (found, true))
    remaining = true_turns @ (similarity.rotation @ turns.transpose(0, 2, 1)) - np.eye(3)
    # A rotation by an angle a is 2 sqrt(2) sin(a / 2) away from none: exact for small ones, where the trace is not.
    degrees = np.degrees(2 * np.arcsin(np.clip(np.linalg.norm(remaining, axis=(1, 2)) / np.sqrt(8), 0, 1)))
    percent = 100 * np.linalg.norm(similarity.points(centers) - true_centers, axis=1) / np.linalg.norm(true_centers - middle, axis=1)
    return similarity, {"degrees_median": float(np.median(degrees)), "distance_percent_median": float(np.median(percent))}


def mask_figures(pairs: list[tuple[Mask, Mask]]) -> dict:
    """Of (found, true) silhouettes."""
    iou = [float((found & true).sum() / (found | true).sum()) for found, true in pairs]
    missed = [float((true & ~found).sum() / true.sum()) for found, true in pairs]
    extra = [float((found & ~true).sum() / true.sum()) for found, true in pairs]
    return {
        "iou": float(np.mean(iou)), "iou_least": min(iou),
        "missed_percent": 100 * float(np.mean(missed)), "extra_percent": 100 * float(np.mean(extra)),
    }  # fmt: skip


def surface_figures(true: TriangleMesh, built: TriangleMesh, similarity: Similarity, cameras: list[Camera], count: int = SAMPLES) -> dict:
    """Distances both ways, by the cameras' similarity and refined.

    Args:
        cameras: true ones; what two of them see counts.
    """
    radius, table = mesh_radius(true), float(true.vertices[:, 2].min())
    near = NEAR_TABLE * radius
    truth, dense_truth = sample_surface(true, count, 1), sample_surface(true, DENSE * count, 3)
    seen = (count_cameras(true, truth, cameras, radius) >= 2) & ~_hidden(truth, table + near)
    points, undersides = truth.points[seen], dense_truth.normals[:, 2] < -DOWNWARDS
    nearest_true = cKDTree(dense_truth.points)
    found, dense_found = sample_surface(built, count, 2).points, sample_surface(built, DENSE * count, 4).points

    def distances(moved: Similarity) -> dict:
        at = moved.points(found)
        accuracy, nearest = nearest_true.query(at)
        counted = ~undersides[nearest] & (np.abs(at[:, 2] - table) > near)
        completeness = cKDTree(moved.points(dense_found)).query(points)[0]
        return {"built_to_true": 100 * float(accuracy[counted].mean()) / radius, "true_to_built": 100 * float(completeness.mean()) / radius}

    refined = similarity
    for _ in range(STEPS):
        refined = fit_similarity(dense_found[cKDTree(refined.points(dense_found)).query(points)[1]], points)
    return {"by_cameras": distances(similarity), "refined": distances(refined), "refined_scale": refined.scale / similarity.scale}


def _hidden(samples: SurfaceSamples, height: float) -> Mask:
    """(sample,) undersides, and what is not above the height."""
    return (samples.normals[:, 2] < -DOWNWARDS) | (samples.points[:, 2] < height)


def scored_views(asset: Asset, film: Path, renders: Path, samples_per_pixel: int) -> list[ScoredView]:
    """Every sixth camera with what it should see; pictures that are there are not rendered again."""
    cameras, lens = asset.cameras[::EVERY], found_lens(asset)
    missing = [camera for camera in cameras if not (renders / f"{camera.name}.png").is_file()]
    settings = RenderSettings(samples_per_pixel=samples_per_pixel, bounces=STILL_BOUNCES)
    render_cameras(pose_scene(asset, []), missing, renders, settings, light_from_world=light_from_world(asset, []))
    views = []
    for camera, silhouette in zip(cameras, mesh_coverages(asset.mesh, cameras), strict=True):
        name = f"{frame_number(camera):05d}.png"
        frame, mask = (read_rgba(film / "truth" / kind / name)[..., :3] for kind in ("frames", "masks"))
        views.append(
            ScoredView(
                camera,
                seen_by(camera, lens, frame),
                seen_by(camera, lens, mask)[..., 0],
                silhouette > 0.5,
                on_white(read_rgba(renders / f"{camera.name}.png")),
            )
        )
    return views


def found_lens(asset: Asset) -> Lens:
    """That the build undistorted the film's pictures by."""
    calibrated = asset.provenance["poses"]["cameras"][0]
    return Lens(calibrated["model"], tuple(calibrated["parameters"]), calibrated["width"], calibrated["height"])


def seen_by(camera: Camera, lens: Lens, picture: Array) -> Array:
    """The film's picture (rows, columns, channel) as the undistorted camera shows it, (height, width, channel); beyond its border as at it."""
    matrix = camera.intrinsics.double().numpy()
    x, y = ((np.arange(PLACES * size) + 0.5) / PLACES for size in (camera.width, camera.height))
    plane = np.stack(np.meshgrid((x - matrix[0, 2]) / matrix[0, 0], (y - matrix[1, 2]) / matrix[1, 1]), -1)
    rows, columns = picture.shape[:2]
    places = pixels_from_plane(lens, plane) * [columns / lens.width, rows / lens.height] - 0.5
    shown = [map_coordinates(channel, [places[..., 1], places[..., 0]], order=1, mode="nearest") for channel in np.moveaxis(picture, -1, 0)]
    return np.stack(shown, -1).reshape(camera.height, PLACES, camera.width, PLACES, -1).mean((1, 3))


def _filled_psnr(view: ScoredView) -> float:
    filled = view.coverage > FILLED
    return psnr(view.render[filled], view.frame[filled])


def draw_outlines(views: list[ScoredView], path: Path) -> None:
    """A picture: frames, under each what the silhouette misses (cyan) and has too much (magenta), and under that the asset's own picture."""
    columns = []
    for view in [views[k] for k in np.linspace(0, len(views) - 1, min(SHOWN, len(views))).round().astype(int)]:
        true = view.coverage > 0.5
        errors = 0.5 * view.frame
        errors[true & ~view.silhouette] = (0, 1, 1)
        errors[view.silhouette & ~true] = (1, 0, 1)
        columns.append(np.concatenate([view.frame, errors, view.render]))
    rows = max(len(column) for column in columns)  # windows around the object differ
    filled = [np.pad(column, ((0, rows - len(column)), (0, 0), (0, 0)), constant_values=1.0) for column in columns]
    Image.fromarray((255 * np.concatenate(filled, 1) + 0.5).astype(np.uint8)).save(path)
