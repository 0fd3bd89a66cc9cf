"""What of the data directory is shared with other machines, and when it comes and goes. Without an artifact store nothing here does anything.

assets/ID        a finished asset; it never changes, so that whoever has the folder has it
captures/ID      an upload, unpacked
clips/ID         a simulation
environments/NAME.exr
weights/HASH.f32 painted weights that selections refer to
jobs/ID          a job's working folder as its last finished step left it: checkpoints, preview, log, results; any worker can go on from it

An artifact is in the store before a row of the database names it. The data directory is a cache: what is missing in it is fetched, and what
nobody works with may be deleted.
"""

import os
import re
import shutil
import time
from collections.abc import Iterable
from pathlib import Path

from sqlalchemy import Engine, select
from sqlalchemy.orm import Session

from drgs.scene.edits import Edit, EnvironmentEdit, MaterialEdit, PoseEdit, VariantEdit
from drgs_worker.store.artifact_store import ArtifactMissing
from drgs_worker.store.data_directory import DataDirectory, try_lock_file
from drgs_worker.store.database import AssetRow, CaptureRow, JobRow

_UPLOAD = re.compile(r"[0-9a-f]{32}")

WEIGHTS = "weights"
"""Folder of painted weights, beside those of clips."""
_WEIGHTS = re.compile(rf"{WEIGHTS}/[0-9a-f]{{32}}\.f32")

CACHE_SECONDS = 3600.0
"""Younger folders stay: their row may not be written yet."""
KNOWN = ".stored"
"""File in a job's folder: digest of the stored manifest with which the folder was last equal."""
RUN_LOCK = ".lock"
"""File in a job's folder: locked while a step runs there."""


def fetch_asset(directory: DataDirectory, asset_id: str) -> Path:
    """The folder of an asset on this machine.

    Raises:
        StoreAway, ArtifactMissing, ArtifactDamaged: a sentence.
    """
    return _fetch_missing(directory, "assets", asset_id, directory.asset(asset_id))


def fetch_clip(directory: DataDirectory, clip: str) -> Path:
    """The folder of what a `pose` edit calls `clips/ID`; raises like fetch_asset."""
    job_id = clip.rpartition("/")[2]
    directory.clip(job_id).parent.mkdir(mode=0o700, exist_ok=True)
    return _fetch_missing(directory, "clips", job_id, directory.clip(job_id))


def has_clip(directory: DataDirectory, clip: str, or_growing: bool = False) -> bool:
    """Whether there is such a clip; it is on this machine then.

    Args:
        or_growing: or the beginning of one that a worker of this machine is making.

    Raises:
        StoreAway, ArtifactDamaged: a sentence.
    """
    if or_growing and (directory.growing_clip(clip.rpartition("/")[2]) / "clip.json").is_file():
        return True
    try:
        return (fetch_clip(directory, clip) / "clip.json").is_file()
    except ArtifactMissing:
        return False


def fetch_environment(directory: DataDirectory, name: str) -> Path:
    """The EXR file; raises like fetch_asset."""
    return _fetch_missing(directory, "environments", name, directory.environments / name)


def has_weights(directory: DataDirectory, name: str) -> bool:
    """Whether there are such painted weights, `weights/HASH.f32` as selections call them; they are on this machine then, and stay for a while.

    Raises:
        StoreAway, ArtifactDamaged: a sentence.
    """
    if not _WEIGHTS.fullmatch(name):
        return False
    place = directory.environments / name
    place.parent.mkdir(mode=0o700, exist_ok=True)
    try:
        return mark_used(_fetch_missing(directory, WEIGHTS, place.name, place))
    except ArtifactMissing:
        return False


def mark_used(weights: Path) -> bool:
    """Note that somebody is about to name a file of weights (remove_unused.py); False where it is not there."""
    try:
        # The time of its last change stays: by that, poses see whether a file is another one.
        os.utime(weights, ns=(time.time_ns(), weights.stat().st_mtime_ns))
    except FileNotFoundError:
        return False
    return True


def fetch_edit_files(directory: DataDirectory, edits: Iterable[Edit]) -> None:
    """The files and clips that edits name; raises like fetch_asset."""
    if directory.store is None:
        return
    for edit in edits:
        if isinstance(edit, EnvironmentEdit) and edit.file is not None:
            fetch_environment(directory, edit.file)
        elif isinstance(edit, PoseEdit):
            fetch_clip(directory, edit.clip)
        elif isinstance(edit, MaterialEdit) and edit.select.weights_file is not None:
            has_weights(directory, edit.select.weights_file)
        elif isinstance(edit, VariantEdit):
            fetch_edit_files(directory, edit.edits)


