"""The door of builds and of the doctor: read a capture, and refuse what nothing but a half-built asset could come of.

What a single file can tell is refused by the readers (load_views/checks.py); here is what only cameras, masks and pictures together tell. Limits are angles
and shares, so that neither the unit of the world nor the size of pictures matters. In: a folder. Out: its cameras, pictures and first points.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from drgs.reconstruct.capture.build_box import BuildBox
from drgs.reconstruct.capture.initial_points import InitialPoints, initial_points
from drgs.reconstruct.capture.load_views import read_capture
from drgs.reconstruct.capture.load_views.capture import Capture, without_masks
from drgs.reconstruct.capture.load_views.checks import CaptureFault
from drgs.reconstruct.capture.load_views.read_pictures import read_pictures
from drgs.reconstruct.capture.look_nearer import look_nearer, object_windows
from drgs.reconstruct.capture.mask_agreement import mask_agreement
from drgs.reconstruct.capture.sharpen_masks import sharpen_masks
from drgs.reconstruct.capture.turn_up import UP, Direction, turn_up
from drgs.reconstruct.capture.visual_hull import HULL, VisualHullSettings, axes_meeting_point
from drgs.scene.views import Views

SAME_PLACE = 1e-6
"""Cameras nearer to each other than this share of their distance from the origin are rounding apart."""
MOST_AWAY = 1 / 3
"""Of cameras that look away from what all look at: in captures of an object it is none, with matrices the wrong way round half or all."""
LEAST_ANGLE = 3.0
"""[degrees] between the two cameras farthest apart, as seen from the object. An error of half a pixel, 0.05° through a usual lens, is then a
sixtieth of the distance in depth, which is about the size of an object."""
LEAST_AGREEMENT = 0.5
"""Median over the views of `mask_agreement`: below, more of what masks show is unexplained than explained. Seven good captures have 0.99 and more."""
INVERT = (
    "Matrices of transforms.json are camera-to-world in OpenGL's axes (x right, y up, looking along -z): invert those that are world-to-camera, and "
    "change the sign of the second and third column of OpenCV's."
)


def open_capture(
    folder: Path,
    max_side: int | None,
    point_count: int,
    seed: int,
    up: Direction = UP,
    box: BuildBox | None = None,
    masked: Callable[[Views], Views] | None = None,
    hull_settings: VisualHullSettings = HULL,
    sharpen: bool = True,
    nearer: bool = False,
) -> tuple[Capture, Views, InitialPoints]:
    """The capture, its pictures of at most `max_side` pixels a side, and points to begin with.

    Args:
        up: the direction of the capture's own world that is to point up: all is given in the world that is turned so.
        box: of that turned world. Masks of the capture's own are cut to what it holds (cut_to_box); without masks it bounds the points alone.
        masked: gives the views other masks than the capture's own, which are not read then, as strokes do.
        sharpen: masks are moved to where the photographs show the object to end.
        nearer: where masks tell the object, max_side is that of what is around it (look_nearer).

    Raises:
        ValueError: one sentence why there is nothing to build from; a CaptureFault where what to do about it is known, too.
    """
    capture = turn_up(read_capture(folder), up)
    _check_cameras(capture, folder)
    if masked is not None:
        capture = without_masks(capture)
    views = read_pictures(capture, max_side, sharpen)
    _check_pictures(views, folder)
    if masked is not None:
        views = masked(views)
        views = sharpen_masks(views) if sharpen else views
    if box is not None and views.has_masks:
        views = _cut(views, box, folder)
    windows = object_windows(capture, views, max_side) if nearer and max_side is not None and views.has_masks else None
    if windows is not None:
        views = look_nearer(capture, views, windows, masked is None, sharpen)
        views = views if box is None else _cut(views, box, folder)
    points = initial_points(views, point_count, seed, box=box, hull_settings=hull_settings)
    _check_points(views, points, folder)
    return capture, views, points


def _cut(views: Views, box: BuildBox, folder: Path) -> Views:
    from drgs.reconstruct.capture.cut_to_box import cut_to_box  # here, with the tracer that it needs: most captures are not cut

    try:
        return cut_to_box(views, box)
    except CaptureFault as fault:
        raise CaptureFault(f"{folder}: {fault}", fault.advice) from fault


def camera_angles(views: Views, point: Float[ndarray, "3"]) -> Float[ndarray, "view view"]:
    """[degrees] between each two cameras as seen from a point."""
    centers = torch.stack([camera.center_world for camera in views.cameras]).double().numpy()
    towards = centers - point
    towards /= np.maximum(np.linalg.norm(towards, axis=1, keepdims=True), np.finfo(np.float64).tiny)
    return np.degrees(np.arccos(np.clip(towards @ towards.T, -1, 1)))


def _check_cameras(capture: Capture, folder: Path) -> None:
    poses = np.stack([photograph.camera_from_world for photograph in capture.photographs])
    centers, axes = -np.einsum("vji,vj->vi", poses[:, :3, :3], poses[:, :3, 3]), poses[:, 2, :3]
    count = len(poses)
    if np.ptp(centers, axis=0).max() <= SAME_PLACE * np.abs(centers).max():
        raise CaptureFault(
            f"{folder}: all {count} cameras stand at one place, expected them around the object.",
            f"Check that the camera file has a pose of its own for each picture. {INVERT}",
        )
    distance = np.einsum("vi,vi->v", axes_meeting_point(centers, axes) - centers, axes)
    away = int((distance <= 0).sum())
    if away > MOST_AWAY * count:
        raise CaptureFault(
            f"{folder}: {away} of {count} cameras look away from where their viewing directions meet, expected all to look at the object.",
            INVERT,
        )


def _check_pictures(views: Views, folder: Path) -> None:
    count = len(views.cameras)
    if not any(bool((mask > 127).any()) for mask in views.coverage):
        raise CaptureFault(
            f"{folder}: the masks of all {count} pictures are empty, expected white (or opaque) where the object is.",
            "Invert them, or take masks/ away: then the build looks for the object itself.",
        )
    first = views.images_srgb[0]
    if not views.has_masks and all(torch.equal(first, image) for image in views.images_srgb):
        raise CaptureFault(
            f"{folder}: all {count} pictures are the same, expected one of its own from each camera.",
            "Check what was copied: the object must be seen from all around.",
        )


def _check_points(views: Views, points: InitialPoints, folder: Path) -> None:
    widest = float(camera_angles(views, points.bounds_center.double().numpy()).max())
    if widest < LEAST_ANGLE:
        raise CaptureFault(
            f"{folder}: all pictures are taken from within {widest:.1f} degrees as seen from the object, expected them from all around it.",
            "Walk around the object: pictures from one place show no shape.",
        )
    if points.hull_vertices is None:
        return
    agreement = float(np.median(mask_agreement(views, points.hull_vertices)))
    if agreement < LEAST_AGREEMENT:
        raise CaptureFault(
            f"{folder}: what all masks together allow fills {100 * agreement:.0f} % of the middle one of them, expected more than "
            f"{100 * LEAST_AGREEMENT:.0f} %.",
            "The object moved between pictures, or poses, pictures and masks do not belong together: look at them with drgs doctor --sheet.",
        )
