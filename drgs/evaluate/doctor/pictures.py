"""The doctor on pictures: how many of what size, which files are used, and which pictures are blurred, copies, or too bright or dark beside the others.

A picture is compared with the capture's own median, so that neither the object nor the camera sets the limits.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from drgs.evaluate.doctor.findings import Finding, Section, few
from drgs.evaluate.doctor.picture_looks import PictureLook
from drgs.reconstruct.capture.load_views.capture import Capture
from drgs.reconstruct.capture.load_views.checks import IMAGE_SUFFIXES, pictures_in

FEW_VIEWS = 20
LARGE_SIDE = 1600
"""Longer sides cost time and memory that a build on a CPU does not turn into quality."""
BLURRED_SHARE, SOFT_SHARE = 0.2, 0.4
"""Of the median sharpness and the median fineness: a picture with less of both is blurred, while a side with little texture has little sharpness alone. Single
pictures of seven captures have 0.23 and 0.30 or more; blurred by one to three pixels (standard deviation, noise of one shade added) less than 0.15 and 0.29."""
VERY_BLURRED_SHARE = 0.05
"""Of the median sharpness: what has less, and is less fine than the median, is blurred so much that its noise counts as fine. By five pixels: less than 0.02."""
FEWEST_COMPARED = 5
"""Pictures whose median says something."""
SAME_SHADES = 3
"""Of 255, between any two pixels of THUMBNAIL_SIDE² of two pictures: files saved again differ by one or two, a camera that moved by a degree by tens."""
ODD_SHARE, USUAL_SHARE = 0.5, 0.25
"""A picture stands out where more than the first share of the object's pixels is clipped or black, while in half of all pictures less than the second is."""


def sizes(capture: Capture) -> Section:
    """How many pictures there are, and how large."""
    found = Counter((photograph.pinhole.width, photograph.pinhole.height) for photograph in capture.photographs)
    count, largest = len(capture.photographs), max(found, key=max)
    findings = []
    if count < FEW_VIEWS:
        findings.append(Finding("warning", f"{count} views are few.", f"Take {FEW_VIEWS} to 100 pictures, all around the object."))
    if max(largest) > LARGE_SIDE:
        findings.append(
            Finding("info", f"Pictures of {largest[0]}x{largest[1]} are larger than a build needs.", "Shrink them for a first build.")
        )
    usual = [[*size, pictures] for size, pictures in found.most_common()]
    return {"size": usual[0][:2], "sizes": usual}, findings


def files(folder: Path, capture: Capture) -> Section:
    """What lies in the capture's folders of pictures and in masks/, and what of it a build will use."""
    images = {photograph.image for photograph in capture.photographs}
    masks = {photograph.mask for photograph in capture.photographs if photograph.mask is not None}
    unused_masks = [path for path in pictures_in(folder / "masks") if path not in masks]
    unused_images: list[Path] = []
    if capture.source != "nero":  # whose one folder holds depth and test views, too
        there = {path for parent in {image.parent for image in images} for path in parent.iterdir() if path.suffix in IMAGE_SUFFIXES}
        unused_images = sorted(there - images - masks)
    findings = []
    for unused, what, advice in (
        (unused_images, "pictures beside those that are used", "The camera file names no pose for them: add it, or leave them out."),
        (unused_masks, "masks", "Name each like its image, or leave it out."),
    ):
        if unused:
            names = few([path.name for path in unused])
            findings.append(Finding("info", f"{len(unused)} {what} are not used ({names}).", advice))
    summary = {
        "pictures_used": len(images),
        "masks_used": len(masks),
        "pictures_unused": len(unused_images),
        "masks_unused": len(unused_masks),
    }
    return summary, findings


def looks(seen: Sequence[PictureLook]) -> Section:
    """Pictures that are worse than the others, or the same as another."""
    copies = copied_pictures(seen)
    odd = {share: _odd_pictures(seen, share) for share in ("clipped_share", "black_share")}
    blurred = blurred_pictures(
        [look for look in seen if look.mask_share != 0 and look.name not in odd["clipped_share"] + odd["black_share"]]
    )
    findings = []
    if blurred:
        findings.append(
            Finding(
                "warning",
                f"{len(blurred)} of {len(seen)} pictures are blurred ({few(blurred)}).",
                "Leave them out or take them again: what they smear, the asset has smeared.",
                tuple(blurred),
                "blurred",
            )
        )
    if copies:
        shown = few([f"{name} as {other}" for name, other in copies.items()])
        findings.append(
            Finding(
                "warning",
                f"{len(copies)} of {len(seen)} pictures show the very same as another ({shown}).",
                "Leave copies out; where their poses differ, one of the two is the wrong file.",
                tuple(copies),
                "copy",
            )
        )
    for share, what, advice, mark in (
        ("clipped_share", "over-exposed", "Leave them out, or take them again with less exposure.", "over-exposed"),
        ("black_share", "under-exposed", "Leave them out, or take them again with more exposure.", "under-exposed"),
    ):
        if odd[share]:
            sentence = f"{len(odd[share])} of {len(seen)} pictures are {what} ({few(odd[share])})."
            findings.append(Finding("warning", sentence, advice, tuple(odd[share]), mark))
    summary = {"blurred": blurred, "copies": copies, "median_sharpness": round(float(np.median([look.sharpness for look in seen])), 2)}
    return summary, findings


def _odd_pictures(seen: Sequence[PictureLook], share: str) -> list[str]:
    values = [getattr(look, share) for look in seen]
    if len(seen) < FEWEST_COMPARED or np.median(values) >= USUAL_SHARE:
        return []
    return [look.name for look, value in zip(seen, values, strict=True) if value > ODD_SHARE]


def blurred_pictures(seen: Sequence[PictureLook]) -> list[str]:
    """Names of those that are much less sharp, and less fine, than the capture's median picture."""
    if len(seen) < FEWEST_COMPARED:
        return []
    sharp, fine = (float(np.median([getattr(look, which) for look in seen])) for which in ("sharpness", "fineness"))
    return [
        look.name
        for look in seen
        if (look.sharpness < BLURRED_SHARE * sharp and look.fineness < SOFT_SHARE * fine)
        or (look.sharpness < VERY_BLURRED_SHARE * sharp and look.fineness < fine)
    ]


def copied_pictures(seen: Sequence[PictureLook]) -> dict[str, str]:
    """Each picture that shows what an earlier one does, and that one."""
    thumbnails = np.stack([look.thumbnail for look in seen]).reshape(len(seen), -1).astype(np.int16)
    copies = {}
    for number, look in enumerate(seen):
        apart = np.abs(thumbnails[:number] - thumbnails[number]).max(1, initial=0)
        same = np.flatnonzero(apart <= SAME_SHADES)
        if len(same):
            copies[look.name] = seen[int(same[0])].name
    return copies
