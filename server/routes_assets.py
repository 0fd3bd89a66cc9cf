"""REST: assets and environments."""

import shutil
import tempfile
import uuid
from pathlib import Path
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import FileResponse
from sqlalchemy import delete, func, select
from sqlalchemy.orm import Session
from starlette.background import BackgroundTask
from starlette.concurrency import run_in_threadpool

from server.answers import asset_info
from server.context import ServerContext, context_of
from server.problems import ProblemError
from server.rest_records import AssetInfo, AssetList, EnvironmentInfo, EnvironmentList
from server.uploads import receive_upload
from worker.asset_folder import count_asset_folder, folder_bytes
from worker.database import AssetRow, SessionEventRow, SessionRow, now
from worker.file_tool import FileToolError, run_file_tool

router = APIRouter(prefix="/api", tags=["assets"])

Context = Annotated[ServerContext, Depends(context_of)]
ExportFormat = Literal["ply", "ply3", "glb", "usd", "env", "zip"]
_EXPORT_SUFFIXES = {"ply": ".ply", "ply3": ".ply", "glb": ".glb", "usd": ".usda", "env": ".exr", "zip": ".zip"}


@router.get("/assets")
def list_assets(
    context: Context, limit: Annotated[int, Query(ge=1, le=500)] = 50, offset: Annotated[int, Query(ge=0, le=1_000_000)] = 0
) -> AssetList:
    """Newest first."""
    with Session(context.engine) as session:
        rows = session.scalars(select(AssetRow).order_by(AssetRow.created_at.desc()).limit(limit).offset(offset)).all()
        total = session.scalar(select(func.count()).select_from(AssetRow)) or 0
    return AssetList(assets=[asset_info(row, context.directory.asset(row.id)) for row in rows], total=total)


@router.post("/assets", status_code=201)
async def upload_asset(request: Request, context: Context) -> AssetInfo:
    """Multipart part `file`: a zipped asset, or a mesh (GLB, PLY, OBJ). Optional field `name`."""
    upload = await receive_upload(request, {".zip", ".glb", ".ply", ".obj"})
    asset_id = uuid.uuid4().hex
    try:
        name = upload.field("name") or upload.stem
        with tempfile.TemporaryDirectory(prefix=".asset-", dir=context.directory.uploads) as folder:
            source, draft = Path(folder) / f"upload{upload.suffix}", Path(folder) / "asset"
            await run_in_threadpool(_copy, upload.stream, source)
            await _run_tool("asset", str(source), str(draft))
            return await run_in_threadpool(_register, context, asset_id, name, draft)
    finally:
        await upload.close()


def _copy(stream, target: Path) -> None:
    with target.open("xb") as file:
        shutil.copyfileobj(stream, file, 1 << 20)


async def _run_tool(*arguments: str) -> None:
    try:
        await run_file_tool(*arguments)
    except FileToolError as error:
        # The tool names the temporary file; its reader knows it as the upload.
        sentence = str(error).replace(str(Path(arguments[1]).parent) + "/", "")
        raise ProblemError(422, sentence) from error


def _register(context: ServerContext, asset_id: str, name: str, draft: Path) -> AssetInfo:
    counts, size = count_asset_folder(draft), folder_bytes(draft)
    place = context.directory.asset(asset_id)
    draft.rename(place)
    row = AssetRow(
        id=asset_id,
        name=name,
        created_at=now(),
        source="upload",
        bytes=size,
        surfel_count=counts.surfels,
        vertex_count=counts.vertices,
        face_count=counts.faces,
    )
    with Session(context.engine, expire_on_commit=False) as session, session.begin():
        session.add(row)
    return asset_info(row, place)


def _read_row(context: ServerContext, asset_id: str) -> AssetRow:
    with Session(context.engine) as session:
        row = session.get(AssetRow, asset_id)
    if row is None:
        raise ProblemError(404, f"No asset has the id {asset_id[:64]!r}.")
    return row


@router.get("/assets/{asset_id}")
def read_asset(asset_id: str, context: Context) -> AssetInfo:
    row = _read_row(context, asset_id)
    return asset_info(row, context.directory.asset(row.id))


def _asset_file(context: ServerContext, asset_id: str, name: str, media_type: str) -> FileResponse:
    path = context.directory.asset(_read_row(context, asset_id).id) / name
    if not path.is_file():
        raise ProblemError(404, f"This asset has no {name}.")
    return FileResponse(path, media_type=media_type)


@router.get("/assets/{asset_id}/thumb.jpg")
def read_thumbnail(asset_id: str, context: Context) -> FileResponse:
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
async def export_asset(asset_id: str, format: ExportFormat, context: Context) -> FileResponse:
    """A download in another program's format, or the asset itself as a zip."""
    row = await run_in_threadpool(_read_row, context, asset_id)
    folder = Path(tempfile.mkdtemp(prefix=".export-", dir=context.directory.uploads))
    out = folder / f"asset{_EXPORT_SUFFIXES[format]}"
    try:
        await _run_tool("export", str(context.directory.asset(row.id)), str(out), format)
    except ProblemError:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    title = "".join(c if c.isalnum() or c in "-_ " else "-" for c in row.name).strip() or "asset"
    return FileResponse(
        out,
        media_type="application/octet-stream",
        filename=title + _EXPORT_SUFFIXES[format],
        background=BackgroundTask(shutil.rmtree, folder, ignore_errors=True),
    )


@router.delete("/assets/{asset_id}", status_code=204)
async def delete_asset(asset_id: str, context: Context) -> None:
    """Deletes the asset and its sessions."""
    await run_in_threadpool(_read_row, context, asset_id)
    if context.sessions.uses(asset_id):
        raise ProblemError(409, "Somebody is looking at this asset; close the viewer first.")
    context.sessions.forget_asset(asset_id)

    def forget() -> None:
        sessions = select(SessionRow.id).where(SessionRow.asset_id == asset_id)
        with Session(context.engine) as session, session.begin():
            session.execute(delete(SessionEventRow).where(SessionEventRow.session_id.in_(sessions)))
            session.execute(delete(SessionRow).where(SessionRow.asset_id == asset_id))
            session.execute(delete(AssetRow).where(AssetRow.id == asset_id))
        shutil.rmtree(context.directory.asset(asset_id), ignore_errors=True)

    await run_in_threadpool(forget)


@router.get("/environments", tags=["environments"])
def list_environments(context: Context) -> EnvironmentList:
    return EnvironmentList(environments=context.environments.all())


@router.post("/environments", status_code=201, tags=["environments"])
async def upload_environment(request: Request, context: Context) -> EnvironmentInfo:
    """Multipart part `file`: a lat-long EXR or Radiance HDR, twice as wide as high. Optional field `name`."""
    upload = await receive_upload(request, {".exr", ".hdr"})
    try:
        with tempfile.TemporaryDirectory(prefix=".environment-", dir=context.directory.uploads) as folder:
            source, draft = Path(folder) / f"upload{upload.suffix}", Path(folder) / "out.exr"
            await run_in_threadpool(_copy, upload.stream, source)
            await _run_tool("environment", str(source), str(draft))
            name = context.environments.free_name(upload.field("name") or upload.stem)
            draft.rename(context.directory.environments / name)
            return context.environments.info(name)
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
