"""REST: assets and environments."""

import asyncio
import json
import shutil
import tempfile
import uuid
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import FileResponse, Response
from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session
from starlette.concurrency import run_in_threadpool
from starlette.types import Receive, Scope, Send

from drgs.exchange.export_formats import FEWEST_FACES, FILE_KINDS, MOST_FACES, DownloadFormat, refuse_faces
from drgs.scene.edits import Edit, plain_edit
from drgs_server.api.answers import asset_info
from drgs_server.api.context import ServerContext, caller_of, context_of
from drgs_server.api.door.receive_upload import receive_upload
from drgs_server.api.door.while_connected import while_connected
from drgs_server.api.problems import ProblemError
from drgs_server.api.rest_records import AssetInfo, AssetList, EnvironmentInfo, EnvironmentList
from drgs_server.live.admission import Caller
from drgs_server.live.live_session import LiveSession
from drgs_worker.jobs.file_tool import FileToolError, file_tool_bytes, run_file_tool
from drgs_worker.store.artifact_store import ArtifactError
from drgs_worker.store.artifacts import fetch_asset, fetch_edit_files, remove_deleted_elsewhere, unshare_artifact
from drgs_worker.store.database import AssetRow, SessionEventRow, SessionRow, SnapshotRow, now
from drgs_worker.store.register_asset import register_asset

router = APIRouter(prefix="/api", tags=["assets"])

Context = Annotated[ServerContext, Depends(context_of)]
FacesQuery = Annotated[int | None, Query(ge=FEWEST_FACES, le=MOST_FACES)]


@router.get("/assets")
def list_assets(
    context: Context,
    limit: Annotated[int, Query(ge=1, le=500)] = 50,
    offset: Annotated[int, Query(ge=0, le=1_000_000)] = 0,
    search: Annotated[str | None, Query(max_length=100)] = None,
    deleted: bool = False,
) -> AssetList:
    """Newest first.

    Args:
        search: part of the name, whatever its case.
        deleted: those that wait to be removed, instead.
    """
    which = select(AssetRow).where(AssetRow.deleted_at.is_not(None) if deleted else AssetRow.deleted_at.is_(None))
    if search:
        which = which.where(AssetRow.name.icontains(search, autoescape=True))
    with Session(context.engine) as session:
        page = which.add_columns(func.count().over()).order_by(AssetRow.created_at.desc(), AssetRow.id).limit(limit).offset(offset)
        rows = session.execute(page).all()
        # A page behind the last one has no row that says it.
        total = rows[0][1] if rows else session.scalar(select(func.count()).select_from(which.subquery())) or 0
    return AssetList(assets=[_info(context, row) for row, _ in rows], total=total)


@router.post("/assets", status_code=201)
async def upload_asset(request: Request, context: Context) -> AssetInfo:
    """Multipart part `file`: a zipped asset, or a mesh (GLB, PLY, OBJ). Optional field `name`."""
    context.sessions.prepare_soon()
    upload = await receive_upload(request, {".zip", ".glb", ".ply", ".obj"})
    asset_id = uuid.uuid4().hex
    try:
        name = upload.name()
        with tempfile.TemporaryDirectory(prefix=".asset-", dir=context.scratch.folder) as folder:
            source, draft = Path(folder) / f"upload{upload.suffix}", Path(folder) / "asset"
            await run_in_threadpool(_copy, upload.stream, source)
            await while_connected(request, _run_tool(context, caller_of(request), source, "asset", str(source), str(draft)))
            return await run_in_threadpool(_register, context, asset_id, name, draft)
    finally:
        await upload.close()


def _copy(stream, target: Path) -> None:
    with target.open("xb") as file:
        shutil.copyfileobj(stream, file, 1 << 20)


async def _run_tool(context: ServerContext, caller: Caller, source: Path, *arguments: str) -> None:
    """Run the tool once it is the caller's turn.

    Args:
        source: the file or folder that it reads, by which its memory is estimated.
    """
    bytes = await run_in_threadpool(file_tool_bytes, source)
    try:
        async with context.admission.place("file", caller, bytes):
            await run_file_tool(*arguments)
    except FileToolError as error:
        # The tool names the temporary file; its reader knows it as the upload.
        sentence = str(error).replace(str(Path(arguments[1]).parent) + "/", "")
        raise ProblemError(422, sentence) from error


def _register(
    context: ServerContext, asset_id: str, name: str, draft: Path, parent: AssetRow | None = None, edits: list[dict] | None = None
) -> AssetInfo:
    place = context.directory.asset(asset_id)
    draft.rename(place)
    try:
        row = register_asset(context.directory, context.engine, asset_id, name, "session" if parent else "upload", parent, edits)
    except BaseException:
        shutil.rmtree(place, ignore_errors=True)
        raise
    return asset_info(row, place)


