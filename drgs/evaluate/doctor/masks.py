"""The doctor on masks: whether there are any, whether they agree with each other, and what they say the object is."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from drgs.evaluate.doctor.findings import Finding, Section, few
from drgs.reconstruct.capture.initial_points import InitialPoints
from drgs.reconstruct.capture.load_views.capture import Capture
from drgs.reconstruct.capture.mask_agreement import mask_agreement
from drgs.scene.views import Views

SMALL_COVERAGE, LARGE_COVERAGE = 0.03, 0.8
FULL_COVERAGE = 0.999
POOR_AGREEMENT = 0.9
"""Of a mask with what all masks together say (capture/mask_agreement.py). Single masks of seven good captures have 0.925 and more; where an object moved by a
fifth of its radius between pictures, all have less."""
MANY_DISAGREE = 1 / 3
"""Of all views: more than the few that single mistakes make, so something is wrong with the capture as a whole."""
LARGE_PART = 0.1
"""Volume of a thing apart, over the largest's, from which it is called one: phantoms of hulls from few pictures are smaller."""


def masks(capture: Capture, views: Views, points: InitialPoints, mistaken: Sequence[str]) -> Section:
    """Coverage and agreement; `mistaken`: pictures whose cameras are wrong, of which that is said already."""
    names = [camera.name for camera in views.cameras]
    if not views.has_masks:
        return {"present": False, "mean_coverage": None, "touching_border": [], "empty": [], "disagreeing": []}, [_no_masks(capture)]
    inside = [coverage > 127 for coverage in views.coverage]
    share = torch.stack([mask.float().mean() for mask in inside])
    full = [name for name, value in zip(names, share.tolist(), strict=True) if value > FULL_COVERAGE]
    touching = [
        name
        for name, mask in zip(names, inside, strict=True)
        if name not in full and bool(torch.cat([mask[0], mask[-1], mask[:, 0], mask[:, -1]]).any())
    ]
    empty = [name for name, value in zip(names, share.tolist(), strict=True) if value == 0]
    agreement = np.ones(len(names)) if points.hull_vertices is None else mask_agreement(views, points.hull_vertices)
    known = {*empty, *full, *mistaken}
    disagreeing = [name for name, value in zip(names, agreement, strict=True) if value < POOR_AGREEMENT and name not in known]
    findings = _single_masks(touching, [name for name in empty if name not in mistaken], full, len(names))
    findings += _disagreement(disagreeing, len(names))
    mean = float(share.mean())
    findings += _of_all_masks(mean, views.masks_moved)
    parts = _parts_apart(points)
    if len(parts) > 1:
        findings.append(
            Finding(
                "info",
                f"The masks show {len(parts)} things that stand apart (of volumes {' : '.join(f'{100 * part:.0f}' for part in parts)}).",
                "They become one asset; to have one of them alone, take the others out of the masks.",
            )
        )
    summary = {
        "present": True,
        "mean_coverage": round(mean, 4),
        "touching_border": touching,
        "empty": empty,
        "agreement": round(float(np.median(agreement)), 4),
        "disagreeing": disagreeing,
        "things_apart": len(parts),
        "moved_pixels": round(views.masks_moved, 2),
    }
    return summary, findings


def first_points(views: Views, points: InitialPoints) -> Section:
    """Where a fit will begin."""
    sparse = 0 if views.points_world is None else len(views.points_world)
    summary = {"origin": points.origin, "count": len(points.points_world), "sparse_points_of_capture": sparse}
    findings = []
    if points.origin == "random":
        findings.append(
            Finding(
                "warning",
                "There are neither masks nor sparse points: the build looks for the object from random points.",
                "Add masks, or run COLMAP and pass its folder.",
            )
        )
    if sparse and points.origin == "hull":
        findings.append(
            Finding(
                "warning",
                f"Of {sparse} sparse points hardly any lies on the object.",
                "Check that points, poses and masks belong together.",
            )
        )
    return summary, findings


