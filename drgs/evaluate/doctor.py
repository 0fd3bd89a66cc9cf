"""Check a capture before time is spent on it: what was found, what will hurt the result, what to do about it.

In: a folder. Out: plain JSON data. A folder that cannot be read is a finding, not an exception.
"""

import math
from collections import Counter
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch

from drgs.reconstruct.capture.exposures import VARIED_STOPS, brightness_stops, jumps, spread
from drgs.reconstruct.capture.initial_points import InitialPoints, initial_points, project_points
from drgs.reconstruct.capture.load_views import read_capture
from drgs.reconstruct.capture.load_views.capture import Capture
from drgs.reconstruct.capture.load_views.checks import IMAGE_SUFFIXES, image_size, pictures_in
from drgs.reconstruct.capture.load_views.read_pictures import read_pictures
from drgs.reconstruct.capture.turning_light import light_found
from drgs.reconstruct.pose.list_photos import HEIC_SUFFIXES, list_photos
from drgs.reconstruct.pose.posed_dataset import film_of, needs_poses
from drgs.scene.views import Views

EXAMINED_SIDE = 400
"""Pictures are examined at this size [pixels]; what it hides does not matter here."""
EXAMINED_POINTS = 20_000
FEW_VIEWS = 20
LARGE_SIDE = 1600
"""Longer sides cost time and memory that a build on a CPU does not turn into quality."""
WIDE_GAP = 50.0
"""[degrees] a direction this far from every camera is not reconstructed, but guessed."""
SMALL_COVERAGE, LARGE_COVERAGE = 0.03, 0.8
CLIPPED_BYTE = 254
MUCH_CLIPPED = 0.05
POOR_AGREEMENT = 0.85
"""Intersection over union of a mask with what all masks together say."""
TILTED_UP = 30.0
"""[degrees]"""
WHAT_IS_READ = (
    "Mend that first. A capture is a folder with transforms_train.json (NeRF-synthetic), transforms.json (nerfstudio), "
    "sparse/ and images/ (COLMAP), Metashape's *.xml or NeRO's cameras, and with all pictures that these name."
)

WHAT_TO_TAKE = (
    "Take 40 to 100 sharp pictures from all around and at two or three heights, each overlapping the next by two thirds, the object and what stands "
    "around it at rest."
)
SECONDS_A_PHOTO, SECONDS_A_PAIR = 1.7, 0.05
"""Of finding poses on two slow cores (69 pictures of 1200 pixels: 236 s)."""


@dataclass(frozen=True)
class Finding:
    level: Literal["error", "warning", "info"]
    sentence: str
    advice: str = ""


def doctor(folder: Path) -> dict[str, Any]:
    """Report on a capture; `ok` says whether a build can start. Keys: see docs of `drgs doctor`."""
    folder = Path(folder)
    if needs_poses(folder):
        return _of_photographs(folder)
    try:
        capture = read_capture(folder)
        views = read_pictures(capture, EXAMINED_SIDE)
        points = initial_points(views, EXAMINED_POINTS, seed=0)
    except (ValueError, OSError) as error:
        return _refusal(folder, error, WHAT_IS_READ)

    report: dict[str, Any] = {"ok": True, "folder": str(folder), "source": capture.source, "views": len(capture.photographs)}
    findings: list[Finding] = []
    for section, examine in (
        ("pictures", lambda: _pictures(capture)),
        ("files", lambda: _files(folder, capture)),
        ("intrinsics", lambda: _intrinsics(capture)),
        ("masks", lambda: _masks(views, points)),
        ("scale", lambda: _scale(views, points)),
        ("directions", lambda: _directions(views, points)),
        ("exposure", lambda: _exposure(views, points)),
        ("initial_points", lambda: _points(views, points)),
        ("light", lambda: _light(capture, views, points)),
    ):
        report[section], found = examine()
        findings += found
    report |= report.pop("pictures")
    report["summary"] = _summary(report)
    report["findings"] = [asdict(finding) for finding in findings]
    report["advice"] = [finding.advice for finding in findings if finding.advice]
    return report


