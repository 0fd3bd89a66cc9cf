"""REST: captures that were uploaded before anything is built of them. A build names one as `capture:ID`, and any number of builds may."""

import hashlib
import json
import re
import shutil
import tempfile
import uuid
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi import Path as PathParameter
from fastapi.responses import FileResponse
from sqlalchemy import func, select
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool

from drgs_server.api.context import ServerContext, caller_of, context_of
from drgs_server.api.door.incoming import Incoming
from drgs_server.api.door.while_connected import while_connected
from drgs_server.api.door.zip_guard import single_folder, unpack_zip
from drgs_server.api.problems import ProblemError
from drgs_server.api.rest_records import CaptureInfo, CaptureList, CaptureLook, CaptureMasks, CaptureRequest, MasksRequest
from drgs_server.live.admission import Caller
from drgs_worker.jobs.file_tool import LOOK_NAME, MASKS_NAME, SHEET_NAME, FileToolError, look_bytes, masks_bytes, run_file_tool
from drgs_worker.store.artifacts import fetch_capture, share_artifact
from drgs_worker.store.database import CaptureRow, now
from drgs_worker.store.remove_unused import jobs_of_capture, remove_capture

CAPTURE_PREFIX = "capture:"
"""Of a build's `dataset`."""
PICTURES, MASKS = "pictures", "masks"
"""Folders beside what is kept of a look."""
KEPT_MASKS = 4
"""Sheets of masks of one capture; the oldest go."""
_VERSION = re.compile(r"[0-9a-f]{32}")

router = APIRouter(prefix="/api/captures", tags=["captures"])

Context = Annotated[ServerContext, Depends(context_of)]


@router.post("", status_code=201)
async def make_capture(body: CaptureRequest, context: Context) -> CaptureInfo:
    """Unpack a complete upload (POST /api/uploads), a zip of a capture. The capture has the upload's id, and asking again gives the same one."""
    async with context.incoming.alone(body.upload):
        return await run_in_threadpool(_unpacked, context, body)


def _unpacked(context: ServerContext, asked: CaptureRequest) -> CaptureInfo:
    with Session(context.engine) as session:
        known = session.get(CaptureRow, asked.upload)
    if known is not None:
        context.incoming.remove(known.id)
        return _info(context, known)
    incoming = context.incoming.read(asked.upload)
    if incoming.offset < incoming.length:
        raise ProblemError(409, f"{incoming.offset} of {incoming.length} bytes of this upload have come; send the rest first.")
    folder = _unpack(context, incoming)
    row = CaptureRow(id=incoming.id, name=asked.name or incoming.name, created_at=now(), folder=folder)
    with Session(context.engine, expire_on_commit=False) as session, session.begin():
        session.add(row)
    context.incoming.remove(incoming.id)
    return _info(context, row)


def _unpack(context: ServerContext, incoming: Incoming) -> str:
    """Where the capture's files lie below the folder of uploads. What cannot be unpacked is forgotten: sent on, it would be no better."""
    draft, target = context.scratch.folder / f"capture-{uuid.uuid4().hex}", context.directory.uploads / incoming.id
    try:
        with incoming.path.open("rb") as file:
            unpack_zip(file, draft)
    except ValueError as error:
        context.incoming.remove(incoming.id)
        raise ProblemError(422, str(error)) from error
    try:
        share_artifact(context.directory, "captures", incoming.id, draft)
        shutil.rmtree(target, ignore_errors=True)  # left by one that was cut off before its row
        draft.rename(target)
    finally:
        shutil.rmtree(draft, ignore_errors=True)
    return str(single_folder(target).relative_to(context.directory.uploads))


def _info(context: ServerContext, row: CaptureRow) -> CaptureInfo:
    with Session(context.engine) as session:
        jobs = jobs_of_capture(session, row.id)
    return CaptureInfo(id=row.id, name=row.name, created_at=datetime.fromtimestamp(row.created_at, UTC), jobs=jobs)