def _no_masks(capture: Capture) -> Finding:
    count = sum(photograph.mask is not None for photograph in capture.photographs)
    if count:
        return Finding(
            "warning",
            f"The masks of all {count} pictures are white all over: the build takes them for none, and looks for the object itself.",
            "Masks are white where the object is and black elsewhere: draw or export them anew.",
        )
    return Finding(
        "warning",
        "There are no masks: the build looks for the object itself, and what stands close to it becomes part of it.",
        "Save pictures with an alpha channel, or put masks of the same names (white object, black background) in masks/.",
    )


def _of_all_masks(share: float, moved: float) -> list[Finding]:
    """What is said of their mean `share` of the pictures, and of how far they were `moved` [pixels]."""
    findings = []
    if share < SMALL_COVERAGE:
        findings.append(
            Finding("warning", f"The object fills {100 * share:.1f} % of the picture.", "Go nearer, or crop (and shift cx, cy).")
        )
    if share > LARGE_COVERAGE:
        findings.append(
            Finding(
                "warning",
                f"The masks cover {100 * share:.0f} % of the picture.",
                "Check that white means object; inverted masks look like this.",
            )
        )
    if moved:
        findings.append(
            Finding(
                "info",
                f"Masks end {moved:.1f} pixels from where the photographs show the object to end (root mean square).",
                "A build moves them there; drgs build --masks given leaves them.",
            )
        )
    return findings


def _single_masks(touching: list[str], empty: list[str], full: list[str], count: int) -> list[Finding]:
    findings = []
    if touching:
        findings.append(
            Finding(
                "warning",
                f"The object touches the picture's border in {len(touching)} of {count} views ({few(touching)}).",
                "Step back, or leave such pictures out: what is cut off cannot be told from background.",
                tuple(touching),
                "at the border",
            )
        )
    if empty:
        findings.append(
            Finding(
                "warning",
                f"The mask is empty in {len(empty)} views ({few(empty)}).",
                "Leave these pictures out.",
                tuple(empty),
                "empty mask",
            )
        )
    if full:
        findings.append(
            Finding(
                "warning",
                f"The mask fills the whole picture in {len(full)} of {count} views ({few(full)}).",
                "Draw these masks anew, or leave the pictures out: they say that nothing is background.",
                tuple(full),
                "full mask",
            )
        )
    return findings


def _disagreement(disagreeing: list[str], count: int) -> list[Finding]:
    if not disagreeing:
        return []
    names, mark = tuple(disagreeing), "mask differs"
    if len(disagreeing) > MANY_DISAGREE * count:
        sentence = f"In {len(disagreeing)} of {count} views ({few(disagreeing)}) the mask holds what the others exclude: the object moved between pictures, or poses and pictures are mixed up."
        return [
            Finding("warning", sentence, "Take the pictures again with object and surroundings at rest, or mend the poses.", names, mark)
        ]
    return [
        Finding(
            "warning",
            f"In {len(disagreeing)} of {count} views ({few(disagreeing)}) the mask differs from what the other masks imply.",
            "Look at these pictures: mask or pose is wrong, the object moved, or they are of something else.",
            names,
            mark,
        )
    ]


def _parts_apart(points: InitialPoints) -> list[float]:
    """Volumes of the hull's parts over the largest's, the largest first, without small ones and hollows."""
    if points.hull_vertices is None or points.hull_faces is None:
        return [1.0]
    vertices, faces = points.hull_vertices.double().numpy(), points.hull_faces.numpy()
    count = len(vertices)
    edges = coo_array((np.ones(2 * len(faces), bool), (faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel())), shape=(count, count))
    _, part_of_vertex = connected_components(edges, directed=False)
    volumes = np.bincount(part_of_vertex[faces[:, 0]], _signed_volumes(vertices, faces))
    shares = volumes / max(float(volumes.max()), np.finfo(np.float64).tiny)
    return sorted((float(share) for share in shares if share > LARGE_PART), reverse=True)


def _signed_volumes(vertices: Float[ndarray, "vertex 3"], faces: ndarray) -> Float[ndarray, "face"]:
    """Of the tetrahedra between faces and the middle."""
    a, b, c = (vertices[faces[:, corner]] - vertices.mean(0) for corner in range(3))
    return np.einsum("fi,fi->f", a, np.cross(b, c)) / 6
