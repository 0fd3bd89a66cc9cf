"""A folder of plain photographs becomes a posed capture that builds read: upright pictures, features, matches, poses, undistorted pictures, an upright world.

Reads like the way of the pictures. Work files lie in OUT/.pose/ until the capture is complete; a run that was stopped or killed goes on, with `resume`,
from the last finished step. The capture is put in place whole.
"""

import hashlib
import json
import os
import shutil
import time
from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from itertools import groupby
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from drgs.installation import missing_package
from drgs.reconstruct.pose.colmap_process import colmap_process
from drgs.reconstruct.pose.explain_failure import (
    NoPoses,
    blurred_photos,
    check_baseline,
    check_depth,
    check_features,
    check_placed,
    check_readable,
    reasons_left_out,
)
from drgs.reconstruct.pose.list_photos import Photo, list_photos
from drgs.reconstruct.pose.posed_capture import (
    PARTS,
    PosedCapture,
    PosedPictures,
    forget_posed_capture,
    read_posed_capture,
    write_posed_capture,
)
from drgs.reconstruct.pose.prepare_photos import JPEG_QUALITY, PreparedPhoto, prepare_photos, with_backdrop_masks
from drgs.reconstruct.pose.upright_world import upright_world
from drgs.reconstruct.progress import Progress

WORK = ".pose"
NO_BACKDROP = "no_backdrop"
"""In the work folder: by what lies before a plain backdrop alone no poses were found."""
STEPS = ("features", "matches", "poses", "undistort")
"""Of run_colmap.py."""
POSE_SHARES = {"read": 0.05, "features": 0.29, "matches": 0.41, "poses": 0.17, "undistort": 0.08}
"""The steps in their order, and their shares of the time, for the progress bar."""
STEP_MESSAGES = {
    "read": "reading the pictures",
    "features": "looking for features",
    "matches": "matching pictures",
    "poses": "placing pictures",
    "undistort": "undistorting pictures",
}
MOST_EXHAUSTIVE = 200
"""Pictures of which all pairs are matched by default; it is quadratic."""
LEAST_TRACK = 3
"""Pictures that must see a point for it to be kept: with two, a mismatch passes for a point."""


@dataclass(frozen=True)
class PoseSettings:
    """How poses are looked for. The defaults suit photographs of an object; feature numbers are a compromise with two slow cores."""

    matching: Literal["auto", "exhaustive", "sequential"] = "auto"
    """sequential: pictures are in the order in which they were taken, as frames of a video are. auto: by their number."""
    seed: int = 0
    resume: bool = False
    feature_side: int = 1600
    """Larger pictures are shrunk to this for finding features [pixels]; poses and results refer to the full ones."""
    most_features: int = 4096
    """Of a picture."""
    camera_model: str = "SIMPLE_RADIAL"
    """COLMAP's: one focal length and one term of distortion, which few pictures determine well."""
    overlap: int = 15
    """Sequential: each picture is matched with this many behind it."""
    least_share: float = 0.6
    """Fewer placed pictures than this share are a failure."""


def pose_photographs(
    photos: Path,
    out: Path,
    settings: PoseSettings,
    progress: Callable[[Progress], None] | None = None,
    should_stop: Callable[[], bool] | None = None,
) -> PosedCapture:
    """Find the poses of a folder's photographs and write the capture folder `out`.

    Args:
        should_stop: asked about twice a second; when true the search ends, and what it finished stays for `resume`.

    Raises:
        ValueError: one sentence: what was found, what was expected, what helps.
        BuildStopped: as asked.
    """
    photos, out = Path(photos), Path(out)
    should_stop = should_stop or (lambda: False)
    report = _Reporter(progress)
    if find_spec("pycolmap") is None:
        raise ValueError(missing_package("finding the poses of pictures", "pycolmap", "sfm"))
    _check_places(photos, out)
    report("read", 0, 1)
    started = time.monotonic()
    listed = list_photos(photos)
    work = out / WORK
    if not settings.resume:
        shutil.rmtree(work, ignore_errors=True)
    work.mkdir(parents=True, exist_ok=True)
    prepared, left_out = prepare_photos(listed, work, lambda done: report("read", done, len(listed)), should_stop)
    check_readable(photos, prepared, left_out)
    masks_from = "files" if prepared[0].has_mask else "none"
    whole = prepared, left_out
    if masks_from == "none" and not (work / NO_BACKDROP).exists():
        prepared, others = with_backdrop_masks(prepared, work, should_stop)
        masks_from, left_out = "backdrop" if prepared[0].has_mask else "none", left_out | others
    seconds = {"read": round(time.monotonic() - started, 2)}
    while True:
        job = _job(prepared, settings)
        same = {job["identity"], _job(whole[0], settings)["identity"]}
        if settings.resume and (finished := read_posed_capture(out)) is not None and finished.identity in same:
            shutil.rmtree(work)
            return finished
        _write_job(job, work, out)
        try:
            found = _found_poses(photos, work, prepared, settings, report, should_stop)
            break
        except NoPoses:
            if masks_from != "backdrop":
                raise
        # What looked like paper may be a table that stands still with the object, and has the features that the object lacks.
        _forget_search(work)
        (work / NO_BACKDROP).touch()
        (prepared, left_out), masks_from = whole, "none"
    seconds |= {step: _document(work / f"{step}.done")["seconds"] for step in STEPS}
    capture = _write(photos, out, listed, prepared, left_out, found, job | {"masks_from": masks_from}, seconds)
    shutil.rmtree(work)
    report("undistort", 1, 1)
    return capture


