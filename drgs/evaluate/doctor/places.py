"""The doctor on what pictures show of the same places of the object: a picture of another scene, or under another's pose, shows something else there.

Compared are ranks of brightness over the places that a picture sees with what the others show of these (Spearman 1904, docs/sources.md: spearman1904), so that
exposures do not count. Only with masks, for without the hull nothing is known of places.
"""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from drgs.evaluate.doctor.findings import Finding, Section, few
from drgs.maths.color import linear_from_srgb, luminance
from drgs.reconstruct.capture.initial_points import InitialPoints, project_points
from drgs.scene.views import Views

COMPARED_POINTS = 3000
FACING = 0.3
"""Least cosine between a point's normal and the direction to the camera."""
FEWEST_PLACES = 100
"""That a picture must share with at least FEWEST_OTHERS others."""
FEWEST_OTHERS = 3
CLEAR = 0.6
"""Median correlation from which places look so much alike from everywhere that a picture can stand out."""
FOREIGN = 0.1
"""Correlation below which a picture shows something else there."""
UNCLEAR = 0.25
"""Median correlation below which the object shows its surroundings more than itself."""


def places(views: Views, points: InitialPoints, known: Sequence[str]) -> Section:
    """Whether pictures agree on places; `known`: pictures that something was said of already."""
    if points.normals_world is None or not views.has_masks:
        return {"agreement": None, "foreign": []}, []
    agreement = _agreement(views, points)
    compared = agreement[np.isfinite(agreement)]
    if len(compared) == 0:
        return {"agreement": None, "foreign": []}, []
    median = float(np.median(compared))
    foreign = [
        camera.name
        for camera, value in zip(views.cameras, agreement, strict=True)
        if median > CLEAR and value < FOREIGN and camera.name not in known
    ]
    findings = []
    if foreign:
        findings.append(
            Finding(
                "warning",
                f"{len(foreign)} of {len(views.cameras)} pictures ({few(foreign)}) show something else than the others where their poses say the object is.",
                "Leave them out: they are of another scene, or have the poses of other pictures.",
                tuple(foreign),
                "shows something else",
            )
        )
    if median < UNCLEAR:
        findings.append(
            Finding(
                "info",
                f"Pictures hardly agree on how bright the same places are (rank correlation {median:.2f}): the object mirrors its surroundings, or the poses are off.",
                "Mirrors need surroundings that stand still and are seen from all around the object; check poses by the outlines of drgs doctor --sheet.",
            )
        )
    return {"agreement": round(median, 3), "foreign": foreign}, findings


def _agreement(views: Views, points: InitialPoints) -> Float[ndarray, "view"]:
    """Rank correlation of each picture's places with the median of the others'; nan where too few are shared."""
    assert points.normals_world is not None
    every = slice(None, None, 1 + len(points.points_world) // COMPARED_POINTS)
    positions, normals = points.points_world[every], points.normals_world[every]
    bright = np.full((len(views.cameras), len(positions)), np.nan, np.float32)
    for shown, camera, image, coverage in zip(bright, views.cameras, views.images_srgb, views.coverage, strict=True):
        column, row, seen, _ = project_points(camera, positions.numpy())
        towards = torch.nn.functional.normalize(camera.center_world - positions, dim=1)
        seen &= (coverage.numpy()[row, column] > 200) & ((towards * normals).sum(1) > FACING).numpy()
        color = image[torch.from_numpy(row[seen]), torch.from_numpy(column[seen])].float() / 255
        shown[seen] = luminance(linear_from_srgb(color)).numpy()
    shared = np.isfinite(bright).sum(0) > FEWEST_OTHERS
    bright = bright[:, shared]
    agreement = np.full(len(bright), np.nan)
    for number, own in enumerate(bright):
        seen = np.isfinite(own)
        if seen.sum() >= FEWEST_PLACES:
            others = np.nanmedian(np.delete(bright[:, seen], number, 0), 0)
            agreement[number] = _rank_correlation(own[seen], others)
    return agreement


def _rank_correlation(a: Float[ndarray, "n"], b: Float[ndarray, "n"]) -> float:
    ranks = np.stack([_ranks(a), _ranks(b)])
    ranks -= ranks.mean(1, keepdims=True)
    norms = np.linalg.norm(ranks, axis=1)
    return float(ranks[0] @ ranks[1] / (norms[0] * norms[1])) if norms.all() else float("nan")


def _ranks(values: Float[ndarray, "n"]) -> Float[ndarray, "n"]:
    """1 for the smallest; equal values share the mean of theirs. Not scipy.stats.rankdata: loading scipy.stats takes a quarter of a second of each look at a capture."""
    _, place, counts = np.unique(values, return_inverse=True, return_counts=True)
    return (np.cumsum(counts) - (counts - 1) / 2)[place]
