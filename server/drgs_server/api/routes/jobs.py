"""REST: jobs of every kind, and what they made."""

import json
import mimetypes
import re
import shutil
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Header, Query, Request
from fastapi.responses import FileResponse, PlainTextResponse
from pydantic import ValidationError
from sqlalchemy import delete, func, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from drgs_server.api.answers import JOB_LIST_COLUMNS, job_info, job_infos
from drgs_server.api.context import ServerContext, context_of
from drgs_server.api.door.receive_upload import receive_upload
from drgs_server.api.door.zip_guard import single_folder, unpack_zip
from drgs_server.api.problems import ProblemError
from drgs_server.api.rest_records import BuildRequest, JobFile, JobFileList, JobInfo, JobList, PoseRequest
from drgs_server.api.routes.captures import CAPTURE_PREFIX, folder_of_capture
from drgs_worker.jobs.queue import JobNotInState, is_alive
from drgs_worker.jobs.requests import JOB_REQUESTS, OWN_LIGHT, ExportRequest, JobRequest, RedecoupleRequest, RenderRequest, SimulateRequest
from drgs_worker.store.artifact_store import StoreAway
from drgs_worker.store.artifacts import has_clip, refresh_job, share_artifact, unshare_artifact
from drgs_worker.store.database import AssetRow, CaptureRow, JobRow, now
from drgs_worker.store.user_names import name_from_file

router = APIRouter(prefix="/api/jobs", tags=["jobs"])

Context = Annotated[ServerContext, Depends(context_of)]
IdempotencyKey = Annotated[str | None, Header(max_length=200)]

_FILE_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,250}")
_EXAMPLES: dict[str, dict] = {
    "build": {"kind": "build", "dataset": "sample", "preset": "draft"},
    "pose": {"kind": "pose", "dataset": f"{CAPTURE_PREFIX}{'0' * 32}"},
    "redecouple": {"kind": "redecouple", "asset": "0" * 32, "preset": "full"},
    "simulate": {"kind": "simulate", "asset": "0" * 32, "scene": {"matter": {"preset": "jelly"}, "duration": 2}},
    "render": {
        "kind": "render",
        "asset": "0" * 32,
        "turntable": {"frames": 48},
        "environments": ["studio.exr", "own"],
        "variants": [{"name": "rough", "edits": [{"op": "material", "select": {"all": True}, "set": {"roughness": 0.8}}]}],
        "video_fps": 24,
    },
    "export": {"kind": "export", "asset": "0" * 32, "formats": ["glb", "ply"]},
}


def _self_contained(schema: dict) -> dict:
    """A JSON schema with its definitions written out where they are used, since OpenAPI has another place for them."""
    definitions = schema.pop("$defs", {})

    def written_out(node: Any) -> Any:
        if isinstance(node, dict):
            if "$ref" in node:
                return written_out(definitions[node["$ref"].rsplit("/", 1)[1]])
            return {key: written_out(value) for key, value in node.items() if key != "discriminator"}
        return [written_out(value) for value in node] if isinstance(node, list) else node

    return written_out(schema)


_BODY: dict[str, Any] = {
    "requestBody": {
        "required": True,
        "content": {
            "application/json": {
                "schema": {"oneOf": [_self_contained(request.model_json_schema()) for request in JOB_REQUESTS.values()]},
                "examples": {kind: {"value": value} for kind, value in _EXAMPLES.items()},
            },
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {
                        "file": {"type": "string", "format": "binary", "description": "Zip of a capture."},
                        "name": {"type": "string"},
                        "preset": {"type": "string", "enum": ["draft", "fast", "full"]},
                        "binding": {"type": "string", "enum": ["particles", "mesh"]},
                        "light": {"type": "string", "enum": ["auto", "object", "camera"]},
                        "masks": {"type": "string", "enum": ["auto", "given"]},
                        "cameras": {"type": "string", "enum": ["auto", "given"]},
                        "seed": {"type": "integer"},
                    },
                }
            },
        },
    }
}


