"""WebSocket /api/sessions/{id}/stream: one connection between a client and the viewer made for it (docs/protocol.md)."""

import asyncio
import logging
from contextlib import suppress

import anyio
from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from pydantic import BaseModel, ValidationError
from sqlalchemy.exc import SQLAlchemyError

from drgs import __version__
from drgs_server.api.context import ServerContext, caller_of
from drgs_server.api.problems import MOST_PLACE, ProblemError
from drgs_server.live import messages
from drgs_server.live.edit_log import ChangeQueue, ChangeRequest, Splice
from drgs_server.live.frame_header import unpack_frame
from drgs_server.live.live_session import LiveSession, Overtaken
from drgs_server.live.messages import (
    CLOSE_POLICY,
    CLOSE_TRY_AGAIN,
    CLOSE_VERSION_MISMATCH,
    PROTOCOL_VERSION,
    AcceptedMessage,
    AckMessage,
    CameraMessage,
    CancelMessage,
    ClientHello,
    EditMessage,
    ErrorMessage,
    ExplainedMessage,
    ExplainMessage,
    LogMessage,
    PickedMessage,
    PickMessage,
    RedoMessage,
    RejectedMessage,
    ServerHello,
    SettingsMessage,
    SkippedWork,
    SpliceMessage,
    StateMessage,
    StatusMessage,
    UndoMessage,
    VisibilityMessage,
    client_message,
)
from drgs_server.live.outbox import Outbox
from drgs_server.live.session_store import AssetGone
from drgs_server.live.viewer import Viewer
from drgs_worker.store.disk_trouble import sentence_of

HELLO_SECONDS = 20.0
MAX_WAITING_CHANGES = 256
"""Edits that a client may have under way; beyond that its messages wait in its own socket."""
WRITE_SECONDS = 30.0
"""A client that takes nothing for so long is let go."""
CLOSE_SECONDS = 1.0
"""For the closing frame, which such a client does not take either."""
MAX_BAD_MESSAGES = 50

log = logging.getLogger(__name__)
router = APIRouter()

ChangeMessage = EditMessage | SpliceMessage | UndoMessage | RedoMessage


@router.websocket("/api/sessions/{session_id}/stream")
async def stream(socket: WebSocket, session_id: str) -> None:
    """Frames out, camera and edits in, until one side goes away."""
    context: ServerContext = socket.app.state.context
    await socket.accept()
    try:
        hello = await _receive_hello(socket)
        if hello is None:
            return
        session = await context.sessions.get(session_id)
        if context.sessions.viewer_count() >= context.settings.limits.viewers:
            raise ProblemError(429, "As many viewers as this server takes are connected; close one.")
        await socket.send_text(_loading().model_dump_json())
        await context.sessions.load(session, caller_of(socket, session_id))
    except ProblemError as problem:
        await _refuse(socket, context.directory.told(problem.detail), CLOSE_POLICY)
        return
    except (WebSocketDisconnect, RuntimeError):
        return
    await Connection(context, socket, session, hello).run()


async def _receive_hello(socket: WebSocket) -> ClientHello | None:
    try:
        text = await asyncio.wait_for(socket.receive_text(), HELLO_SECONDS)
    except TimeoutError:
        # A page on a busy machine is slow, not wrong: without a fatal error before it, it comes again.
        with suppress(WebSocketDisconnect, RuntimeError):
            await socket.close(CLOSE_TRY_AGAIN, f"no hello within {HELLO_SECONDS:g} seconds")
        return None
    except KeyError:
        text = ""
    try:
        message = client_message.validate_json(text)
    except ValidationError:
        await _refuse(socket, 'The first message must be {"type": "hello", "v": ' + str(PROTOCOL_VERSION) + "}.", CLOSE_POLICY)
        return None
    if not isinstance(message, ClientHello):
        await _refuse(socket, f"The first message must be `hello`; found `{message.type}`.", CLOSE_POLICY)
        return None
    if message.v != PROTOCOL_VERSION:
        sentence = f"The page speaks protocol {message.v}, the server {PROTOCOL_VERSION}; reload the page."
        await _refuse(socket, sentence, CLOSE_VERSION_MISMATCH)
        return None
    return message


async def _refuse(socket: WebSocket, sentence: str, code: int) -> None:
    with suppress(WebSocketDisconnect, RuntimeError):
        await socket.send_text(ErrorMessage(message=sentence, fatal=True).model_dump_json())
        # A close frame carries at most 123 bytes of reason.
        await socket.close(code, sentence.encode()[:120].decode(errors="ignore"))


def _loading() -> StatusMessage:
    return StatusMessage(phase="loading", width=0, height=0, scale=1, spp=0, spp_target=0, frames_per_second=0, render_ms=0)