def fetch_capture(directory: DataDirectory, dataset: Path) -> Path:
    """The capture's folder on this machine, whose data directory may lie elsewhere than that of the machine that took the upload; raises like fetch_asset."""
    if directory.store is None or dataset.is_dir() or "uploads" not in dataset.parts:
        return dataset
    below = dataset.parts[len(dataset.parts) - dataset.parts[::-1].index("uploads") :]
    if not below or not _UPLOAD.fullmatch(below[0]):
        return dataset  # a folder of a capture root that is called so
    _fetch_missing(directory, "captures", below[0], directory.uploads / below[0])
    return directory.uploads.joinpath(*below)


def _fetch_missing(directory: DataDirectory, kind: str, id: str, place: Path) -> Path:
    if directory.store is not None and not place.exists():
        directory.store.get(kind, id, place)
    return place


def share_artifact(directory: DataDirectory, kind: str, id: str, place: Path) -> None:
    """Share a finished folder or file.

    Raises:
        StoreAway: a sentence; it is not shared.
    """
    if directory.store is not None:
        directory.store.put(kind, id, place)


def unshare_artifact(directory: DataDirectory, kind: str, id: str) -> None:
    """Take an artifact out of the store.

    Raises:
        StoreAway: a sentence; call it again.
    """
    if directory.store is not None:
        directory.store.delete(kind, id)


def fetch_job(directory: DataDirectory, job_id: str) -> None:
    """Bring a job's folder to where its last finished step left it, if that was on another machine. The caller holds RUN_LOCK.

    Raises:
        StoreAway, ArtifactDamaged: a sentence.
    """
    if directory.store is None:
        return
    try:
        manifest = directory.store.manifest("jobs", job_id)
    except ArtifactMissing:
        return
    folder = directory.job(job_id)
    known = folder / KNOWN
    if known.is_file() and known.read_text() == manifest.digest:
        return  # the folder is equal, or its job has gone on since
    directory.store.update("jobs", job_id, folder, manifest, _is_own)
    known.write_text(manifest.digest)


def share_job(directory: DataDirectory, job_id: str) -> None:
    """Share a job's folder as a finished step left it.

    Raises:
        StoreAway: a sentence.
    """
    if directory.store is not None:
        folder = directory.job(job_id)
        manifest = directory.store.put("jobs", job_id, folder, _is_own)
        (folder / KNOWN).write_text(manifest.digest)


def refresh_job(directory: DataDirectory, job_id: str) -> None:
    """The same for readers: does nothing while a step runs in the folder on this machine.

    Raises:
        StoreAway, ArtifactDamaged: a sentence.
    """
    folder = directory.job(job_id)
    if directory.store is None:
        return
    if not folder.exists():
        if not directory.store.has("jobs", job_id):
            return
        folder.mkdir(mode=0o700, exist_ok=True)
    if (lock := try_lock_file(folder / RUN_LOCK)) is not None:
        try:
            fetch_job(directory, job_id)
        finally:
            os.close(lock)


def remove_deleted_elsewhere(directory: DataDirectory, engine: Engine) -> int:
    """Remove folders whose artifacts were deleted on another machine. Returns how many.

    Raises:
        StoreAway: a sentence.
    """
    if directory.store is None:
        return 0
    with Session(engine) as session:
        assets, jobs, captures = (set(session.scalars(select(table.id))) for table in (AssetRow, JobRow, CaptureRow))
    old, removed = time.time() - CACHE_SECONDS, 0
    clips = directory.environments / "clips"
    for kind, folder, known in (
        ("assets", directory.assets, assets),
        ("captures", directory.uploads, jobs | captures),
        ("jobs", directory.jobs, jobs),
        ("clips", clips, jobs),
    ):
        for path in folder.iterdir() if folder.is_dir() else ():
            if (
                path.name.startswith(".")
                or path.name.removesuffix(".making") in known
                or path.stat().st_mtime > old
                or directory.store.has(kind, path.name)
            ):
                continue
            shutil.rmtree(path, ignore_errors=True)
            removed += 1
    return removed


def _is_own(path: str) -> bool:
    """Whether a file stays on this machine: locks, drafts and what is half written."""
    name = path.rpartition("/")[2]
    return name.startswith((".", "draft-")) or name.endswith((".part", ".new"))