@router.post("", status_code=202, openapi_extra=_BODY)
async def start_job(request: Request, context: Context, idempotency_key: IdempotencyKey = None) -> JobInfo:
    """Build an asset from a capture (an uploaded one, a zip as multipart, the bundled sample, or a folder below an allowed root), or find the poses of
    its photographs; re-decouple, simulate, render or export an asset. Without `kind` it is a build. The same Idempotency-Key gives the same job, whatever else the request says."""
    known = await run_in_threadpool(_job_of_key, context, idempotency_key)
    if known is not None:
        return await run_in_threadpool(_read_job, context, known)
    if await run_in_threadpool(context.queue.active_count) >= context.settings.limits.active_jobs:
        raise ProblemError(429, f"{context.settings.limits.active_jobs} jobs wait or run already; try again when one is over.")
    job_id = uuid.uuid4().hex
    if request.headers.get("content-type", "").startswith("multipart/form-data"):
        build, folder = await _receive_capture(request, context, job_id)
        row = _build_row(job_id, build, folder)
    else:
        row = await run_in_threadpool(_row_of, context, job_id, _parse_request(await request.body()))
    row.idempotency_key = idempotency_key
    if row.kind == "build":
        context.sessions.prepare_soon()
    try:
        await run_in_threadpool(context.queue.submit, row)
    except IntegrityError:  # the same key, a moment earlier
        shutil.rmtree(context.directory.uploads / job_id, ignore_errors=True)
        await run_in_threadpool(unshare_artifact, context.directory, "captures", job_id)
        known = await run_in_threadpool(_job_of_key, context, idempotency_key)
        job_id = known or job_id
    return await run_in_threadpool(_read_job, context, job_id)


def _parse_request(body: bytes) -> JobRequest:
    try:
        document = json.loads(body)
    except (ValueError, RecursionError) as error:
        raise ProblemError(422, f"body: expected a JSON object; {error}") from error
    kind = document.get("kind", "build") if isinstance(document, dict) else "build"
    if not isinstance(kind, str) or kind not in JOB_REQUESTS:
        raise ProblemError(422, f"kind: expected one of {', '.join(JOB_REQUESTS)}; found {str(kind)[:40]!r}")
    try:
        return JOB_REQUESTS[kind].model_validate_json(body)
    except ValidationError as error:
        raise _invalid(error) from error


def _build_row(job_id: str, asked: BuildRequest | PoseRequest, folder: Path) -> JobRow:
    """Of a job that reads a capture."""
    row = _plain_row(job_id, asked, asked.name or (name_from_file(folder.name, "Capture") if asked.dataset != "sample" else "Sample"))
    row.dataset, row.seed = str(folder), asked.seed
    if isinstance(asked, BuildRequest):
        row.preset = asked.preset
    return row


def _plain_row(job_id: str, asked: JobRequest, name: str) -> JobRow:
    parameters = asked.model_dump(mode="json", exclude_none=True)
    return JobRow(
        id=job_id,
        kind=asked.kind,
        name=name,
        dataset="",
        preset="",
        seed=0,
        parameters=parameters,
        priority=asked.priority,
        created_at=now(),
    )