@dataclass(frozen=True, eq=False)
class _Found:
    """What run_colmap.py left, after the checks."""

    model: dict[str, Any]
    pinholes: dict[str, dict[str, Any]]
    found_from_camera: Float64[ndarray, "camera 4 4"]
    reasons: dict[str, str]
    """Of prepared pictures without a pose."""
    blurred: list[str]


def _found_poses(
    photos: Path,
    work: Path,
    prepared: list[PreparedPhoto],
    settings: PoseSettings,
    report: "_Reporter",
    should_stop: Callable[[], bool],
) -> _Found:
    """Poses in COLMAP's world, checked. The checks name the first cause they meet."""
    blurred = blurred_photos(prepared)

    def checked_so_far() -> None:
        """What is known before the end: without features or without a baseline the later steps have nothing to do."""
        if (work / "features.done").exists():
            check_features(photos, prepared, _document(work / "features.json"), settings.least_share)
        if (work / "matches.done").exists():
            check_baseline(photos, _document(work / "matches.json")["median_move"])

    def told(step: str, done: int, total: int) -> None:
        report(step, done, total)
        if done == 0:  # the step before has just finished
            checked_so_far()

    colmap_process(work / "job.json", told, should_stop)
    checked_so_far()
    features, matches, model = (_document(work / f"{name}.json") for name in ("features", "matches", "model"))
    placed = set(model["pictures"])
    reasons = reasons_left_out(prepared, placed, features, matches["partners"], blurred)
    check_placed(photos, len(placed), len(prepared), reasons, blurred, settings.least_share)
    camera_from_found = np.array(
        [[*picture["camera_from_world"], [0, 0, 0, 1]] for picture in model["pictures"].values()], dtype=np.float64
    )
    found_from_camera = np.linalg.inv(camera_from_found)
    with np.load(work / "points.npz") as points:
        check_depth(photos, found_from_camera, points["positions"])
    return _Found(model, _document(work / "pinholes.json"), found_from_camera, reasons, blurred)


def _write(
    photos: Path,
    out: Path,
    listed: list[Photo],
    prepared: list[PreparedPhoto],
    left_out: dict[str, str],
    found: _Found,
    job: dict[str, Any],
    seconds: dict[str, float],
) -> PosedCapture:
    """The capture on disc, in an upright world."""
    work = out / WORK
    with np.load(work / "points.npz") as points:
        kept = points["views"] >= LEAST_TRACK
        positions, colors = points["positions"][kept], points["colors"][kept]
    similarity = upright_world(found.found_from_camera, positions, job["seed"])
    name_of = {photo.file: photo.name for photo in prepared}
    pictures, masked = found.model["pictures"], bool(job["masked"])
    capture = PosedCapture(
        folder=str(out),
        photographs=str(photos),
        identity=job["identity"],
        given=len(listed),
        placed=tuple(name_of[file] for file in pictures),
        left_out=dict(sorted((left_out | found.reasons).items())),
        blurred=tuple(found.blurred),
        masked=masked,
        masks_from=job["masks_from"],
        reprojection_error=float(found.model["mean_reprojection_error"]),
        points=len(positions),
        up_from=similarity.up_from,
        cameras=found.model["cameras"],
        camera_of={name_of[file]: str(picture["camera"]) for file, picture in pictures.items()},
        models=found.model["models"],
        model=found.model["model"],
        matching=job["matching"],
        seed=job["seed"],
        seconds=seconds,
    )
    posed = PosedPictures(
        files=tuple(pictures),
        world_from_camera=similarity.world_from_camera(found.found_from_camera),
        pinholes=tuple(found.pinholes[str(picture["camera"])] for picture in pictures.values()),
        masked=masked,
        points_world=similarity.points(positions),
        point_colors_srgb=colors,
    )
    write_posed_capture(posed, work / "undistorted", capture, out)
    return capture


