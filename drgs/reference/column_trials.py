"""Slow NumPy twin of drgs/reconstruct/capture/column_trials.py, ray by ray in float64; the specification of the kernel."""

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from drgs.reconstruct.capture.column_trials import ColumnTrials


def ends(rays: ColumnTrials, heights: Float[ndarray, "u v"]) -> Float[ndarray, "ray"]:
    """As ColumnTrials.ends, by steps of half a column."""
    origin, direction = (part.cpu().double().numpy() for part in (rays.origin, rays.direction))
    enters, leaves, found = (part.cpu().double().numpy().copy() for part in (rays.enters, rays.leaves, rays.returns))
    for ray in range(len(found)):
        along = np.arange(enters[ray], leaves[ray], 0.5 * rays.width)
        place = origin[ray] + along[:, None] * direction[ray]
        column = np.floor(place[:, :2] / rays.width).astype(int)
        outside = ((column < 0) | (column >= heights.shape)).any(1)
        met = outside | (place[:, 2] <= heights[tuple(np.where(outside[:, None], 0, column).T)])
        if met.any():
            found[ray] = along[met.argmax()]
    return found


def left(rays: ColumnTrials, heights: Float[ndarray, "u v"]) -> float:
    """As ColumnTrials.left, of one trial."""
    distance, colors, view = ends(rays, heights), rays.colors.cpu().double().numpy(), rays.view.cpu().numpy()
    places = rays.origin.cpu().double().numpy() + distance[:, None] * rays.direction.cpu().double().numpy()
    cells = [tuple(cell) for cell in np.floor(places / rays.cell).astype(int)]
    differences = []
    for ray, cell in enumerate(cells):
        if distance[ray] < 0:
            differences.append(rays.most)
            continue
        others = [k for k, there in enumerate(cells) if there == cell and view[k] != view[ray] and distance[k] >= 0]
        if others:
            differences.append(min(float(np.abs(colors[ray] - colors[others].mean(0)).mean()), rays.most))
    return float(np.mean(differences)) if differences else rays.most