def _row_of(context: ServerContext, job_id: str, asked: JobRequest) -> JobRow:
    """The job of a request that was not an upload, with all that it names looked up."""
    if isinstance(asked, BuildRequest | PoseRequest):
        if asked.dataset.startswith(CAPTURE_PREFIX):
            folder, name = folder_of_capture(context, asked.dataset.removeprefix(CAPTURE_PREFIX))
            return _build_row(job_id, asked.model_copy(update={"name": asked.name or name}), folder)
        return _build_row(job_id, asked, _find_capture(context, asked.dataset))
    with Session(context.engine) as session:
        asset = session.get(AssetRow, asked.asset)
        built = session.get(JobRow, asked.asset)
    if asset is None or asset.deleted_at is not None:
        raise ProblemError(404, f"No asset has the id {asked.asset[:64]!r}.")
    row = _plain_row(job_id, asked, asked.name or asset.name)
    if isinstance(asked, RedecoupleRequest):
        if built is None:
            raise ProblemError(409, "Only an asset that was built here can be re-decoupled, since that needs its capture and geometry.")
        row.dataset, row.preset, row.seed = built.dataset, asked.preset, built.seed
        built_preset = built.parameters.get("built_preset", built.preset)
        kept = {"binding": built.parameters.get("binding", "particles"), "light": built.parameters.get("light", "auto")}
        kept |= {name: built.parameters[name] for name in ("masks", "cameras", "up", "box", "strokes") if name in built.parameters}
        row.parameters = row.parameters | {"built_preset": built_preset, "built_seed": built.seed} | kept
    elif isinstance(asked, SimulateRequest):
        from drgs.deform.matter.simulation_scene import parse_simulation_scene

        try:
            parse_simulation_scene(asked.scene)
        except ValueError as error:
            raise ProblemError(422, str(error)) from error
    elif isinstance(asked, RenderRequest):
        _check_render(context, asked)
    elif isinstance(asked, ExportRequest):
        for variant in asked.variants:
            for edit in variant.edits:
                context.sessions.references.check(edit)
    return row


def _check_render(context: ServerContext, asked: RenderRequest) -> None:
    for name in asked.environments:
        if name != OWN_LIGHT and not context.environments.has(name):
            raise ProblemError(422, f"No environment is called {name!r}; GET /api/environments lists them.")
    for variant in asked.variants:
        for edit in variant.edits:
            context.sessions.references.check(edit)
    if asked.clip is not None and not has_clip(context.directory, asked.clip):
        raise ProblemError(422, f"There is no clip {asked.clip}; a simulate job that is done names its clip.")


async def _receive_capture(request: Request, context: ServerContext, job_id: str) -> tuple[BuildRequest, Path]:
    upload = await receive_upload(request, {".zip"})
    try:
        fields = {"dataset": "upload", "name": upload.name(), **upload.given("preset", "binding", "light", "masks", "cameras", "seed")}
        asked = BuildRequest.model_validate(fields)
        draft, target = context.scratch.folder / job_id, context.directory.uploads / job_id
        await run_in_threadpool(unpack_zip, upload.stream, draft)
        try:
            await run_in_threadpool(share_artifact, context.directory, "captures", job_id, draft)
            draft.rename(target)
        except (StoreAway, OSError):
            shutil.rmtree(draft, ignore_errors=True)
            raise
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
    try:
        folder = Path(dataset).expanduser().resolve()
        is_allowed = any(folder.is_relative_to(root.resolve()) for root in context.settings.capture_roots)
        is_there = is_allowed and folder.is_dir()
    except (OSError, RuntimeError):  # too long a name, links in a circle, the home of nobody
        is_allowed = is_there = False
    if not is_allowed:
        raise ProblemError(403, "This folder is not below one that the server was started with (--captures); upload a zip instead.")
    if not is_there:
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
    # The state first: a job that is done has written the rest before.
    status = context.queue.statuses([job_id])[job_id]
    return job_info(_read_row(context, job_id), status)


@router.get("")
def list_jobs(
    context: Context, limit: Annotated[int, Query(ge=1, le=500)] = 50, offset: Annotated[int, Query(ge=0, le=1_000_000)] = 0
) -> JobList:
    """Newest first."""
    with Session(context.engine) as session:
        rows = session.execute(select(*JOB_LIST_COLUMNS).order_by(JobRow.created_at.desc()).limit(limit).offset(offset)).all()
        # A page behind the last one has no row that says it.
        total = rows[0].total if rows else session.scalar(select(func.count()).select_from(JobRow)) or 0
    workers = context.queue.workers()
    jobs = job_infos(rows, context.queue.statuses((row.id for row in rows), workers))
    return JobList(jobs=jobs, total=total, workers_alive=sum(map(is_alive, workers)))


@router.get("/{job_id}")
def read_job(job_id: str, context: Context) -> JobInfo:
    return _read_job(context, job_id)


