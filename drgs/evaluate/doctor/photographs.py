"""The doctor on plain photographs, or a film, which have no cameras yet: what can be said before poses are looked for.

Pictures are left out, and the search is refused, for what `drgs pose` does so for (pose/prepare_photos.py, pose/explain_failure.py).
"""

import hashlib
from collections import Counter
from pathlib import Path
from typing import Any

from drgs.evaluate.doctor.findings import Finding, few
from drgs.evaluate.doctor.picture_looks import PictureLook, picture_looks
from drgs.evaluate.doctor.pictures import FEW_VIEWS, looks
from drgs.reconstruct.capture.camera_files import is_header_readable
from drgs.reconstruct.capture.load_views.checks import image_size
from drgs.reconstruct.capture.small_picture import PictureFile
from drgs.reconstruct.pose.explain_failure import FEWEST_FEATURES
from drgs.reconstruct.pose.list_photos import FEWEST_PHOTOS, Photo, list_photos
from drgs.reconstruct.pose.pose_photographs import PoseSettings
from drgs.reconstruct.pose.posed_dataset import film_of

SECONDS_A_PHOTO, SECONDS_A_PAIR = 1.7, 0.05
"""Of finding poses on two slow cores (69 pictures of 1200 pixels: 236 s)."""


def file_of(photo: Photo) -> PictureFile:
    """As `drgs pose` reads it."""
    return PictureFile(photo.name, photo.path, photo.mask, turned_by_exif=True)


def photographs(folder: Path, what_to_take: str) -> tuple[dict[str, Any], list[Finding]]:
    """The report's own keys, and findings.

    Args:
        what_to_take: advice for too few pictures.

    Raises:
        ValueError: one sentence: there are no pictures that poses could be looked for in.
    """
    if film_of(folder) is not None:
        return {"source": "film", "summary": "A film; a build first takes its sharpest frames and finds where they were taken from."}, []
    photos = list_photos(folder)
    seen, findings = _looked_at(photos)
    masked = [look.name for look in seen if look.mask_share is not None]
    count = len(seen)
    if count < FEWEST_PHOTOS:
        sentence = f"{folder}: {count} of {len(photos)} pictures can be used, expected at least {FEWEST_PHOTOS}."
        return {"source": "photographs", "views": count, "summary": ""}, [Finding("error", sentence, what_to_take), *findings]
    if masked and len(masked) < count:
        lacking = [look.name for look in seen if look.mask_share is None]
        sentence = (
            f"{folder}: {len(lacking)} of {count} pictures have neither transparency nor a mask ({few(lacking)}), but the others have."
        )
        findings.insert(0, Finding("error", sentence, "Give a mask to each picture, or to none.", tuple(lacking), "no mask"))
    section, found = looks(seen)
    findings += found
    if count < FEW_VIEWS:
        findings.append(Finding("warning", f"{count} pictures are few.", what_to_take))
    findings += _texture(seen)
    if not masked:
        findings.append(
            Finding(
                "info",
                "There are no masks/: a plain backdrop is told from the object; before any other, what stands close to the object becomes part of it.",
                "Take the pictures before plain paper or cloth, or put masks of the same names (white object, black background) in masks/.",
            )
        )
    minutes = max(1, round((count * SECONDS_A_PHOTO + count * (count - 1) / 2 * SECONDS_A_PAIR) / 60))
    summary = f"{count} pictures without cameras; a build first finds where they were taken from, which takes about {minutes} minutes."
    told_sizes = [[*size, number] for size, number in _sizes(photos).most_common() if size[0]]
    return {
        "source": "photographs", "views": count, "sizes": told_sizes, "masks": {"present": bool(masked)}, "looks": section, "summary": summary,
    }, findings  # fmt: skip


def _looked_at(photos: list[Photo]) -> tuple[list[PictureLook], list[Finding]]:
    """The pictures that a search for poses will use, and what is said of those that it leaves out."""
    seen: list[PictureLook] = []
    findings: list[Finding] = []
    first_of: dict[bytes, str] = {}
    for photo, look in zip(photos, picture_looks([file_of(photo) for photo in photos]), strict=True):
        if isinstance(look, str):
            findings.append(
                Finding(
                    "warning", f"{look} The build leaves it out.", "Copy it from the camera once more.", (photo.name,), "cannot be read"
                )
            )
            continue
        digest = hashlib.sha256(photo.path.read_bytes()).digest()
        if digest in first_of:
            continue
        first_of[digest] = photo.name
        seen.append(look)
    copies = len(photos) - len(seen) - len(findings)
    if copies:
        used = {look.name for look in seen} | {name for finding in findings for name in finding.pictures}
        names = [photo.name for photo in photos if photo.name not in used]
        sentence = f"{copies} of {len(photos)} pictures are the same files as others ({few(names)}). The build leaves them out."
        findings.append(Finding("warning", sentence, "Nothing is lost if that is all; else check what was copied.", tuple(names), "copy"))
    return seen, findings


def _texture(seen: list[PictureLook]) -> list[Finding]:
    poor = [look.name for look in seen if look.textured_cells < FEWEST_FEATURES]
    if len(poor) <= (1 - PoseSettings().least_share) * len(seen):
        return []
    sentence = f"{len(poor)} of {len(seen)} pictures show hardly any texture to recognise places by ({few(poor)}): poses will probably not be found."
    advice = "Put textured things, such as a newspaper, around the object and let them be seen; with a turntable, on it."
    return [Finding("warning", sentence, advice, tuple(poor), "no texture")]


def _sizes(photos: list[Photo]) -> Counter[tuple[int, int]]:
    """Of the pictures whose header tells, and (0, 0) of the others."""
    sizes: Counter[tuple[int, int]] = Counter()
    for photo in photos:
        try:
            sizes[image_size(photo.path) if is_header_readable(photo.path) else (0, 0)] += 1
        except ValueError:
            sizes[(0, 0)] += 1
    return sizes
