"""REST: sessions, their edits, and single pictures of them."""

import asyncio
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Header, Query
from fastapi import Path as PathParameter
from fastapi.responses import FileResponse, Response
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drgs.scene.edits import Edit, EnvironmentEdit
from drgs.scene.tone_curve import ToneCurve
from server.answers import session_info, snapshot_info
from server.context import ServerContext, context_of
from server.edit_log import EventKind
from server.encode import encode_exr_still, encode_jpeg, encode_png
from server.messages import MAX_SIDE, MAX_STILL_PIXELS, MAX_STILL_SAMPLES, CameraMessage, Channel, EditLog, Settings
from server.problems import ProblemError
from server.render_session import LINEAR_CHANNELS
from server.rest_records import (
    AssetInfo,
    EditRequest,
    EditsRequest,
    SaveRequest,
    SessionInfo,
    SessionList,
    SessionRequest,
    SnapshotInfo,
    SnapshotList,
)
from server.routes_assets import ExportFormat, save_version, write_export

router = APIRouter(prefix="/api/sessions", tags=["sessions"])

Context = Annotated[ServerContext, Depends(context_of)]

ClientKeyHeader = Annotated[str | None, Header(alias="Idempotency-Key", min_length=1, max_length=64)]
SnapshotName = Annotated[str, PathParameter(min_length=1, max_length=80, pattern=r"^[^/\\x00-\\x1f]+$")]

_MEDIA_TYPES = {"jpg": "image/jpeg", "png": "image/png", "exr": "image/x-exr"}


@router.post("", status_code=201)
async def open_session(body: SessionRequest, context: Context) -> SessionInfo:
    return session_info(await context.sessions.create(body.asset))


@router.get("")
async def list_sessions(context: Context) -> SessionList:
    """Newest first, at most 100."""
    return SessionList(sessions=[session_info(session) for session in await context.sessions.all()])


@router.get("/{session_id}")
async def read_session(session_id: str, context: Context) -> SessionInfo:
    return session_info(await context.sessions.get(session_id))


@router.delete("/{session_id}", status_code=204)
async def delete_session(session_id: str, context: Context) -> None:
    await context.sessions.remove(session_id)


@router.post("/{session_id}/edits")
async def append_edit(session_id: str, body: EditRequest, context: Context, key: ClientKeyHeader = None) -> EditLog:
    """With an Idempotency-Key the same key appends one edit, however often it is sent."""
    return await _apply(context, session_id, "edit", body.edit, key)


@router.post("/{session_id}/undo")
async def undo(session_id: str, context: Context, key: ClientKeyHeader = None) -> EditLog:
    return await _apply(context, session_id, "undo", None, key)


@router.post("/{session_id}/redo")
async def redo(session_id: str, context: Context, key: ClientKeyHeader = None) -> EditLog:
    return await _apply(context, session_id, "redo", None, key)


@router.put("/{session_id}/edits")
async def replace_edits(session_id: str, body: EditsRequest, context: Context, key: ClientKeyHeader = None) -> EditLog:
    """Puts these edits in place of all that are in force, as one step of undo."""
    session = await context.sessions.get(session_id)
    return (await context.sessions.apply(session, "restore", body.edits, key=key, revision=body.revision)).log


async def _apply(context: ServerContext, session_id: str, kind: EventKind, edit: Edit | None, key: str | None) -> EditLog:
    session = await context.sessions.get(session_id)
    return (await context.sessions.apply(session, kind, edit, key=key)).log


@router.get("/{session_id}/snapshots")
async def list_snapshots(session_id: str, context: Context) -> SnapshotList:
    """Oldest first."""
    return SnapshotList(snapshots=[snapshot_info(row) for row in await context.sessions.snapshots(session_id)])


@router.put("/{session_id}/snapshots/{name}")
async def take_snapshot(session_id: str, name: SnapshotName, context: Context) -> SnapshotInfo:
    """Keeps the edits in force under a name; the same name is overwritten."""
    return snapshot_info(await context.sessions.take_snapshot(session_id, name))


@router.post("/{session_id}/snapshots/{name}/restore")
async def restore_snapshot(session_id: str, name: SnapshotName, context: Context, key: ClientKeyHeader = None) -> EditLog:
    """Puts the snapshot's edits in place of those in force, as one step of undo."""
    session = await context.sessions.get(session_id)
    return (await context.sessions.restore(session, name, key)).log


@router.delete("/{session_id}/snapshots/{name}", status_code=204)
async def delete_snapshot(session_id: str, name: SnapshotName, context: Context) -> None:
    await context.sessions.delete_snapshot(session_id, name)


@router.post("/{session_id}/save", status_code=201)
async def save_session(session_id: str, context: Context, body: SaveRequest | None = None) -> AssetInfo:
    """Makes a new version of the asset with the edits in force put into it; they are listed with it. The session goes on as it is."""
    session = await context.sessions.get(session_id)
    return await save_version(context, session, body.name if body else None)


