"""Why poses were not found, or not for enough pictures: one sentence with what was found, what was expected and what helps.

Every check returns quietly or raises ValueError, those of what was found in pictures NoPoses; `reasons_left_out` says it picture by picture.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from drgs.reconstruct.pose.list_photos import FEWEST_PHOTOS
from drgs.reconstruct.pose.prepare_photos import PreparedPhoto

FEWEST_FEATURES = 60
"""Of a picture: fewer give too few matches with any other."""
BLURRED_SHARE = 0.2
"""A picture is called blurred when its sharpness is below this share of the median."""
SAME_VIEW_MOVE = 0.005
"""Median way of a feature between two pictures, as a share of the longer side: less is no change of view."""
LEAST_BASELINE = 0.02
"""Spread of the cameras (standard deviation) over their distance from the points: less shows no depth."""
MOST_NAMED = 6
TAKE_BETTER = "Take more pictures with small steps between them (10 degrees), sharp, of something with texture, and let still surroundings with texture be seen."


class NoPoses(ValueError):
    """What the pictures show gives no poses, or too few."""


def blurred_photos(prepared: list[PreparedPhoto]) -> list[str]:
    """Names of the pictures that are much less sharp than the others."""
    median = float(np.median([photo.sharpness for photo in prepared])) if prepared else 0.0
    return [photo.name for photo in prepared if photo.sharpness < BLURRED_SHARE * median]


def check_readable(folder: Path, prepared: list[PreparedPhoto], left_out: dict[str, str]) -> None:
    """Enough pictures could be decoded, and all have a mask or none has."""
    if len(prepared) < FEWEST_PHOTOS:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in list(left_out.items())[:MOST_NAMED])
        raise ValueError(
            f"{folder}: {len(prepared)} of {len(prepared) + len(left_out)} pictures can be used, expected at least {FEWEST_PHOTOS} ({reasons})."
        )
    lacking = [photo.name for photo in prepared if not photo.has_mask]
    if lacking and len(lacking) < len(prepared):
        raise ValueError(
            f"{folder}: {len(lacking)} of {len(prepared)} pictures have neither transparency nor a mask ({few(lacking)}), but the others have; "
            "expected masks for all or none."
        )


def check_features(folder: Path, prepared: list[PreparedPhoto], features: dict[str, int], least_share: float) -> None:
    """Enough pictures have something to recognise."""
    poor = [photo for photo in prepared if features.get(photo.file, 0) < FEWEST_FEATURES]
    if len(prepared) - len(poor) >= least_share * len(prepared):
        return
    names = few([photo.name for photo in poor])
    found = f"{folder}: {len(poor)} of {len(prepared)} pictures have fewer than {FEWEST_FEATURES} features"
    if all(photo.has_mask for photo in prepared):
        raise NoPoses(
            f"{found} inside their masks ({names}), expected texture on the object: pose the pictures without masks, with the surroundings "
            "in view (not on a turntable), and add the masks afterwards."
        )
    raise NoPoses(
        f"{found} ({names}): blurred, or of something without texture; put textured things, such as a newspaper, around the object."
    )


def check_baseline(folder: Path, median_move: float | None) -> None:
    """The pictures differ in view."""
    if median_move is not None and median_move < SAME_VIEW_MOVE:
        raise NoPoses(
            f"{folder}: what the pictures show moves by {100 * median_move:.2f} % of their width from one to another, expected several: "
            "they are taken from one place; walk around the object."
        )


def check_depth(folder: Path, found_from_camera: Float64[ndarray, "camera 4 4"], points_found: Float64[ndarray, "point 3"]) -> None:
    """The cameras stand apart far enough for their distance from what they see."""
    centers = found_from_camera[:, :3, 3]
    spread = float(np.sqrt(((centers - centers.mean(0)) ** 2).sum(1).mean()))
    distance = float(np.linalg.norm(np.median(points_found, axis=0) - centers.mean(0)))
    if spread < LEAST_BASELINE * distance:
        raise NoPoses(
            f"{folder}: the cameras lie within {100 * spread / distance:.2g} % of their distance from what they see, expected more than "
            f"{100 * LEAST_BASELINE:.0f} %: they are taken from one place; walk around the object."
        )


def check_placed(folder: Path, placed: int, given: int, left_out: dict[str, str], blurred: list[str], least_share: float) -> None:
    """Enough of the pictures have a pose."""
    if placed >= max(least_share * given, FEWEST_PHOTOS):
        return
    by_reason: dict[str, list[str]] = {}
    for name, reason in left_out.items():
        by_reason.setdefault(reason.split(",")[0], []).append(name)
    why = "; ".join(f"{reason}: {few(names)}" for reason, names in sorted(by_reason.items(), key=lambda item: -len(item[1]))[:3])
    soft = f" {len(blurred)} are blurred ({few(blurred)})." if blurred else ""
    wanted = max(int(np.ceil(least_share * given)), FEWEST_PHOTOS)
    raise NoPoses(f"{folder}: {placed} of {given} pictures could be placed, expected at least {wanted} ({why}).{soft} {TAKE_BETTER}")


def reasons_left_out(
    prepared: list[PreparedPhoto], placed: set[str], features: dict[str, int], partners: dict[str, int], blurred: list[str]
) -> dict[str, str]:
    """Of each prepared picture without a pose: why, by name."""
    reasons = {}
    for photo in prepared:
        if photo.file in placed:
            continue
        count, others = features.get(photo.file, 0), partners.get(photo.file, 0)
        if count < FEWEST_FEATURES:
            reason = f"no features, {count} where {FEWEST_FEATURES} are needed"
        elif others == 0:
            reason = "no matches, no other picture shows the same"
        else:
            reason = f"not registered, {others} other pictures match it but its place does not follow from them"
        reasons[photo.name] = reason + (", and it is blurred" if photo.name in blurred else "")
    return reasons


def few(names: list[str]) -> str:
    """The first names of many."""
    more = f" and {len(names) - MOST_NAMED} more" if len(names) > MOST_NAMED else ""
    return ", ".join(names[:MOST_NAMED]) + more
