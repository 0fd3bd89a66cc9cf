"""What of the data folder is shared where an artifact store is named, and when it comes and goes. Without one, nothing here does anything.

assets/ID        a finished asset; it never changes, so that whoever has the folder has it
captures/ID      an upload, unpacked
clips/ID         a simulation
environments/NAME.exr
jobs/ID          a job's working folder as its last finished step left it: checkpoints, preview, log, results. Any worker goes on from there

An artifact is in the store before a row of the database speaks of it. The data folder is a cache: what is missing in it is fetched, and may be
deleted while nobody works with it.
"""

import os
import re
import shutil
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TypeVar

from sqlalchemy import Engine, select
from sqlalchemy.orm import Session

from drgs.scene.edits import Edit, EnvironmentEdit, PoseEdit
from worker.artifact_store import ArtifactMissing, StoreAway
from worker.builders import BuildStopped
from worker.data_directory import DataDirectory, try_lock_file
from worker.database import AssetRow, JobRow

Result = TypeVar("Result")
_UPLOAD = re.compile(r"[0-9a-f]{32}")

OUTAGE_SECONDS = 120.0
"""How long a worker waits for a store that is away; then its job fails with a sentence and can be retried."""
OUTAGE_POLL_SECONDS = 1.0
CACHE_SECONDS = 3600.0
"""What is younger is not cleared away: its row may be about to come."""
KNOWN = ".stored"
"""In a job's folder: digest of the manifest that it was last the same as."""
RUN_LOCK = ".lock"
"""In a job's folder: held while a step runs in it."""


def bring_asset(directory: DataDirectory, asset_id: str) -> Path:
    """Its folder, fetched if it is not here.

    Raises:
        StoreAway, ArtifactMissing, ArtifactDamaged: a sentence.
    """
    return _bring(directory, "assets", asset_id, directory.asset(asset_id))


def bring_clip(directory: DataDirectory, clip: str) -> Path:
    """The folder of what a `pose` edit calls `clips/ID`; raises like bring_asset."""
    job_id = clip.rpartition("/")[2]
    directory.clip(job_id).parent.mkdir(mode=0o700, exist_ok=True)
    return _bring(directory, "clips", job_id, directory.clip(job_id))


def has_clip(directory: DataDirectory, clip: str) -> bool:
    """Whether there is one, here after this call.

    Raises:
        StoreAway, ArtifactDamaged: a sentence.
    """
    try:
        return (bring_clip(directory, clip) / "clip.json").is_file()
    except ArtifactMissing:
        return False


def bring_environment(directory: DataDirectory, name: str) -> Path:
    """The EXR file; raises like bring_asset."""
    return _bring(directory, "environments", name, directory.environments / name)


def bring_edit_files(directory: DataDirectory, edits: Iterable[Edit]) -> None:
    """What edits name; raises like bring_asset."""
    if directory.store is None:
        return
    for edit in edits:
        if isinstance(edit, EnvironmentEdit) and edit.file is not None:
            bring_environment(directory, edit.file)
        elif isinstance(edit, PoseEdit):
            bring_clip(directory, edit.clip)


def bring_capture(directory: DataDirectory, dataset: Path) -> Path:
    """The capture's folder on this machine, which may have its data folder elsewhere than the one that took the upload; raises like bring_asset."""
    if directory.store is None or dataset.is_dir() or "uploads" not in dataset.parts:
        return dataset
    below = dataset.parts[len(dataset.parts) - dataset.parts[::-1].index("uploads") :]
    if not below or not _UPLOAD.fullmatch(below[0]):
        return dataset  # a folder of a capture root that is called so
    _bring(directory, "captures", below[0], directory.uploads / below[0])
    return directory.uploads.joinpath(*below)


def _bring(directory: DataDirectory, kind: str, id: str, place: Path) -> Path:
    if directory.store is not None and not place.exists():
        directory.store.get(kind, id, place)
    return place


def keep(directory: DataDirectory, kind: str, id: str, place: Path) -> None:
    """Share a finished folder or file.

    Raises:
        StoreAway: a sentence; it is not shared.
    """
    if directory.store is not None:
        directory.store.put(kind, id, place)


def drop(directory: DataDirectory, kind: str, id: str) -> None:
    """Share it no longer.

    Raises:
        StoreAway: a sentence; call it again.
    """
    if directory.store is not None:
        directory.store.delete(kind, id)


def patiently(work: Callable[[], Result], should_stop: Callable[[], bool], patience_seconds: float = OUTAGE_SECONDS) -> Result:
    """Do it again while the store is away.

    Raises:
        BuildStopped: should_stop() was true.
        StoreAway: it did not come back in all that time.
    """
    give_up_at = time.monotonic() + patience_seconds
    while True:
        try:
            return work()
        except StoreAway:
            if should_stop():
                raise BuildStopped from None
            if time.monotonic() > give_up_at:
                raise
            time.sleep(OUTAGE_POLL_SECONDS)


def bring_job(directory: DataDirectory, job_id: str) -> None:
    """Make a job's folder what its last finished step left, if that was on another machine. For who holds the folder's RUN_LOCK.

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
        return  # what is here is that, or has come further since
    directory.store.update("jobs", job_id, folder, manifest, _is_own)
    known.write_text(manifest.digest)


def keep_job(directory: DataDirectory, job_id: str) -> None:
    """Share a job's folder as a finished step left it.

    Raises:
        StoreAway: a sentence.
    """
    if directory.store is not None:
        folder = directory.job(job_id)
        manifest = directory.store.put("jobs", job_id, folder, _is_own)
        (folder / KNOWN).write_text(manifest.digest)


def refresh_job(directory: DataDirectory, job_id: str) -> None:
    """`bring_job` for readers: does nothing while a step runs in the folder on this machine.

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
            bring_job(directory, job_id)
        finally:
            os.close(lock)


def clear_cache(directory: DataDirectory, engine: Engine) -> int:
    """Remove from this machine what was deleted on another one. Returns how many folders.

    Raises:
        StoreAway: a sentence.
    """
    if directory.store is None:
        return 0
    with Session(engine) as session:
        assets, jobs = (set(session.scalars(select(table.id))) for table in (AssetRow, JobRow))
    old, removed = time.time() - CACHE_SECONDS, 0
    clips = directory.environments / "clips"
    for kind, folder, known in (
        ("assets", directory.assets, assets),
        ("captures", directory.uploads, jobs),
        ("jobs", directory.jobs, jobs),
        ("clips", clips, jobs),
    ):
        for path in folder.iterdir() if folder.is_dir() else ():
            if path.name.startswith(".") or path.name in known or path.stat().st_mtime > old or directory.store.has(kind, path.name):
                continue
            shutil.rmtree(path, ignore_errors=True)
            removed += 1
    return removed


def _is_own(path: str) -> bool:
    """Of this machine alone: locks, drafts and what is half written."""
    name = path.rpartition("/")[2]
    return name.startswith((".", "draft-")) or name.endswith((".part", ".new"))