@router.get("/{session_id}/export")
async def export_session(session_id: str, format: ExportFormat, context: Context) -> FileResponse:
    """A download of the object as it is now, with the edits in force put into it. Nothing of it is kept; `save` keeps a version."""
    session = await context.sessions.get(session_id)
    return await write_export(context, session.asset_id, format, session.log.done)


class FrameQuery(BaseModel):
    """Of one picture."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    width: Annotated[int, Field(ge=16, le=MAX_SIDE)] = 512
    height: Annotated[int, Field(ge=16, le=MAX_SIDE)] = 512
    spp: Annotated[int, Field(ge=1, le=65535)] = 128
    bounces: Annotated[int, Field(ge=0, le=8)] = 1
    exposure_stops: Annotated[float, Field(ge=-10, le=10)] = 0.0
    tone_curve: ToneCurve = "standard"
    background: Literal["environment", "blurred", "transparent"] = "environment"
    channel: Channel = "final"
    denoise: bool = False
    captured: bool = False
    """Without what was done to material and shape; the light stays."""
    world_from_camera: Annotated[str, Field(max_length=1000)] | None = None
    """16 numbers, rows, separated by commas: OpenGL camera-to-world. The start view when absent."""
    fov_y_degrees: Annotated[float, Field(gt=0.1, lt=175)] | None = None


@router.get("/{session_id}/frame.{suffix}")
async def read_frame(
    session_id: str, suffix: Literal["jpg", "png", "exr"], context: Context, query: Annotated[FrameQuery, Query()]
) -> Response:
    """One finished picture. PNG and JPEG show it as a screen does (sRGB). EXR holds the light itself: linear Rec.709 radiance as 32-bit
    floats, scaled by the exposure and nothing else; with a transparent background also A, which R, G and B are multiplied with. Of a
    channel other than `final` it holds the values themselves (normals in the world, depth in world units), not multiplied, and A."""
    if suffix == "exr" and query.channel not in LINEAR_CHANNELS:
        raise ProblemError(422, f"An EXR holds one of {', '.join(LINEAR_CHANNELS)}; ask for a PNG of {query.channel}.")
    if query.width * query.height > MAX_STILL_PIXELS:
        raise ProblemError(422, f"A picture has at most {MAX_STILL_PIXELS} pixels, as 4096x2160 has; found {query.width}x{query.height}.")
    if query.width * query.height * query.spp > MAX_STILL_SAMPLES:
        raise ProblemError(422, f"A picture costs at most {MAX_STILL_SAMPLES} samples in all; ask for fewer pixels or a smaller spp.")
    session = await context.sessions.get(session_id)
    posed = await context.sessions.load(session)
    assert session.loaded is not None
    start = session.loaded.start_view
    try:
        camera = CameraMessage.model_validate(
            {
                "type": "camera",
                "world_from_camera": _matrix(query.world_from_camera) if query.world_from_camera else start.world_from_camera,
                "fov_y_degrees": query.fov_y_degrees or start.fov_y_degrees,
                "width": 16,
                "height": 16,
            }
        )
    except ValidationError as error:
        raise ProblemError(422, f"{error.errors()[0]['msg']}.") from error
    camera = camera.model_copy(update={"width": query.width, "height": query.height})  # may be larger than what is streamed
    settings = Settings(
        exposure_stops=query.exposure_stops,
        tone_curve=query.tone_curve,
        background=query.background,
        spp_target=query.spp,
        bounces=query.bounces,
        channel=query.channel,
        denoise=query.denoise,
    )
    call, pose = context.render_thread.call, posed.pose
    if query.captured:
        loaded, light = session.loaded, [edit for edit in session.log.done if isinstance(edit, EnvironmentEdit)]
        pose = await asyncio.wrap_future(call(lambda: loaded.pose(light, posed.pose)))
    picture = await asyncio.wrap_future(call(lambda: pose.begin(camera, settings, query.width, query.height, None)))
    # One call a refinement: viewers get their turns in between.
    while picture.samples < picture.samples_target:
        await asyncio.wrap_future(call(picture.refine))
        await asyncio.sleep(0)

    def finish() -> bytes:
        if suffix == "exr":
            return encode_exr_still(picture.linear(), query.exposure_stops if query.channel == "final" else 0.0)
        pixels = picture.resolve()
        return encode_png(pixels) if suffix == "png" else encode_jpeg(pixels, moving=False)

    return Response(
        await asyncio.wrap_future(call(finish)), media_type=_MEDIA_TYPES[suffix], headers={"x-drgs-revision": str(posed.revision)}
    )


def _matrix(text: str) -> tuple[tuple[float, ...], ...]:
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError as error:
        raise ProblemError(422, "world_from_camera must be 16 numbers separated by commas.") from error
    if len(numbers) != 16:
        raise ProblemError(422, f"world_from_camera must be 16 numbers; found {len(numbers)}.")
    return tuple(tuple(numbers[4 * row : 4 * row + 4]) for row in range(4))