def _refusal(folder: Path, error: ValueError | OSError, advice: str) -> dict[str, Any]:
    sentence = f"{error.filename}: {error.strerror}." if isinstance(error, OSError) and error.filename else str(error)
    finding = {"level": "error", "sentence": sentence, "advice": advice}
    return {"ok": False, "folder": str(folder), "summary": "", "findings": [finding], "advice": [advice]}


def _of_photographs(folder: Path) -> dict[str, Any]:
    """Of pictures without cameras, or of a film: what can be said before poses are looked for."""
    if film_of(folder) is not None:
        summary = "A film; a build first takes its sharpest frames and finds where they were taken from."
        return {"ok": True, "folder": str(folder), "source": "film", "summary": summary, "findings": [], "advice": []}
    try:
        photos = list_photos(folder)
    except (ValueError, OSError) as error:
        return _refusal(folder, error, WHAT_TO_TAKE)
    sizes: Counter[tuple[int, int]] = Counter()
    unreadable = []
    for photo in photos:
        try:
            sizes[(0, 0) if photo.path.suffix.lower() in HEIC_SUFFIXES else image_size(photo.path)] += 1
        except ValueError as error:
            unreadable.append(Finding("warning", f"{error} The build leaves it out.", "Copy it from the camera once more."))
    count, masks = len(photos) - len(unreadable), sum(photo.mask is not None for photo in photos)
    minutes = max(1, round((count * SECONDS_A_PHOTO + count * (count - 1) / 2 * SECONDS_A_PAIR) / 60))
    findings = unreadable
    if count < FEW_VIEWS:
        findings.append(Finding("warning", f"{count} pictures are few.", WHAT_TO_TAKE))
    if not masks:
        findings.append(
            Finding(
                "info",
                "There are no masks/: a plain backdrop is told from the object; before any other, what stands close to the object becomes part of it.",
                "Take the pictures before plain paper or cloth, or put masks of the same names (white object, black background) in masks/.",
            )
        )
    summary = f"{count} pictures without cameras; a build first finds where they were taken from, which takes about {minutes} minutes."
    return {
        "ok": True, "folder": str(folder), "source": "photographs", "views": count, "sizes": [[*size, n] for size, n in sizes.most_common() if size[0]],
        "masks": {"present": masks > 0}, "summary": summary, "findings": [asdict(finding) for finding in findings],
        "advice": [finding.advice for finding in findings if finding.advice],
    }  # fmt: skip


def _summary(report: dict[str, Any]) -> str:
    width, height = report["size"]
    masks = report["masks"]
    about = f"with masks; the object fills {100 * masks['mean_coverage']:.0f} % of them" if masks["present"] else "without masks"
    others = f" and {len(report['sizes']) - 1} other sizes" if len(report["sizes"]) > 1 else ""
    return f"{report['views']} pictures of {width}x{height}{others} {about}."


_Section = tuple[dict[str, Any], list[Finding]]


def _pictures(capture: Capture) -> _Section:
    sizes = Counter((photograph.pinhole.width, photograph.pinhole.height) for photograph in capture.photographs)
    count, largest = len(capture.photographs), max(sizes, key=max)
    findings = []
    if count < FEW_VIEWS:
        findings.append(Finding("warning", f"{count} views are few.", f"Take {FEW_VIEWS} to 100 pictures, all around the object."))
    if max(largest) > LARGE_SIDE:
        findings.append(
            Finding("info", f"Pictures of {largest[0]}x{largest[1]} are larger than a build needs.", "Shrink them for a first build.")
        )
    usual = [[*size, pictures] for size, pictures in sizes.most_common()]
    return {"size": usual[0][:2], "sizes": usual}, findings