@router.get("")
def list_captures(
    context: Context, limit: Annotated[int, Query(ge=1, le=500)] = 50, offset: Annotated[int, Query(ge=0, le=1_000_000)] = 0
) -> CaptureList:
    """Newest first."""
    with Session(context.engine) as session:
        rows = session.scalars(select(CaptureRow).order_by(CaptureRow.created_at.desc()).limit(limit).offset(offset)).all()
        total = session.scalar(select(func.count()).select_from(CaptureRow)) or 0
    return CaptureList(captures=[_info(context, row) for row in rows], total=total)


@router.get("/{capture_id}")
def read_capture(capture_id: str, context: Context) -> CaptureInfo:
    return _info(context, _read_row(context, capture_id))


def _read_row(context: ServerContext, capture_id: str) -> CaptureRow:
    with Session(context.engine) as session:
        row = session.get(CaptureRow, capture_id)
    if row is None:
        raise ProblemError(404, f"No capture has the id {capture_id[:64]!r}.")
    return row


def folder_of_capture(context: ServerContext, capture_id: str) -> tuple[Path, str]:
    """Where its files lie on the machine that took it, and its name.

    Raises:
        ProblemError: 404.
    """
    row = _read_row(context, capture_id)
    return context.directory.uploads / row.folder, row.name


@router.get("/{capture_id}/look")
async def look_at_capture(capture_id: str, request: Request, context: Context) -> CaptureLook:
    """What the doctor says of it, its cameras, some points and the object's box. The first call takes seconds to minutes, in a process of its own; then
    the answer is kept."""
    folder = await _look(context, request, capture_id)
    return await run_in_threadpool(lambda: CaptureLook.model_validate_json((folder / LOOK_NAME).read_bytes()))


