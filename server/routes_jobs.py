"""REST: builds."""

import shutil
import uuid
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends, Header, Query, Request
from fastapi.responses import FileResponse
from pydantic import ValidationError
from sqlalchemy import func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from server.answers import job_info, job_infos
from server.context import ServerContext, context_of
from server.problems import ProblemError
from server.rest_records import BuildRequest, JobInfo, JobList
from server.uploads import receive_upload
from server.zip_guard import single_folder, unpack_zip
from worker.database import JobRow, now
from worker.queue import JobNotInState

router = APIRouter(prefix="/api/jobs", tags=["jobs"])

Context = Annotated[ServerContext, Depends(context_of)]
IdempotencyKey = Annotated[str | None, Header(max_length=200)]

_BODY = {
    "requestBody": {
        "content": {
            "application/json": {"schema": BuildRequest.model_json_schema(), "example": {"dataset": "sample", "preset": "draft"}},
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {
                        "file": {"type": "string", "format": "binary", "description": "Zip of a capture."},
                        "name": {"type": "string"},
                        "preset": {"type": "string", "enum": ["draft", "fast", "full"]},
                        "seed": {"type": "integer"},
                    },
                }
            },
        }
    }
}


@router.post("", status_code=202, openapi_extra=_BODY)
async def start_job(request: Request, context: Context, idempotency_key: IdempotencyKey = None) -> JobInfo:
    """Build an asset from a capture: a zip (multipart), the bundled sample, or a folder below an allowed root."""
    known = await run_in_threadpool(_job_of_key, context, idempotency_key)
    if known is not None:
        return await run_in_threadpool(_read_job, context, known)
    if await run_in_threadpool(context.queue.active_count) >= context.settings.limits.active_jobs:
        raise ProblemError(429, f"{context.settings.limits.active_jobs} jobs wait or run already; try again when one is over.")
    job_id = uuid.uuid4().hex
    if request.headers.get("content-type", "").startswith("multipart/form-data"):
        asked, folder = await _receive_capture(request, context, job_id)
    else:
        try:
            asked = BuildRequest.model_validate_json(await request.body())
        except ValidationError as error:
            raise _invalid(error) from error
        folder = await run_in_threadpool(_find_capture, context, asked.dataset)
    row = JobRow(
        id=job_id,
        kind="build",
        name=asked.name or (folder.name if asked.dataset != "sample" else "Sample"),
        dataset=str(folder),
        preset=asked.preset,
        seed=asked.seed,
        idempotency_key=idempotency_key,
        created_at=now(),
    )
    try:
        await run_in_threadpool(context.queue.submit, row)
    except IntegrityError:  # the same key, a moment earlier
        shutil.rmtree(context.directory.uploads / job_id, ignore_errors=True)
        known = await run_in_threadpool(_job_of_key, context, idempotency_key)
        job_id = known or job_id
    return await run_in_threadpool(_read_job, context, job_id)


async def _receive_capture(request: Request, context: ServerContext, job_id: str) -> tuple[BuildRequest, Path]:
    upload = await receive_upload(request, {".zip"})
    try:
        fields = {"dataset": "upload", "name": upload.field("name") or upload.stem, **upload.given("preset", "seed")}
        asked = BuildRequest.model_validate(fields)
        target = context.directory.uploads / job_id
        await run_in_threadpool(unpack_zip, upload.stream, target)
    except ValidationError as error:
        raise _invalid(error) from error
    except ValueError as error:
        raise ProblemError(422, str(error)) from error
    finally:
        await upload.close()
    return asked, single_folder(target)


def _find_capture(context: ServerContext, dataset: str) -> Path:
    if dataset == "sample":
        if not context.settings.sample_capture.is_dir():
            raise ProblemError(404, "This installation has no sample capture.")
        return context.settings.sample_capture.resolve()
    folder = Path(dataset).expanduser().resolve()
    if not any(folder.is_relative_to(root.resolve()) for root in context.settings.capture_roots):
        raise ProblemError(403, "This folder is not below one that the server was started with (--captures); upload a zip instead.")
    if not folder.is_dir():
        raise ProblemError(404, "There is no such folder.")
    return folder


def _invalid(error: ValidationError) -> ProblemError:
    first = error.errors(include_url=False)[0]
    return ProblemError(422, f"{'.'.join(str(part) for part in first['loc']) or 'body'}: {first['msg']}.")


def _job_of_key(context: ServerContext, key: str | None) -> str | None:
    if key is None:
        return None
    with Session(context.engine) as session:
        return session.scalar(select(JobRow.id).where(JobRow.idempotency_key == key))


def _read_row(context: ServerContext, job_id: str) -> JobRow:
    with Session(context.engine) as session:
        row = session.get(JobRow, job_id)
    if row is None:
        raise ProblemError(404, f"No job has the id {job_id[:64]!r}.")
    return row


def _read_job(context: ServerContext, job_id: str) -> JobInfo:
    row = _read_row(context, job_id)
    return job_info(row, context.queue.statuses([job_id])[job_id])


@router.get("")
def list_jobs(
    context: Context, limit: Annotated[int, Query(ge=1, le=500)] = 50, offset: Annotated[int, Query(ge=0, le=1_000_000)] = 0
) -> JobList:
    """Newest first."""
    with Session(context.engine) as session:
        rows = session.scalars(select(JobRow).order_by(JobRow.created_at.desc()).limit(limit).offset(offset)).all()
        total = session.scalar(select(func.count()).select_from(JobRow)) or 0
    jobs = job_infos(rows, context.queue.statuses(row.id for row in rows))
    return JobList(jobs=jobs, total=total, workers_alive=len(context.queue.alive_workers()))


@router.get("/{job_id}")
def read_job(job_id: str, context: Context) -> JobInfo:
    return _read_job(context, job_id)


@router.get("/{job_id}/preview.jpg")
def read_preview(job_id: str, context: Context) -> FileResponse:
    """Newest picture of the fit."""
    path = context.directory.preview(_read_row(context, job_id).id)
    if not path.is_file():
        raise ProblemError(404, "This job has no preview yet.")
    return FileResponse(path, media_type="image/jpeg")


@router.post("/{job_id}/cancel")
def cancel_job(job_id: str, context: Context) -> JobInfo:
    """Ends a job that waits or runs; its checkpoint stays, so that it can be retried."""
    return _change(context, job_id, "cancel")


@router.post("/{job_id}/retry")
def retry_job(job_id: str, context: Context) -> JobInfo:
    """Starts a failed or cancelled job again, from its checkpoint."""
    return _change(context, job_id, "retry")


@router.post("/{job_id}/resume")
def resume_job(job_id: str, context: Context) -> JobInfo:
    """Hands a job whose worker died to a living worker."""
    return _change(context, job_id, "resume")


def _change(context: ServerContext, job_id: str, verb: str) -> JobInfo:
    _read_row(context, job_id)
    try:
        getattr(context.queue, verb)(job_id)
    except JobNotInState as error:
        raise ProblemError(409, str(error)) from error
    return _read_job(context, job_id)