@router.get("/{job_id}/preview.jpg")
def read_preview(job_id: str, context: Context) -> FileResponse:
    """Newest picture of the fit."""
    path = context.directory.preview(_read_row(context, job_id).id)
    refresh_job(context.directory, job_id)
    if not path.is_file():
        raise ProblemError(404, "This job has no preview yet.")
    return FileResponse(path, media_type="image/jpeg")


@router.get("/{job_id}/log")
def read_log(job_id: str, context: Context) -> PlainTextResponse:
    """When each step started and finished, a line each."""
    path = context.directory.job_log(_read_row(context, job_id).id)
    refresh_job(context.directory, job_id)
    return PlainTextResponse(path.read_text() if path.is_file() else "")


@router.get("/{job_id}/files")
def list_files(job_id: str, context: Context) -> JobFileList:
    """What a render or an export has made so far."""
    folder = context.directory.job_files(_read_row(context, job_id).id)
    refresh_job(context.directory, job_id)
    found = sorted(path for path in folder.iterdir() if path.suffix != ".part") if folder.is_dir() else []
    found = [path for path in found if not path.name.startswith("draft-")]
    return JobFileList(files=[JobFile(name=path.name, bytes=path.stat().st_size, media_type=_media_type(path.name)) for path in found])


@router.get("/{job_id}/files/{name}")
def read_file(job_id: str, name: str, context: Context) -> FileResponse:
    """One of them; ranges are answered."""
    folder = context.directory.job_files(_read_row(context, job_id).id)
    refresh_job(context.directory, job_id)
    if not _FILE_NAME.fullmatch(name) or not (folder / name).is_file():
        raise ProblemError(404, f"This job has no file {name[:100]!r}.")
    return FileResponse(folder / name, media_type=_media_type(name), filename=name)


def _media_type(name: str) -> str:
    return mimetypes.guess_type(name)[0] or "application/octet-stream"


@router.delete("/{job_id}", status_code=204)
def delete_job(job_id: str, context: Context) -> None:
    """Forgets a job that is over, with its files, clip, checkpoint and the capture that came with it; an asset or a capture that it made stays."""
    row = _read_row(context, job_id)
    state = context.queue.statuses([job_id])[job_id].state
    if state not in ("done", "failed", "cancelled", "unknown"):
        raise ProblemError(409, f"This job is {state}; cancel it first.")
    _check_unused(context, row)
    with Session(context.engine) as session:
        made_capture = session.get(CaptureRow, row.id) is not None
    for kind in ("jobs", "clips", *(() if made_capture else ("captures",))):
        unshare_artifact(context.directory, kind, row.id)
    with Session(context.engine) as session, session.begin():
        session.execute(delete(JobRow).where(JobRow.id == row.id))
    capture = () if made_capture else (context.directory.uploads / row.id,)
    for folder in (context.directory.job(row.id), context.directory.clip(row.id), context.directory.growing_clip(row.id), *capture):
        shutil.rmtree(folder, ignore_errors=True)


def _check_unused(context: ServerContext, row: JobRow) -> None:
    """What this job made or was given belongs to whoever refers to it.

    Raises:
        ProblemError: 409 that names who does.
    """
    clip = f"clips/{row.id}"
    sessions = context.sessions.naming_clip(clip) if row.kind == "simulate" else []
    if sessions:
        raise ProblemError(
            409,
            f"The session {sessions[0]}{_and_others(sessions)} shows this job's clip, or may by undo, redo or a snapshot; delete the session first.",
        )
    with Session(context.engine) as session:
        others = session.scalars(select(JobRow).where(JobRow.finished_at.is_(None), JobRow.id != row.id)).all()
    needing = [job.id for job in others if (job.kind == "redecouple" and job.source_asset == row.id) or clip in json.dumps(job.parameters)]
    states = context.queue.statuses(needing)
    active = [job_id for job_id in needing if states[job_id].state in ("queued", "running", "stalled")]
    if active:
        raise ProblemError(409, f"The job {active[0]}{_and_others(active)} needs what this one made; cancel it, or wait for its end.")


def _and_others(ids: Sequence[str]) -> str:
    return f" (and {len(ids) - 1} more)" if len(ids) > 1 else ""


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
