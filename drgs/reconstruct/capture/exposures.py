"""By how much each photograph was exposed more than the others, and how much redder or bluer its white balance made it: a camera that measures light anew for
each picture makes one surface bright here and dark there, which a fit would explain by light or paint.

Three sources, the first that knows wins: what the camera wrote into the files (exposure_gains.py); points of the object that several photographs show,
before anything is fitted; the surfels of stage 1, which know what depends on the view, afterwards. Gains are relative: their logarithms have
the mean 0. Where they differ by less than chance would make them, there are none, and nothing changes.

Where light turns with the camera, what one place shows changes with it, by a stop and more, and points cannot tell that from exposures: so those gains
serve the search for hollows, which takes light for still, and no fit.

White balances only the surfels tell, for points that mirror coloured things differ as much.

In: Views. Out: Views with `gains`, or `tints`, or the very same.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from torch import Tensor

from drgs.maths.color import linear_from_srgb, luminance
from drgs.reconstruct.capture.exposure_gains import gains_of_stops
from drgs.reconstruct.capture.initial_points import InitialPoints, project_points
from drgs.reconstruct.fit.view_targets import ViewTarget, view_targets
from drgs.scene.views import Views

VARIED_STOPS = 0.2
"""From which exposures must differ, of `jumps`: shine and shadow make up to 0.12 of it on public scenes."""
LEFT_STOPS = 0.1
"""The same after stage 1, which explains what depends on the view."""
LEFT_TINT_STOPS = 0.08
"""Of red or blue over green, after stage 1. Public scenes have at most 0.04 (the blue of gold), a wooden tankard's photographs 0.06."""
NEIGHBOURS = 4
SOLID = 0.9
"""Least coverage and mask of a pixel that is compared."""
DARKEST, BRIGHTEST = 0.02, 0.98
"""Display values that are compared: others are noise, or cut off."""
FEWEST_PIXELS = 30
"""Or points, of a picture that is compared."""
FEWEST_VIEWS = 3
"""Of a point that is compared."""
COMPARED_POINTS = 3000
FACING = 0.3
"""Least cosine between a point's normal and the direction to the camera."""
POLISHINGS = 8


def brightness_stops(views: Views, points: InitialPoints) -> Float[ndarray, "view"]:
    """By which what a view sees is brighter there than in the others [stops, mean 0], nan where it sees nothing.

    A point's brightness is its own plus its view's, both by medians in turn (Tukey 1977, median polish), which highlights do not move.
    """
    every = slice(None, None, 1 + len(points.points_world) // COMPARED_POINTS)
    places = points.points_world[every]
    stops = np.full((len(views.cameras), len(places)), np.nan)
    for row_of_view, camera, image, coverage in zip(stops, views.cameras, views.images_srgb, views.coverage, strict=True):
        column, row, seen, _ = project_points(camera, places.numpy())
        seen &= coverage.numpy()[row, column] > 200
        if points.normals_world is not None:
            towards = torch.nn.functional.normalize(camera.center_world - places, dim=1)
            seen &= ((towards * points.normals_world[every]).sum(1) > FACING).numpy()
        color = image[torch.from_numpy(row[seen]), torch.from_numpy(column[seen])].float() / 255
        within = ((color > DARKEST) & (color < BRIGHTEST)).all(1).numpy()
        row_of_view[np.flatnonzero(seen)[within]] = luminance(linear_from_srgb(color)).log2().numpy()[within]
    stops = stops[:, np.isfinite(stops).sum(0) >= FEWEST_VIEWS]
    of_view = np.where(np.isfinite(stops).sum(1) >= FEWEST_PIXELS, 0.0, np.nan)
    compared = np.isfinite(of_view)
    for _ in range(POLISHINGS if compared.any() else 0):
        left = stops[compared] - of_view[compared, None]
        left = left - np.nanmedian(left, 0)
        of_view[compared] += np.nanmedian(left, 1)
        of_view -= np.nanmean(of_view)
    return of_view


def with_gains_of_points(views: Views, points: InitialPoints) -> Views:
    """Gains by points that several photographs show, where those are too different for one exposure."""
    if views.gains is not None:
        return views
    stops = brightness_stops(views, points)
    return with_gains(views, stops) if jumps(stops, views) > VARIED_STOPS else views


def with_gains_of_fit(views: Views, drawn: Callable[[ViewTarget], tuple[Tensor, Tensor]], finds_gains: bool = True) -> Views:
    """Gains and tints by what a fit draws of the object, at half size; those that are known already are made better.

    Args:
        drawn: linear radiance (height, width, 3) that a view's camera sees by the fit, and coverage (height, width). finds_gains: False: where none are known
            none are looked for.
    """
    left = np.array([_stops_left(target, *drawn(target)) for target in view_targets(views, 0.5, torch.device("cpu"))])
    gains = np.ones(len(left)) if views.gains is None else np.array(views.gains)
    tints = np.ones((len(left), 3)) if views.tints is None else np.array(views.tints)
    if views.tints is not None or max(jumps(left[:, channel], views) for channel in (1, 2)) > LEFT_TINT_STOPS:
        red, blue = (gains_of_stops(np.log2(tints[:, channel]) + left[:, k]) for channel, k in ((0, 1), (2, 2)))
        views = replace(views, tints=tuple((r, 1.0, b) for r, b in zip(red, blue, strict=True)))
    if views.gains is None and not (finds_gains and jumps(left[:, 0], views) > LEFT_STOPS):
        return views
    return with_gains(views, np.log2(gains) + left[:, 0])


def _stops_left(target: ViewTarget, radiance: Tensor, coverage: Tensor) -> tuple[float, float, float]:
    """Medians by which the photograph is brighter than what was drawn, and by which its red and its blue are, more than its green; nan where too little
    can be compared."""
    radiance, coverage = radiance.cpu(), coverage.cpu()
    shown = luminance(radiance)
    photo = luminance(linear_from_srgb(target.saturation))
    compared = (target.mask > SOLID) & (coverage > SOLID) & (shown > linear_from_srgb(torch.tensor(DARKEST)))
    within = (target.saturation > DARKEST * target.ceiling) & (target.saturation < BRIGHTEST * target.ceiling)
    compared &= within.all(-1)
    if int(compared.sum()) < FEWEST_PIXELS:
        return float("nan"), float("nan"), float("nan")
    brighter = (photo[compared] / shown[compared]).log2().median()
    channels = (linear_from_srgb(target.saturation[compared]) / radiance[compared].clamp(min=1e-6)).log2()
    red, blue = ((channels[:, channel] - channels[:, 1]).median() for channel in (0, 2))
    return float(brighter), float(red), float(blue)


def jumps(stops: Sequence[float] | Float[ndarray, "view"], views: Views) -> float:
    """Standard deviation of the views from their neighbours: shine changes evenly from one direction to the next, exposures do not."""
    known = np.flatnonzero(np.isfinite(stops))
    if len(known) <= NEIGHBOURS:
        return 0.0
    axes = np.stack([views.cameras[index].camera_from_world[2, :3].double().numpy() for index in known])
    nearest = np.argsort(-(axes @ axes.T), axis=1)[:, 1 : NEIGHBOURS + 1]
    values = np.array(stops)[known]
    return float((values - values[nearest].mean(1)).std())


def with_gains(views: Views, stops: Sequence[float] | Float[ndarray, "view"]) -> Views:
    """The same with these exposures [stops, any common offset]; what is not known (nan) is taken for the mean."""
    return replace(views, gains=gains_of_stops(np.array(stops, np.float64)))