@router.get("/{capture_id}/sheet.jpg")
async def read_sheet(capture_id: str, request: Request, context: Context) -> FileResponse:
    """Its pictures, small, with the outlines of their masks and marks on those with findings."""
    sheet = await _look(context, request, capture_id) / SHEET_NAME
    if not sheet.is_file():
        raise ProblemError(404, "This capture has no pictures to show: it is a film, or holds none.")
    return FileResponse(sheet, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=86400, immutable"})


@router.get("/{capture_id}/pictures/{number}.jpg")
async def read_picture(
    capture_id: str, number: Annotated[int, PathParameter(ge=0, le=999)], request: Request, context: Context
) -> FileResponse:
    """A picture of a posed capture, without lens distortion, to draw strokes over. `number`: of the look's cameras; 404 where it has none. The first call takes seconds, in a process
    of its own; then all are kept."""
    look = await _look(context, request, capture_id)
    async with context.incoming.alone(capture_id):
        if not (look / PICTURES).is_dir():
            await while_connected(request, _make_beside(context, caller_of(request), capture_id, look / PICTURES, None))
    picture = look / PICTURES / f"{number}.jpg"
    if not picture.is_file():
        raise ProblemError(404, f"This capture has no picture number {number}.")
    return FileResponse(picture, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=86400, immutable"})


@router.post("/{capture_id}/masks")
async def find_masks(capture_id: str, body: MasksRequest, request: Request, context: Context) -> CaptureMasks:
    """What masks the strokes give, on a sheet of all pictures. Takes seconds to a minute, in a process of its own; nothing of the capture is changed."""
    strokes = json.dumps({"strokes": [stroke.model_dump(mode="json") for stroke in body.strokes]})
    version = hashlib.sha256(strokes.encode()).hexdigest()[:32]
    look = await _look(context, request, capture_id)
    async with context.incoming.alone(capture_id):
        place = look / MASKS / version
        if not place.is_dir():
            await while_connected(request, _make_beside(context, caller_of(request), capture_id, place, strokes))
            await run_in_threadpool(_forget_old_masks, place.parent)
        told = await run_in_threadpool((place / MASKS_NAME).read_text)
    return CaptureMasks.model_validate(json.loads(told) | {"version": version})


@router.get("/{capture_id}/masks/{version}.jpg")
def read_masks(capture_id: str, version: str, context: Context) -> FileResponse:
    """The sheet of masks that were found by strokes."""
    row = _read_row(context, capture_id)
    sheet = context.directory.look(row.id) / MASKS / version / SHEET_NAME
    if not _VERSION.fullmatch(version) or not sheet.is_file():
        raise ProblemError(404, "These masks are not kept any more; ask for them again by their strokes.")
    return FileResponse(sheet, media_type="image/jpeg", headers={"Cache-Control": "private, max-age=86400, immutable"})


async def _make_beside(context: ServerContext, caller: Caller, capture_id: str, place: Path, strokes: str | None) -> None:
    """The pictures of a capture, or its masks by strokes, beside what is kept of its look."""
    row = await run_in_threadpool(_read_row, context, capture_id)
    capture = await run_in_threadpool(fetch_capture, context.directory, context.directory.uploads / row.folder)
    with tempfile.TemporaryDirectory(prefix=".look-", dir=context.scratch.folder) as folder:
        draft, written = Path(folder) / "made", Path(folder) / "strokes.json"
        try:
            if strokes is None:
                async with context.admission.place("file", caller, await run_in_threadpool(look_bytes, capture)):
                    await run_file_tool("pictures", str(capture), str(draft))
            else:
                written.write_text(strokes)
                async with context.admission.place("file", caller, await run_in_threadpool(masks_bytes, capture)):
                    await run_file_tool("masks", str(capture), str(written), str(draft))
        except FileToolError as error:
            sentence = str(error).replace(f"{capture}/", "").replace(str(capture), row.name)
            raise ProblemError(404 if strokes is None else 422, sentence) from error
        place.parent.mkdir(exist_ok=True)
        draft.rename(place)


def _forget_old_masks(folder: Path) -> None:
    for old in sorted(folder.iterdir(), key=lambda place: place.stat().st_mtime)[:-KEPT_MASKS]:
        shutil.rmtree(old, ignore_errors=True)


async def _look(context: ServerContext, request: Request, capture_id: str) -> Path:
    """The folder with what can be seen of it, made where it is not there yet; once, however many ask."""
    row = await run_in_threadpool(_read_row, context, capture_id)
    place = context.directory.look(row.id)
    async with context.incoming.alone(row.id):
        if not place.is_dir():
            await while_connected(request, _make_look(context, caller_of(request), row, place))
    return place


async def _make_look(context: ServerContext, caller: Caller, row: CaptureRow, place: Path) -> None:
    capture = await run_in_threadpool(fetch_capture, context.directory, context.directory.uploads / row.folder)
    with tempfile.TemporaryDirectory(prefix=".look-", dir=context.scratch.folder) as folder:
        draft = Path(folder) / "look"
        try:
            async with context.admission.place("file", caller, await run_in_threadpool(look_bytes, capture)):
                await run_file_tool("look", str(capture), str(draft), row.name)
        except FileToolError as error:
            raise ProblemError(422, str(error)) from error
        draft.rename(place)


@router.delete("/{capture_id}", status_code=204)
def delete_capture(capture_id: str, context: Context) -> None:
    """409 while a job that is not over reads it. A build from it can then not be retried, nor its materials found again."""
    row = _read_row(context, capture_id)
    with Session(context.engine) as session:
        jobs = jobs_of_capture(session, row.id)
    states = context.queue.statuses(jobs)
    active = [job for job in jobs if states[job].state in ("queued", "running", "stalled")]
    if active:
        raise ProblemError(409, f"The job {active[0]} reads this capture; cancel it, or wait for its end.")
    remove_capture(context.directory, context.engine, row.id)