def _files(folder: Path, capture: Capture) -> _Section:
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
            names = _few([path.name for path in unused])
            findings.append(Finding("info", f"{len(unused)} {what} are not used ({names}).", advice))
    summary = {
        "pictures_used": len(images),
        "masks_used": len(masks),
        "pictures_unused": len(unused_images),
        "masks_unused": len(unused_masks),
    }
    return summary, findings


def _intrinsics(capture: Capture) -> _Section:
    pinholes = [photograph.pinhole for photograph in capture.photographs]
    focal = np.array([[pinhole.fx, pinhole.fy] for pinhole in pinholes])
    offset = np.array([[pinhole.cx - pinhole.width / 2, pinhole.cy - pinhole.height / 2] for pinhole in pinholes])
    size = np.array([[pinhole.width, pinhole.height] for pinhole in pinholes])
    angle = float(np.degrees(2 * np.arctan(0.5 * size[:, 0] / focal[:, 0])).mean())
    findings = []
    relative = focal[:, 0] / size.max(1)
    spread = float(relative.max() / relative.min())
    if spread > 1.05:
        findings.append(
            Finding("info", f"Focal lengths differ by {100 * (spread - 1):.0f} % between views (zoom, or a calibration per picture).")
        )
    aspect = float(np.abs(focal[:, 0] / focal[:, 1] - 1).max())
    if aspect > 0.05:
        findings.append(
            Finding(
                "warning",
                f"Pixels are {100 * aspect:.0f} % off square, which real cameras' are not.",
                "Check fl_x and fl_y of the camera file.",
            )
        )
    shift = float((np.abs(offset) / size).max())
    if shift > 0.2:
        findings.append(
            Finding(
                "warning",
                f"The principal point is {100 * shift:.0f} % of the picture off its middle.",
                "Check cx and cy, unless pictures were cropped.",
            )
        )
    bent = [photograph.lens.model for photograph in capture.photographs if photograph.lens is not None]
    if bent:
        models = ", ".join(sorted(set(bent)))
        findings.append(Finding("info", f"{len(bent)} pictures are undistorted before anything else ({models})."))
    summary = {
        "model": "pinhole",
        "undistorted_pictures": len(bent),
        "focal_pixels": [round(float(focal.min()), 2), round(float(focal.max()), 2)],
        "field_of_view_degrees": round(angle, 2),
        "principal_point_offset_pixels": [round(float(value), 2) for value in offset.mean(0)],
    }
    return summary, findings


def _masks(views: Views, points: InitialPoints) -> _Section:
    names = [camera.name for camera in views.cameras]
    if not views.has_masks:
        finding = Finding(
            "warning",
            "There are no masks: the build looks for the object itself, and what stands close to it becomes part of it.",
            "Save pictures with an alpha channel, or put masks of the same names (white object, black background) in masks/.",
        )
        return {"present": False, "mean_coverage": None, "touching_border": [], "empty": [], "disagreeing": []}, [finding]
    masks = [coverage > 127 for coverage in views.coverage]
    share = torch.stack([inside.float().mean() for inside in masks])
    touching = [
        name
        for name, inside in zip(names, masks, strict=True)
        if bool(torch.cat([inside[0], inside[-1], inside[:, 0], inside[:, -1]]).any())
    ]
    empty = [name for name, value in zip(names, share.tolist(), strict=True) if value == 0]
    agreement = _mask_agreement(views, points)
    disagreeing = [name for name, value in zip(names, agreement, strict=True) if value < POOR_AGREEMENT and name not in empty]
    findings = []
    if touching:
        findings.append(
            Finding(
                "warning",
                f"The object touches the picture's border in {len(touching)} of {len(names)} views ({_few(touching)}).",
                "Step back, or leave such pictures out: what is cut off cannot be told from background.",
            )
        )
    if empty:
        findings.append(Finding("warning", f"The mask is empty in {len(empty)} views ({_few(empty)}).", "Leave these pictures out."))
    if disagreeing:
        findings.append(
            Finding(
                "warning",
                f"In {len(disagreeing)} of {len(names)} views ({_few(disagreeing)}) the mask differs from what the other masks imply.",
                "Look at these masks and poses: one of the two is wrong, or the object moved.",
            )
        )
    mean = float(share.mean())
    if mean < SMALL_COVERAGE:
        findings.append(
            Finding("warning", f"The object fills {100 * mean:.1f} % of the picture.", "Go nearer, or crop (and shift cx, cy).")
        )
    if mean > LARGE_COVERAGE:
        findings.append(
            Finding(
                "warning",
                f"The masks cover {100 * mean:.0f} % of the picture.",
                "Check that white means object; inverted masks look like this.",
            )
        )
    summary = {
        "present": True,
        "mean_coverage": round(mean, 4),
        "touching_border": touching,
        "empty": empty,
        "agreement": round(float(np.median(agreement)), 4),
        "disagreeing": disagreeing,
    }
    return summary, findings