def _check_places(photos: Path, out: Path) -> None:
    """The capture goes to a folder of its own, which holds nothing that it would replace."""
    here, there = photos.resolve(), out.resolve()
    if there == here or here in there.parents or there in here.parents:
        raise ValueError(f"{out}: one of the two folders lies in the other ({photos}), expected the capture in a folder apart.")
    foreign = [part for part in PARTS if (out / part).exists()]
    if foreign and not ((out / "poses.json").is_file() or (out / WORK).is_dir()):
        raise ValueError(
            f"{out / foreign[0]}: there already, and not written by an earlier search for poses; give another folder for the capture."
        )


def _job(prepared: list[PreparedPhoto], settings: PoseSettings) -> dict[str, Any]:
    """What run_colmap.py is told. Pictures of one size and focal length share a camera."""

    def camera(photo: PreparedPhoto) -> tuple[int, int, float]:
        return photo.width, photo.height, photo.focal_pixels or 0.0

    matching = settings.matching
    if matching == "auto":
        matching = "exhaustive" if len(prepared) <= MOST_EXHAUSTIVE else "sequential"
    groups = [
        {"width": width, "height": height, "focal_pixels": focal or None, "files": [photo.file for photo in group]}
        for (width, height, focal), group in groupby(sorted(prepared, key=lambda photo: (*camera(photo), photo.file)), camera)
    ]
    job = {
        "groups": groups,
        "masked": prepared[0].has_mask,
        "matching": matching,
        "seed": settings.seed,
        "feature_side": settings.feature_side,
        "most_features": settings.most_features,
        "camera_model": settings.camera_model,
        "overlap": settings.overlap,
        "jpeg_quality": JPEG_QUALITY,
    }
    told = json.dumps([job, [(photo.file, photo.digest) for photo in prepared]], sort_keys=True)
    return job | {"identity": hashlib.sha256(told.encode()).hexdigest()[:16], "threads": _core_count()}


def _write_job(job: dict[str, Any], work: Path, out: Path) -> None:
    """job.json, and nothing of another run beside it.

    Raises:
        ValueError: the work folder is that of other pictures or settings.
    """
    path = work / "job.json"
    if path.exists() and _document(path)["identity"] != job["identity"]:
        raise ValueError(
            f"{work}: left by a search with other pictures or settings; start anew without --resume, or give another folder than {out}."
        )
    forget_posed_capture(out)
    draft = path.with_suffix(".part")
    draft.write_text(json.dumps(job), encoding="utf-8")
    os.replace(draft, path)


def _forget_search(work: Path) -> None:
    """All of it but the prepared pictures."""
    for part in work.iterdir():
        if part.name == "images":
            continue
        shutil.rmtree(part) if part.is_dir() else part.unlink()
    (work / "masks").mkdir()


def _core_count() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def _document(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: damaged ({error}); start anew without --resume.") from error


class _Reporter:
    """Turns steps and counts into Progress. Final."""

    def __init__(self, progress: Callable[[Progress], None] | None) -> None:
        self._progress = progress
        self._most = 0.0

    def __call__(self, step: str, done: int, total: int) -> None:
        if self._progress is None:
            return
        names = list(POSE_SHARES)
        fraction = sum(POSE_SHARES[name] for name in names[: names.index(step)]) + POSE_SHARES[step] * done / max(total, 1)
        # A second search begins with features again.
        self._most = max(self._most, fraction)
        self._progress(
            Progress(step, done, total, self._most, message=f"{STEP_MESSAGES[step]}: {done} of {total}" if done else STEP_MESSAGES[step])
        )
