"""REST: sessions, their edits, and single pictures of them."""

import asyncio
from typing import Annotated, Literal

from fastapi import APIRouter, Depends, Header, Query, Request
from fastapi import Path as PathParameter
from fastapi.responses import FileResponse, Response
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from drgs.exchange.export_formats import DownloadFormat
from drgs.exchange.exr import encode_exr
from drgs.maths.constants import STILL_BOUNCES
from drgs.scene.edits import Edit, EnvironmentEdit
from drgs.scene.tone_curve import ToneCurve
from drgs_server.api.answers import session_info, snapshot_info
from drgs_server.api.context import ServerContext, caller_of, context_of
from drgs_server.api.door.while_connected import while_connected
from drgs_server.api.problems import ProblemError
from drgs_server.api.rest_records import (
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
from drgs_server.api.routes.assets import FacesQuery, save_version, write_export
from drgs_server.live.admission import Caller
from drgs_server.live.edit_log import ChangeRequest
from drgs_server.live.live_session import LiveSession
from drgs_server.live.messages import (
    MAX_LAYERED_PIXELS,
    MAX_SIDE,
    MAX_STILL_PIXELS,
    MAX_STILL_SAMPLES,
    CameraMessage,
    Channel,
    EditLog,
    Settings,
    StartView,
)
from drgs_server.render.encode import encode_exr_still, encode_jpeg, encode_png
from drgs_server.render.interface import LINEAR_CHANNELS, AbstractStill, Layers, LinearPixels, Pixels
from drgs_worker.store.user_names import UserName

router = APIRouter(prefix="/api/sessions", tags=["sessions"])

Context = Annotated[ServerContext, Depends(context_of)]

ClientKeyHeader = Annotated[str | None, Header(alias="Idempotency-Key", min_length=1, max_length=64)]
SnapshotName = Annotated[UserName, PathParameter()]

Suffix = Literal["jpg", "png", "exr"]
CAPTURED_LIGHT = "captured"
STILL_BYTES = 256 << 20
"""Of a picture of no size."""
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
async def append_edit(session_id: str, body: EditRequest, context: Context, call: Request, key: ClientKeyHeader = None) -> EditLog:
    """With an Idempotency-Key the same key appends one edit, however often it is sent. Who leaves before the answer cancels the edit, unless it
    is being stored already."""
    return await _apply(context, session_id, ChangeRequest("edit", body.edit, key=key), call)


@router.post("/{session_id}/undo")
async def undo(session_id: str, context: Context, call: Request, key: ClientKeyHeader = None) -> EditLog:
    return await _apply(context, session_id, ChangeRequest("undo", key=key), call)


@router.post("/{session_id}/redo")
async def redo(session_id: str, context: Context, call: Request, key: ClientKeyHeader = None) -> EditLog:
    return await _apply(context, session_id, ChangeRequest("redo", key=key), call)


@router.post("/{session_id}/cancel", status_code=204)
async def cancel_change(session_id: str, context: Context) -> None:
    """Gives up the change that is being computed, such as a long simulation: who asked for it gets 409, and the log stays as it is. Does nothing
    where there is none."""
    context.sessions.cancel(await context.sessions.get(session_id))


@router.put("/{session_id}/edits")
async def replace_edits(session_id: str, body: EditsRequest, context: Context, call: Request, key: ClientKeyHeader = None) -> EditLog:
    """Puts these edits in place of all that are in force, as one step of undo."""
    return await _apply(context, session_id, ChangeRequest("restore", body.edits, key=key, revision=body.revision), call)


async def _apply(context: ServerContext, session_id: str, request: ChangeRequest, call: Request) -> EditLog:
    session = await context.sessions.get(session_id)
    return (await while_connected(call, context.sessions.apply(session, request, caller_of(call, session_id)))).log


@router.get("/{session_id}/snapshots")
async def list_snapshots(session_id: str, context: Context) -> SnapshotList:
    """Oldest first."""
    return SnapshotList(snapshots=[snapshot_info(row) for row in await context.sessions.snapshots(session_id)])


@router.put("/{session_id}/snapshots/{name}")
async def take_snapshot(session_id: str, name: SnapshotName, context: Context) -> SnapshotInfo:
    """Keeps the edits in force under a name; the same name is overwritten."""
    return snapshot_info(await context.sessions.take_snapshot(session_id, name))


@router.post("/{session_id}/snapshots/{name}/restore")
async def restore_snapshot(session_id: str, name: SnapshotName, context: Context, call: Request, key: ClientKeyHeader = None) -> EditLog:
    """Puts the snapshot's edits in place of those in force, as one step of undo."""
    session = await context.sessions.get(session_id)
    return (await while_connected(call, context.sessions.restore(session, name, key, caller_of(call, session_id)))).log


@router.delete("/{session_id}/snapshots/{name}", status_code=204)
async def delete_snapshot(session_id: str, name: SnapshotName, context: Context) -> None:
    await context.sessions.delete_snapshot(session_id, name)


@router.post("/{session_id}/save", status_code=201)
async def save_session(session_id: str, context: Context, call: Request, body: SaveRequest | None = None) -> AssetInfo:
    """Makes a new version of the asset with the edits in force put into it; they are listed with it. The session goes on as it is."""
    session = await context.sessions.get(session_id)
    return await while_connected(call, save_version(context, session, body.name if body else None, caller_of(call, session_id)))


@router.get("/{session_id}/export")
async def export_session(
    session_id: str, format: DownloadFormat, context: Context, call: Request, faces: FacesQuery = None
) -> FileResponse:
    """A download of the object as it is now, with the edits in force put into it. Nothing of it is kept; `save` keeps a version.

    Args:
        faces: the most that a textured mesh (glb, mesh, usdz, usd) has; 30 000 without it.
    """
    session, caller = await context.sessions.get(session_id), caller_of(call, session_id)

    async def write() -> FileResponse:
        return await write_export(context, session.asset_id, format, faces, await context.sessions.applied(session, caller), caller)

    return await while_connected(call, write())


@router.get("/{session_id}/vertices")
async def read_vertices(session_id: str, context: Context, call: Request) -> Response:
    """Where the edits in force put the vertices of the asset's mesh, in its order: three float32 (little-endian) each [world units]."""
    session = await context.sessions.get(session_id)
    posed = await while_connected(call, context.sessions.load(session, caller_of(call, session_id)))
    data = await asyncio.to_thread(lambda: posed.pose.vertices().tobytes())
    return Response(data, media_type="application/octet-stream", headers={"x-drgs-revision": str(posed.revision)})


class FrameQuery(BaseModel):
    """Of one picture."""

    model_config = ConfigDict(extra="forbid", allow_inf_nan=False)

    width: Annotated[int, Field(ge=16, le=MAX_SIDE)] = 512
    height: Annotated[int, Field(ge=16, le=MAX_SIDE)] = 512
    spp: Annotated[int, Field(ge=1, le=65535)] = 128
    bounces: Annotated[int, Field(ge=0, le=8)] = STILL_BOUNCES
    exposure_stops: Annotated[float, Field(ge=-10, le=10)] = 0.0
    tone_curve: ToneCurve = "standard"
    background: Literal["environment", "blurred", "transparent"] = "environment"
    channel: Channel | Literal["all"] = "final"
    """all: every channel that the asset has, as layers of one EXR."""
    denoise: bool = False
    turn_light: bool = False
    """The asset's own light turns with the camera, where it stood still with the camera of the photographs."""
    environment: Annotated[str, Field(min_length=1, max_length=200)] | None = None
    """Name of a stored environment, or `captured` for the asset's own, in the place of the light in force: turned and as bright as that is."""
    captured: bool = False
    """Without what was done to material and shape; the light stays."""
    world_from_camera: Annotated[str, Field(max_length=1000)] | None = None
    """16 numbers, rows, separated by commas: OpenGL camera-to-world. The start view when absent."""
    fov_y_degrees: Annotated[float, Field(gt=0.1, lt=175)] | None = None


@router.get("/{session_id}/frame.{suffix}")
async def read_frame(session_id: str, suffix: Suffix, context: Context, query: Annotated[FrameQuery, Query()], call: Request) -> Response:
    """One finished picture. PNG and JPEG show it as a screen does (sRGB). EXR holds the light itself: linear Rec.709 radiance as 32-bit
    floats, scaled by the exposure and nothing else; with a transparent background also A, which R, G and B are multiplied with. Of a
    channel other than `final` it holds the values themselves (normals in the world, depth in world units), not multiplied, and A.

    With `channel=all` an EXR holds the object alone, in layers: those of `drgs render --aov` (R, G, B, not multiplied and without exposure, A,
    albedo.R .G .B, normal.X .Y .Z, depth.Z, roughness.Y, metallic.Y, visibility.Y), indirect.R .G .B, variance.Y, and certainty.R .G .B and
    surfels.R .G .B .A where the asset has them."""
    if query.channel == "all":
        if suffix != "exr":
            raise ProblemError(422, f"All channels fit into an EXR only; ask for frame.exr instead of frame.{suffix}.")
        if query.width * query.height > MAX_LAYERED_PIXELS:
            raise ProblemError(
                422, f"A picture with all channels has at most {MAX_LAYERED_PIXELS} pixels; found {query.width}x{query.height}."
            )
    elif suffix == "exr" and query.channel not in LINEAR_CHANNELS:
        raise ProblemError(422, f"An EXR holds one of {', '.join(LINEAR_CHANNELS)}; ask for a PNG of {query.channel}.")
    if query.width * query.height > MAX_STILL_PIXELS:
        raise ProblemError(422, f"A picture has at most {MAX_STILL_PIXELS} pixels, as 4096x2160 has; found {query.width}x{query.height}.")
    if query.width * query.height * query.spp > MAX_STILL_SAMPLES:
        raise ProblemError(422, f"A picture costs at most {MAX_STILL_SAMPLES} samples in all; ask for fewer pixels or a smaller spp.")
    session = await context.sessions.get(session_id)
    content, revision = await while_connected(call, _make_picture(context, session, suffix, query, caller_of(call, session_id)))
    return Response(content, media_type=_MEDIA_TYPES[suffix], headers={"x-drgs-revision": str(revision)})


async def _make_picture(
    context: ServerContext, session: LiveSession, suffix: Suffix, query: FrameQuery, caller: Caller
) -> tuple[bytes, int]:
    """The file, and the revision of the log that it shows; once it is the caller's turn."""
    async with context.admission.place("picture", caller, still_bytes(query.width * query.height, suffix, query.channel)):
        posed = await context.sessions.load(session, caller)
        loaded, pose = session.loaded, posed.pose
        assert loaded is not None
        camera, settings = _camera_of(query, loaded.start_view), _settings_of(query)
        work = context.render_thread.call_in_turn
        if query.captured or query.environment is not None:
            shown = _edits_shown(session.log.applied, query)
            if query.environment is not None:
                await asyncio.to_thread(context.sessions.references.check, shown[-1])
            pose = await asyncio.wrap_future(work(lambda: loaded.pose(shown, posed.pose)))

        def begin() -> AbstractStill:
            if query.channel == "all":
                return pose.layers(camera, settings, query.width, query.height)
            return pose.still(camera, settings, query.width, query.height, suffix == "exr")

        try:
            still = await asyncio.wrap_future(work(begin))
        except ValueError as error:
            raise ProblemError(422, str(error)) from error
        # One call a slice: viewers get their turns in between, and who leaves stops the next one.
        while await asyncio.wrap_future(work(still.work)):
            pass
        return await asyncio.to_thread(_encode, still.picture(), suffix, query), posed.revision


def _edits_shown(applied: list[Edit], query: FrameQuery) -> list[Edit]:
    """Those behind a picture that does not show all of them as they are, or another light: that comes last."""
    light = [edit for edit in applied if isinstance(edit, EnvironmentEdit)]
    edits: list[Edit] = [*light] if query.captured else applied
    if query.environment is None:
        return edits
    now = light[-1] if light else EnvironmentEdit(op="environment")
    other = now.model_copy(update={"file": None if query.environment == CAPTURED_LIGHT else query.environment})
    return [*(edit for edit in edits if not isinstance(edit, EnvironmentEdit)), other]


def _encode(pixels: Pixels | LinearPixels | Layers, suffix: Suffix, query: FrameQuery) -> bytes:
    if isinstance(pixels, dict):
        return encode_exr(pixels)
    if suffix == "exr":
        return encode_exr_still(pixels, query.exposure_stops if query.channel == "final" else 0.0)
    return encode_png(pixels) if suffix == "png" else encode_jpeg(pixels, moving=False)


def still_bytes(pixels: int, suffix: Suffix, channel: Channel | Literal["all"]) -> int:
    """Memory that making a picture takes, estimated: a band in the making, the whole picture, and what encoding it needs (float32 for EXR)."""
    a_pixel = 256 if channel == "all" else 64 if suffix == "exr" else 24 if channel == "depth" else 16
    return STILL_BYTES + a_pixel * pixels


def _camera_of(query: FrameQuery, start: StartView) -> CameraMessage:
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
    return camera.model_copy(update={"width": query.width, "height": query.height})  # may be larger than what is streamed


def _settings_of(query: FrameQuery) -> Settings:
    return Settings(
        exposure_stops=query.exposure_stops,
        tone_curve=query.tone_curve,
        background=query.background,
        spp_target=query.spp,
        bounces=query.bounces,
        channel="final" if query.channel == "all" else query.channel,
        denoise=query.denoise,
        turn_light=query.turn_light,
    )


def _matrix(text: str) -> tuple[tuple[float, ...], ...]:
    try:
        numbers = [float(number) for number in text.split(",")]
    except ValueError as error:
        raise ProblemError(422, "world_from_camera must be 16 numbers separated by commas.") from error
    if len(numbers) != 16:
        raise ProblemError(422, f"world_from_camera must be 16 numbers; found {len(numbers)}.")
    return tuple(tuple(numbers[4 * row : 4 * row + 4]) for row in range(4))