async def save_version(context: ServerContext, session: LiveSession, name: str | None, caller: Caller) -> AssetInfo:
    """A new asset: the session's own with the edits in force put into it. What was there stays as it is, whatever happens.

    Raises:
        ProblemError: the edits no longer apply, or the disk is full.
    """
    parent = await run_in_threadpool(_read_row, context, session.asset_id)
    applied = await context.sessions.applied(session, caller)
    edits = [plain_edit(edit) for edit in applied]
    with tempfile.TemporaryDirectory(prefix=".version-", dir=context.scratch.folder) as folder:
        listed, draft = Path(folder) / "edits.json", Path(folder) / "asset"
        listed.write_text(json.dumps(edits))
        source = await run_in_threadpool(fetch_asset, context.directory, parent.id)
        await run_in_threadpool(fetch_edit_files, context.directory, applied)
        environments = context.directory.environments
        version = str(parent.version + 1)
        await _run_tool(context, caller, source, "version", str(source), str(draft), str(listed), str(environments), version)
        return await run_in_threadpool(_register, context, uuid.uuid4().hex, name or parent.name, draft, parent, edits)


def _read_row(context: ServerContext, asset_id: str, deleted: bool = False) -> AssetRow:
    with Session(context.engine) as session:
        row = session.get(AssetRow, asset_id)
    if row is None or (row.deleted_at is not None and not deleted):
        raise ProblemError(404, f"No asset has the id {asset_id[:64]!r}.")
    return row


@router.get("/assets/{asset_id}")
def read_asset(asset_id: str, context: Context) -> AssetInfo:
    return _info(context, _read_row(context, asset_id))


def _info(context: ServerContext, row: AssetRow) -> AssetInfo:
    folder = context.directory.asset(row.id)
    info = asset_info(row, folder)
    if context.directory.store is None or folder.is_dir():
        return info
    # Assets that the service makes have one; a list of them is no reason to fetch them all.
    return info.model_copy(update={"has_thumbnail": True})


def asset_folder(context: ServerContext, asset_id: str) -> Path:
    """Of an asset that is not deleted, fetched if it is not here.

    Raises:
        ProblemError, ArtifactError: there is none, or it cannot be had now.
    """
    return fetch_asset(context.directory, _read_row(context, asset_id).id)


def _asset_file(context: ServerContext, asset_id: str, name: str, media_type: str) -> FileResponse:
    path = asset_folder(context, asset_id) / name
    if not path.is_file():
        raise ProblemError(404, f"This asset has no {name}.")
    return FileResponse(path, media_type=media_type)


@router.get("/assets/{asset_id}/thumb.jpg")
def read_thumbnail(asset_id: str, context: Context) -> Response:
    store, folder = context.directory.store, context.directory.asset(_read_row(context, asset_id).id)
    if store is not None and not folder.is_dir():
        return Response(store.get_file("assets", folder.name, "thumb.jpg"), media_type="image/jpeg")
    return _asset_file(context, asset_id, "thumb.jpg", "image/jpeg")


@router.get("/assets/{asset_id}/mesh.glb")
def read_mesh(asset_id: str, context: Context) -> FileResponse:
    """The mesh with its materials on the vertices (_ALBEDO, _ROUGHNESS, _METALLIC)."""
    return _asset_file(context, asset_id, "mesh.glb", "model/gltf-binary")


@router.get("/assets/{asset_id}/environment.exr")
def read_asset_environment(asset_id: str, context: Context) -> FileResponse:
    """The light that was recovered with the asset."""
    return _asset_file(context, asset_id, "environment.exr", "image/x-exr")


@router.get("/assets/{asset_id}/export")
async def export_asset(asset_id: str, format: DownloadFormat, context: Context, call: Request, faces: FacesQuery = None) -> FileResponse:
    """A download in another program's format, or the asset itself as a zip.

    Args:
        faces: the most that a textured mesh (glb, mesh, usdz, usd) has; 30 000 without it.
    """
    return await while_connected(call, write_export(context, asset_id, format, faces, (), caller_of(call)))