def _mask_agreement(views: Views, points: InitialPoints) -> list[float]:
    """Of each view: the intersection over union of its mask and the hull's silhouette, in cells wide enough for points to fill."""
    if points.hull_vertices is None:
        return [1.0] * len(views.cameras)
    vertices = points.hull_vertices.numpy()[:: 1 + len(points.hull_vertices) // EXAMINED_POINTS]
    agreement = []
    for camera, coverage in zip(views.cameras, views.coverage, strict=True):
        stride = max(2, coverage.shape[-1] // 100)
        mask = torch.nn.functional.max_pool2d((coverage > 127).float()[None], stride, stride, ceil_mode=True)[0].numpy() > 0
        column, row, seen, _ = project_points(camera, vertices)
        drawn = np.zeros_like(mask)
        drawn[row[seen] // stride, column[seen] // stride] = True
        # Vertices are a surface: in views from close by they leave cells inside the outline empty.
        grown = torch.nn.functional.max_pool2d(torch.from_numpy(drawn).float()[None], 3, 1, 1)
        hull = (1 - torch.nn.functional.max_pool2d(1 - grown, 3, 1, 1))[0].numpy() > 0
        agreement.append(float((mask & hull).sum() / max(1, (mask | hull).sum())))
    return agreement


def _scale(views: Views, points: InitialPoints) -> _Section:
    centers = torch.stack([camera.center_world for camera in views.cameras])
    distance = (centers - points.bounds_center).norm(dim=1)
    findings = []
    if float(distance.min()) < points.bounds_radius:
        findings.append(
            Finding(
                "warning",
                "A camera lies inside the object's bounding sphere.",
                "Check the poses' scale against the points, or mask the background.",
            )
        )
    up = torch.stack([-camera.camera_from_world[1, :3] for camera in views.cameras]).mean(0)
    tilt = float(torch.rad2deg(torch.acos((up[2] / up.norm().clamp(min=1e-6)).clamp(-1, 1))))
    if tilt > TILTED_UP:
        findings.append(
            Finding(
                "warning",
                f"The cameras' mean upward direction is {tilt:.0f} degrees off the world's z axis.",
                "Environments have z up: turn the world upright (COLMAP: model_orientation_aligner), or rotate the light.",
            )
        )
    decimals = max(5, 4 - math.floor(math.log10(points.bounds_radius)))  # whatever the capture's unit
    summary = {
        "bounds_center": [round(float(value), decimals) for value in points.bounds_center],
        "bounds_radius": round(points.bounds_radius, decimals),
        "camera_distance": [round(float(distance.min()), decimals), round(float(distance.max()), decimals)],
        "up_tilt_degrees": round(tilt, 1),
    }
    return summary, findings


def _directions(views: Views, points: InitialPoints) -> _Section:
    centers = torch.stack([camera.center_world for camera in views.cameras]).double().numpy()
    toward = centers - points.bounds_center.double().numpy()
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-12)
    elevation = np.degrees(np.arcsin(np.clip(toward[:, 2], -1, 1)))
    azimuth = np.sort(np.degrees(np.arctan2(toward[:, 1], toward[:, 0])))
    gaps = np.diff(np.append(azimuth, azimuth[0] + 360))
    widest = int(gaps.argmax())
    middle = (azimuth[widest] + gaps[widest] / 2 + 180) % 360 - 180
    k = np.arange(2000) + 0.5
    z, around = 1 - 2 * k / 2000, np.pi * (1 + 5**0.5) * k
    probes = np.stack([np.sqrt(1 - z * z) * np.cos(around), np.sqrt(1 - z * z) * np.sin(around), z], -1)
    nearest = np.degrees(np.arccos(np.clip(probes @ toward.T, -1, 1))).min(1)
    findings = []
    if gaps[widest] > WIDE_GAP:
        findings.append(
            Finding(
                "warning",
                f"No view from azimuths within {gaps[widest] / 2:.0f} degrees of {middle:.0f}.",
                "Add pictures from there: that side's shape and material will be guessed.",
            )
        )
    for name, pole, sentence in (("above", 1.0, "the top"), ("below", -1.0, "the underside")):
        if np.degrees(np.arccos(np.clip(pole * toward[:, 2], -1, 1))).min() > 90 - 15:
            findings.append(
                Finding(
                    "info",
                    f"No view from {name} (nearest elevation {elevation.max() if pole > 0 else elevation.min():.0f} degrees): {sentence} is guessed.",
                )
            )
    summary = {
        "elevation_degrees": [round(float(elevation.min()), 1), round(float(elevation.max()), 1)],
        "widest_azimuth_gap_degrees": round(float(gaps[widest]), 1),
        "widest_azimuth_gap_at_degrees": round(float(middle), 1),
        "sphere_within_30_degrees_of_a_view": round(float((nearest < 30).mean()), 4),
    }
    return summary, findings


def _exposure(views: Views, points: InitialPoints) -> _Section:
    object_pixels = torch.cat([image[mask > 200] for image, mask in zip(views.images_srgb, views.coverage, strict=True)])
    clipped_share = float((object_pixels >= CLIPPED_BYTE).any(-1).sum()) / max(1, len(object_pixels))
    black_share = float((object_pixels <= 1).all(-1).sum()) / max(1, len(object_pixels))
    stops = brightness_stops(views, points)
    findings = []
    if clipped_share > MUCH_CLIPPED:
        findings.append(
            Finding(
                "warning",
                f"{100 * clipped_share:.1f} % of the object's pixels are over-exposed.",
                "Expose for the highlights: clipped ones hide how bright the light and how smooth the surface is.",
            )
        )
    if black_share > 0.3:
        findings.append(
            Finding("warning", f"{100 * black_share:.0f} % of the object's pixels are black.", "Use longer exposures or more light.")
        )
    if jumps(stops, views) > VARIED_STOPS:
        findings.append(
            Finding(
                "warning",
                f"The same points differ in brightness by {spread(stops):.2f} stops between views; a build takes that for their exposures.",
                "Lock exposure and white balance, and keep the light still.",
            )
        )
    summary = {
        "clipped_share": round(clipped_share, 4),
        "black_share": round(black_share, 4),
        "brightness_variation_stops": round(spread(stops), 4),
    }
    return summary, findings


def _light(capture: Capture, views: Views, points: InitialPoints) -> _Section:
    """What the light stood still with."""
    found = light_found(capture, views, points)
    findings = []
    if found.frame == "camera":
        findings.append(
            Finding(
                "info",
                f"The light stands still with the camera, as on a turntable, for {found.why}.",
                "If the camera went around the object all the same, build with --light object.",
            )
        )
    return {key: value for key, value in asdict(found).items() if value is not None}, findings


def _points(views: Views, points: InitialPoints) -> _Section:
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


def _few(names: list[str]) -> str:
    return ", ".join(names[:3]) + (", ..." if len(names) > 3 else "")
