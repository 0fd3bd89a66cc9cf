"""Rows of the database as REST answers."""

from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from sqlalchemy import Row, func

from drgs.reconstruct.progress import TOLD
from drgs.scene.edits import parse_kept_edits
from drgs_server.api.rest_records import AssetInfo, JobInfo, SessionInfo, SnapshotInfo
from drgs_server.live.live_session import LiveSession
from drgs_worker.jobs.capture_report import CaptureReport
from drgs_worker.jobs.queue import JobStatus
from drgs_worker.store.database import AssetRow, JobRow, SnapshotRow


def _time(seconds: float) -> datetime:
    return datetime.fromtimestamp(seconds, UTC)


JOB_LIST_COLUMNS = (
    *(column for column in JobRow.__table__.columns if column.name not in ("parameters", "dataset")),
    JobRow.parameters["asset"].as_string().label("source_asset"),
    func.count().over().label("total"),
)
"""What `job_info` reads of a job, and how many there are on all pages. Plain rows of these cost a list of 500 a sixth of what objects with their requests do."""


def job_info(row: JobRow | Row, status: JobStatus) -> JobInfo:
    """What is stored of a job and what the queue says of it.

    Args:
        row: the job, or a row of JOB_LIST_COLUMNS.
    """
    error = row.error
    if status.state == "failed" and error is None:
        error = "The job failed without a word."
    return JobInfo(
        id=row.id,
        kind=row.kind,  # type: ignore[arg-type]
        name=row.name,
        preset=row.preset,
        priority=row.priority,
        state=status.state,  # type: ignore[arg-type]
        created_at=_time(row.created_at),
        finished_at=_time(row.finished_at) if row.finished_at is not None else None,
        **{name: getattr(row, name) for name in TOLD} | ({} if status.state == "running" else {"eta_seconds": None}),
        attempts=row.attempts,
        asset_id=row.asset_id if status.state == "done" else None,
        source_asset=row.source_asset,
        capture_id=row.id if row.kind == "pose" and status.state == "done" else None,
        clip=f"clips/{row.id}" if row.kind == "simulate" and status.state == "done" else None,
        error=error if status.state == "failed" else None,
        capture=CaptureReport.model_validate(row.capture_report) if row.capture_report is not None else None,
        preview_version=row.preview_version,
    )


def job_infos(rows: Sequence[Row], statuses: dict[str, JobStatus]) -> list[JobInfo]:
    return [job_info(row, statuses[row.id]) for row in rows]


def asset_info(row: AssetRow, folder: Path) -> AssetInfo:
    return AssetInfo(
        id=row.id,
        name=row.name,
        created_at=_time(row.created_at),
        bytes=row.bytes,
        source=row.source,
        surfel_count=row.surfel_count,
        vertex_count=row.vertex_count,
        face_count=row.face_count,
        has_thumbnail=(folder / "thumb.jpg").is_file(),
        version=row.version,
        parent_id=row.parent_id,
        edits=parse_kept_edits(row.edits),
        deleted_at=_time(row.deleted_at) if row.deleted_at is not None else None,
    )


def snapshot_info(row: SnapshotRow) -> SnapshotInfo:
    return SnapshotInfo(name=row.name, created_at=_time(row.created_at), revision=row.revision, edits=parse_kept_edits(row.edits))


def session_info(session: LiveSession) -> SessionInfo:
    log = session.log.message()
    return SessionInfo(
        id=session.id,
        asset=session.asset_id,
        asset_name=session.asset_name,
        created_at=_time(session.created_at),
        revision=log.revision,
        edits=log.edits,
        can_undo=log.can_undo,
        can_redo=log.can_redo,
        appended=log.appended,
        undone=log.undone,
        broken=log.broken,
        viewers=len(session.viewers),
    )