class Connection:
    """Final. Its tasks: read messages, apply changes in order, write what waits, and let go of a client that does not read."""

    def __init__(self, context: ServerContext, socket: WebSocket, session: LiveSession, hello: ClientHello) -> None:
        self._context = context
        self._socket = socket
        self._session = session
        self._caller = caller_of(socket, session.id)
        self._loop = asyncio.get_running_loop()
        self._wants_changes = hello.changes
        self._outbox = Outbox(context.settings.limits.unsent_bytes)
        self._changes = ChangeQueue(MAX_WAITING_CHANGES)
        self._bad_messages = 0
        self.viewer = Viewer(self._deliver, lambda: session.posed, decodes_png="png" in hello.codecs)

    async def run(self) -> None:
        """Until one side goes away."""
        session, thread = self._session, self._context.render_thread
        loaded = session.loaded
        if loaded is None:
            return
        hello = ServerHello(
            server=__version__,
            session=session.id,
            asset=session.asset_id,
            minimum=loaded.bounds.minimum,
            maximum=loaded.bounds.maximum,
            start_view=loaded.start_view,
            light_camera=loaded.light_camera,
            log=session.log.message(),
            settings=self.viewer.settings,
        )
        session.viewers.add(self.viewer)
        session.listeners.add(self._tell_change)
        thread.add(self.viewer)
        try:
            # Not by the outbox: a log may be longer than what may wait there.
            with suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
                async with asyncio.timeout(WRITE_SECONDS):
                    await self._socket.send_text(hello.model_dump_json())
            async with anyio.create_task_group() as group:
                group.start_soon(self._apply_changes, group.cancel_scope)
                async with anyio.create_task_group() as readers:
                    group.start_soon(self._write, readers.cancel_scope)
                    readers.start_soon(self._read, readers.cancel_scope)
                    readers.start_soon(self._watch_overrun, readers.cancel_scope)
                    readers.start_soon(self._watch_deletion, readers.cancel_scope)
                # Changes that the client has sent are applied even though it will not hear of them: an edit is never dropped.
                await self._changes.close()
        finally:
            thread.remove(self.viewer)
            session.viewers.discard(self.viewer)
            session.listeners.discard(self._tell_change)
        misbehaved = session.gone.is_set() or self._outbox.overrun.is_set() or self._bad_messages >= MAX_BAD_MESSAGES
        with suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
            async with asyncio.timeout(CLOSE_SECONDS):
                await self._socket.close(CLOSE_POLICY if misbehaved else 1000)

    def _deliver(self, out: bytes | StatusMessage | ErrorMessage) -> None:
        """From the render thread."""
        if isinstance(out, bytes):
            metrics = self._context.metrics
            metrics.frames.inc()
            metrics.frame_bytes.inc(len(out))
            metrics.render_seconds.inc(unpack_frame(out)[0].render_us / 1e6)
        if isinstance(out, ErrorMessage):
            out = out.model_copy(update={"message": self._context.directory.told(out.message)})
        self._loop.call_soon_threadsafe(self._outbox.put, out if isinstance(out, bytes) else out.model_dump_json())

    def _say(self, message: BaseModel) -> None:
        self._outbox.put(message.model_dump_json())

    def _tell_change(self, change: str) -> None:
        if self._wants_changes:
            self._outbox.put_change(change)
        else:
            self._outbox.put_log()

    async def _write(self, readers: anyio.CancelScope) -> None:
        """Until the client is gone, whose last messages are still read then, or takes nothing any more."""
        try:
            while True:
                kind, out = await self._outbox.take()
                if kind == "log":
                    out = StateMessage(log=self._session.log.message()).model_dump_json()
                async with asyncio.timeout(WRITE_SECONDS):
                    await (self._socket.send_bytes(out) if isinstance(out, bytes) else self._socket.send_text(out))
        except TimeoutError:
            readers.cancel()
        except (WebSocketDisconnect, RuntimeError):
            return

    async def _watch_deletion(self, readers: anyio.CancelScope) -> None:
        await self._session.gone.wait()
        with suppress(WebSocketDisconnect, RuntimeError, TimeoutError):
            async with asyncio.timeout(WRITE_SECONDS):
                await self._socket.send_text(ErrorMessage(message=AssetGone().detail, fatal=True).model_dump_json())
        readers.cancel()

    async def _watch_overrun(self, readers: anyio.CancelScope) -> None:
        await self._outbox.overrun.wait()
        readers.cancel()

    async def _read(self, readers: anyio.CancelScope) -> None:
        try:
            while True:
                received = await self._socket.receive()
                if received["type"] == "websocket.disconnect":
                    return
                try:
                    message = client_message.validate_json(received.get("text") or "")
                except ValidationError as error:
                    if not self._complain(error):
                        return
                    continue
                await self._take(message)
        except (WebSocketDisconnect, RuntimeError):
            return
        finally:
            readers.cancel()

    def _complain(self, error: ValidationError) -> bool:
        """Say what is wrong with a message; False once there were too many of them."""
        first = error.errors(include_url=False, include_input=False, include_context=False)[0]
        place = ".".join(str(part) for part in first["loc"])[:MOST_PLACE] or "message"
        self._bad_messages += 1
        sentence = self._context.directory.told(f"{place}: {first['msg']}.")
        self._say(ErrorMessage(message=sentence, fatal=self._bad_messages >= MAX_BAD_MESSAGES))
        return self._bad_messages < MAX_BAD_MESSAGES

    async def _take(self, message: messages.ClientMessage) -> None:
        viewer = self.viewer
        match message:
            case CameraMessage():
                viewer.set_camera(message)
            case SettingsMessage():
                viewer.set_settings(message.settings)
            case AckMessage():
                viewer.acknowledge(message.frame_id)
            case VisibilityMessage():
                viewer.set_visible(message.visible)
                if not message.visible:
                    self._say(_loading().model_copy(update={"phase": "paused"}))
            case EditMessage() | SpliceMessage() | UndoMessage() | RedoMessage():
                await self._changes.put(_request_of(message), message.id)
            case PickMessage():
                await self._pick(message)
            case ExplainMessage():
                await self._explain(message)
            case LogMessage():
                self._outbox.put_log()
            case CancelMessage():
                self._context.sessions.cancel(self._session)
            case ClientHello():
                self._say(ErrorMessage(message="`hello` was said already."))
        self._context.render_thread.wake()

    async def _apply_changes(self, connection: anyio.CancelScope) -> None:
        while (waiting := await self._changes.take()) is not None:
            answer = await self._apply(waiting.request)
            for number in waiting.message_ids:
                self._say(answer.model_copy(update={"id": number}))
        connection.cancel()

    async def _apply(self, request: ChangeRequest) -> AcceptedMessage | RejectedMessage:
        """The answer; its id is still to be filled in."""
        try:
            applied = await self._context.sessions.apply(self._session, request, self._caller)
        except ProblemError as problem:
            return RejectedMessage(id=0, reason=self._context.directory.told(problem.detail), overtaken=isinstance(problem, Overtaken))
        except (SQLAlchemyError, OSError) as error:
            log.error("an edit could not be stored", exc_info=error)
            return RejectedMessage(id=0, reason=sentence_of(error) or "The edit could not be stored; is the disk full?")
        return AcceptedMessage(id=0, revision=applied.revision)

    async def _pick(self, message: PickMessage) -> None:
        picture = self.viewer.picture
        picked = None
        if picture is not None:
            picked = await asyncio.wrap_future(self._context.render_thread.call(lambda: picture.pick(message.x, message.y)))
        if picked is None:
            self._say(PickedMessage(id=message.id, hit=False))
        else:
            self._say(
                PickedMessage(
                    id=message.id,
                    hit=True,
                    position=picked.position,
                    normal=picked.normal,
                    albedo=picked.albedo,
                    roughness=picked.roughness,
                    metallic=picked.metallic,
                    region=picked.region,
                    rest=picked.rest,
                )
            )

    async def _explain(self, message: ExplainMessage) -> None:
        revision, picture, statistics = self.viewer.newest()
        explained = None
        if picture is not None:
            explained = await asyncio.wrap_future(self._context.render_thread.call(picture.explain))
        self._say(
            ExplainedMessage(
                id=message.id,
                revision=revision,
                samples=picture.samples if picture else 0,
                samples_target=picture.samples_target if picture else 0,
                seconds=explained.seconds if explained else {},
                skipped=[SkippedWork(what=what, why=why, bound=bound) for what, why, bound in explained.skipped] if explained else [],
                frames_sent=statistics.sent,
                frames_in_flight=statistics.in_flight,
                round_trip_ms=statistics.round_trip_ms,
            )
        )


def _request_of(message: ChangeMessage) -> ChangeRequest:
    match message:
        case EditMessage():
            return ChangeRequest("edit", message.edit, message.coalesce, message.key)
        case SpliceMessage():
            splice = Splice(message.start, message.remove, tuple(message.edits))
            return ChangeRequest("splice", splice, message.coalesce, message.key, message.revision)
        case UndoMessage() | RedoMessage():
            return ChangeRequest(message.type, key=message.key)
