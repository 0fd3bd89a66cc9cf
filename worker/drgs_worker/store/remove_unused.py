"""What nobody refers to any more is removed: painted weights, the kept poses of sessions that are gone, and captures that nothing is built from.

Never what a session, a snapshot, a version or a job names: an event of a session's log counts even where undo has left it behind, and what is
younger than a day stays, for the edit that names it may still be on its way.
"""

import re
import shutil
import time
from pathlib import Path

from sqlalchemy import ColumnElement, Engine, String, cast, delete, select
from sqlalchemy.orm import InstrumentedAttribute, Session

from drgs_worker.store.artifacts import WEIGHTS, unshare_artifact
from drgs_worker.store.data_directory import DataDirectory
from drgs_worker.store.database import AssetRow, CaptureRow, JobRow, SessionEventRow, SessionRow, SnapshotRow

UNUSED_SECONDS = 24 * 3600.0
"""Since weights were sent or named last, after which they are removed if nothing names them."""
NAMING: tuple[InstrumentedAttribute, ...] = (SessionEventRow.edit, SnapshotRow.edits, AssetRow.edits, JobRow.parameters)
"""Columns that hold edits."""
_NAMED = re.compile(rf"{WEIGHTS}\\?/([0-9a-f]{{32}}\.f32)")


def remove_unused_weights(directory: DataDirectory, engine: Engine) -> int:
    """Returns how many. Where machines share a store nothing is removed: another machine may be about to name what this one finds unused."""
    folder, before = directory.environments / WEIGHTS, time.time() - UNUSED_SECONDS
    old = [path for path in folder.glob("*.f32") if _used_at(path) < before]
    if not old or directory.store is not None:
        return 0
    named = _named_weights(engine)
    # Who names weights marks them first; looked at once more, since reading the database takes a while.
    unused = [path for path in old if path.name not in named and _used_at(path) < before]
    for path in unused:
        path.unlink(missing_ok=True)
    return len(unused)


def _used_at(weights: Path) -> float:
    """When they were sent or named last; now where they are gone."""
    try:
        state = weights.stat()
    except FileNotFoundError:
        return time.time()
    return max(state.st_atime, state.st_mtime)


def _named_weights(engine: Engine) -> set[str]:
    found: set[str] = set()
    with Session(engine) as session:
        for column in NAMING:
            text: ColumnElement[str] = cast(column, String)
            for said in session.scalars(select(text).where(text.contains(WEIGHTS))).yield_per(100):
                found.update(_NAMED.findall(said))
    return found


def remove_unused_poses(directory: DataDirectory, engine: Engine) -> int:
    """Kept poses of sessions that are no more. Returns how many."""
    kept = list(
        directory.poses.glob("*.safetensors")
    )  # before the sessions are read: a file of one that begins meanwhile is not among them
    with Session(engine) as session:
        there = set(session.scalars(select(SessionRow.id)))
    gone = [path for path in kept if path.stem not in there]
    for path in gone:
        path.unlink(missing_ok=True)
    return len(gone)


def remove_unused_captures(directory: DataDirectory, engine: Engine, keep_seconds: float) -> int:
    """Captures that came longer ago and that no job refers to. Returns how many."""
    with Session(engine) as session:
        old = session.scalars(select(CaptureRow.id).where(CaptureRow.created_at < time.time() - keep_seconds)).all()
        unused = [capture_id for capture_id in old if not jobs_of_capture(session, capture_id)]
    for capture_id in unused:
        remove_capture(directory, engine, capture_id)
    return len(unused)


def jobs_of_capture(session: Session, capture_id: str) -> list[str]:
    """Ids of the builds, re-decouplings and searches for poses that read this capture."""
    return list(session.scalars(select(JobRow.id).where(JobRow.dataset.contains(f"/uploads/{capture_id}"))))


def remove_capture(directory: DataDirectory, engine: Engine, capture_id: str) -> None:
    """Its row last: what is left half done is done again.

    Raises:
        StoreAway: a sentence.
    """
    unshare_artifact(directory, "captures", capture_id)
    for folder in (directory.uploads / capture_id, directory.look(capture_id)):
        shutil.rmtree(folder, ignore_errors=True)
    with Session(engine) as session, session.begin():
        session.execute(delete(CaptureRow).where(CaptureRow.id == capture_id))