class DraftResponse(FileResponse):
    """A file whose folder is removed however sending ends. A background task is not run where the range that was asked for is refused, or where
    sending fails."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        try:
            await super().__call__(scope, receive, send)
        finally:
            shutil.rmtree(Path(self.path).parent, ignore_errors=True)


async def write_export(
    context: ServerContext, asset_id: str, format: DownloadFormat, faces: int | None, edits: Sequence[Edit], caller: Caller
) -> FileResponse:
    """A download of an asset with edits put into it.

    Raises:
        ProblemError: no such asset, it has nothing that the format holds, the format has no use for `faces`, or the edits no longer apply.
    """
    try:
        refuse_faces(faces, (format,))
    except ValueError as error:
        raise ProblemError(422, f"faces: {error}.") from error
    row = await run_in_threadpool(_read_row, context, asset_id)
    folder = Path(tempfile.mkdtemp(prefix=".export-", dir=context.scratch.folder))
    out, listed = folder / f"asset{FILE_KINDS[format].suffix}", folder / "edits.json"
    try:
        asset = await run_in_threadpool(fetch_asset, context.directory, row.id)
        changes: tuple[str, ...] = ()
        if edits:
            listed.write_text(json.dumps([plain_edit(edit) for edit in edits]))
            await run_in_threadpool(fetch_edit_files, context.directory, edits)
            changes = (str(listed), str(context.directory.environments), str(row.version + 1))
        await _run_tool(context, caller, asset, "export", str(asset), str(out), format, str(faces or 0), *changes)
    except (ProblemError, ArtifactError, OSError, asyncio.CancelledError):
        shutil.rmtree(folder, ignore_errors=True)
        raise
    title = "".join(c if c.isalnum() or c in "-_ " else "-" for c in row.name).strip() or "asset"
    return DraftResponse(out, media_type="application/octet-stream", filename=title + FILE_KINDS[format].suffix)


@router.delete("/assets/{asset_id}", status_code=204)
async def delete_asset(asset_id: str, context: Context) -> None:
    """Hides the asset and its sessions at once, and removes them after a day; until then `undelete` brings them back."""
    await run_in_threadpool(_read_row, context, asset_id)
    if context.sessions.uses(asset_id):
        raise ProblemError(409, "Somebody is looking at this asset; close the viewer first.")
    context.sessions.forget_asset(asset_id)
    await run_in_threadpool(_mark_deleted, context, asset_id, now())


@router.post("/assets/{asset_id}/undelete")
def undelete_asset(asset_id: str, context: Context) -> AssetInfo:
    """Brings a deleted asset back."""
    _read_row(context, asset_id, deleted=True)
    _mark_deleted(context, asset_id, None)
    return read_asset(asset_id, context)


def _mark_deleted(context: ServerContext, asset_id: str, at: float | None) -> None:
    with Session(context.engine) as session, session.begin():
        session.get_one(AssetRow, asset_id).deleted_at = at


def remove_deleted_assets(context: ServerContext) -> int:
    """Remove for good what was deleted long enough ago, with its sessions. Returns how many."""
    before = now() - context.settings.limits.undo_delete_seconds
    with Session(context.engine) as session, session.begin():
        gone = list(session.scalars(select(AssetRow.id).where(AssetRow.deleted_at < before)))
        sessions = select(SessionRow.id).where(SessionRow.asset_id.in_(gone))
        for asset_id in gone:
            unshare_artifact(context.directory, "assets", asset_id)
        for table in (SessionEventRow, SnapshotRow):
            session.execute(delete(table).where(table.session_id.in_(sessions)))
        session.execute(delete(SessionRow).where(SessionRow.asset_id.in_(gone)))
        session.execute(delete(AssetRow).where(AssetRow.id.in_(gone)))
    for asset_id in gone:
        shutil.rmtree(context.directory.asset(asset_id), ignore_errors=True)
    remove_deleted_elsewhere(context.directory, context.engine)
    return len(gone)


@router.get("/environments", tags=["environments"])
async def list_environments(context: Context) -> EnvironmentList:
    """By name."""
    all_ = context.environments.all
    return EnvironmentList(environments=all_() if context.directory.store is None else await run_in_threadpool(all_))


@router.post("/environments", status_code=201, tags=["environments"])
async def upload_environment(request: Request, context: Context) -> EnvironmentInfo:
    """Multipart part `file`: a lat-long EXR or Radiance HDR, twice as wide as high. Optional field `name`."""
    upload = await receive_upload(request, {".exr", ".hdr"})
    try:
        name = upload.name()
        with tempfile.TemporaryDirectory(prefix=".environment-", dir=context.scratch.folder) as folder:
            source, draft = Path(folder) / f"upload{upload.suffix}", Path(folder) / "out.exr"
            await run_in_threadpool(_copy, upload.stream, source)
            await while_connected(request, _run_tool(context, caller_of(request), source, "environment", str(source), str(draft)))
            return await run_in_threadpool(context.environments.add, draft, name)
    finally:
        await upload.close()


@router.get("/environments/{name}/thumb.jpg", tags=["environments"])
def read_environment_thumbnail(name: str, context: Context) -> FileResponse:
    try:
        return FileResponse(context.environments.thumbnail(name), media_type="image/jpeg")
    except KeyError as error:
        raise ProblemError(404, f"No environment is called {name[:100]!r}.") from error
    except ValueError as error:
        raise ProblemError(422, f"{error}.") from error


@router.get("/environments/{name}", tags=["environments"])
def read_environment(name: str, context: Context) -> FileResponse:
    """The EXR itself."""
    try:
        return FileResponse(context.environments.path(name), media_type="image/x-exr")
    except KeyError as error:
        raise ProblemError(404, f"No environment is called {name[:100]!r}.") from error
