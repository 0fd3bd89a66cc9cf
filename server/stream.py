"""WebSocket /api/sessions/{id}/stream: one connection between a client and the viewer made for it (docs/protocol.md)."""

import asyncio
import logging
from contextlib import suppress

import anyio
from fastapi import APIRouter, WebSocket, WebSocketDisconnect
from pydantic import BaseModel, ValidationError
from sqlalchemy.exc import SQLAlchemyError

from drgs import __version__
from server import messages
from server.context import ServerContext
from server.edit_log import Splice
from server.messages import (
    CLOSE_POLICY,
    CLOSE_VERSION_MISMATCH,
    PROTOCOL_VERSION,
    AcceptedMessage,
    AckMessage,
    CameraMessage,
    ClientHello,
    EditMessage,
    ErrorMessage,
    ExplainedMessage,
    ExplainMessage,
    PickedMessage,
    PickMessage,
    RedoMessage,
    RejectedMessage,
    ServerHello,
    SettingsMessage,
    SkippedWork,
    SpliceMessage,
    StatusMessage,
    UndoMessage,
    VisibilityMessage,
    client_message,
    unpack_frame,
)
from server.problems import ProblemError
from server.sessions import Applied, LiveSession, Overtaken
from server.viewer import Viewer

HELLO_SECONDS = 20.0
MAX_WAITING_CHANGES = 256
"""Edits that a client may have under way; beyond that its messages wait in its own socket."""
MAX_WAITING_MESSAGES = 2000
"""Unsent text messages after which a client that does not read is let go."""
MAX_BAD_MESSAGES = 50

log = logging.getLogger(__name__)
router = APIRouter()

Change = EditMessage | SpliceMessage | UndoMessage | RedoMessage


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
        await context.sessions.load(session)
    except ProblemError as problem:
        await _refuse(socket, problem.detail, CLOSE_POLICY)
        return
    except (WebSocketDisconnect, RuntimeError):
        return
    await Connection(context, socket, session, hello).run()


async def _receive_hello(socket: WebSocket) -> ClientHello | None:
    try:
        text = await asyncio.wait_for(socket.receive_text(), HELLO_SECONDS)
        message = client_message.validate_json(text)
    except (ValidationError, TimeoutError, KeyError):
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
        self._loop = asyncio.get_running_loop()
        self._outgoing: asyncio.Queue[str | bytes] = asyncio.Queue()
        self._changes: asyncio.Queue[Change | None] = asyncio.Queue(MAX_WAITING_CHANGES)
        """None: no more will come."""
        self._overrun = asyncio.Event()
        self._bad_messages = 0
        self.viewer = Viewer(self._deliver, lambda: session.posed, decodes_png="png" in hello.codecs)

    async def run(self) -> None:
        """Until one side goes away."""
        session, thread = self._session, self._context.render_thread
        loaded = session.loaded
        if loaded is None:
            return
        self._say(
            ServerHello(
                server=__version__,
                session=session.id,
                asset=session.asset_id,
                minimum=loaded.bounds.minimum,
                maximum=loaded.bounds.maximum,
                start_view=loaded.start_view,
                log=session.log.message(),
                settings=self.viewer.settings,
            )
        )
        session.viewers.add(self.viewer)
        session.listeners.add(self._enqueue)
        self._context.connections[self.viewer] = self
        thread.add(self.viewer)
        try:
            async with anyio.create_task_group() as group:
                group.start_soon(self._write)
                group.start_soon(self._apply_changes, group.cancel_scope)
                async with anyio.create_task_group() as readers:
                    readers.start_soon(self._read, readers.cancel_scope)
                    readers.start_soon(self._watch_overrun, readers.cancel_scope)
                # Changes that the client has sent are applied even though it will not hear of them: an edit is never dropped.
                await self._changes.put(None)
        finally:
            thread.remove(self.viewer)
            session.viewers.discard(self.viewer)
            session.listeners.discard(self._enqueue)
            self._context.connections.pop(self.viewer, None)
        with suppress(WebSocketDisconnect, RuntimeError):
            await self._socket.close(CLOSE_POLICY if self._overrun.is_set() or self._bad_messages >= MAX_BAD_MESSAGES else 1000)

    def tell_error(self, sentence: str) -> None:
        """From any thread."""
        self._loop.call_soon_threadsafe(self._say, ErrorMessage(message=sentence))

    def _deliver(self, out: bytes | StatusMessage) -> None:
        """From the render thread."""
        if isinstance(out, bytes):
            metrics = self._context.metrics
            metrics.add("drgs_frames_total")
            metrics.add("drgs_frame_bytes_total", len(out))
            metrics.add("drgs_render_seconds_total", unpack_frame(out)[0].render_us / 1e6)
        self._loop.call_soon_threadsafe(self._enqueue, out if isinstance(out, bytes) else out.model_dump_json())

    def _say(self, message: BaseModel) -> None:
        self._enqueue(message.model_dump_json())

    def _enqueue(self, out: str | bytes) -> None:
        self._outgoing.put_nowait(out)
        if self._outgoing.qsize() > MAX_WAITING_MESSAGES:
            self._overrun.set()

    async def _write(self) -> None:
        with suppress(WebSocketDisconnect, RuntimeError):
            while True:
                out = await self._outgoing.get()
                await (self._socket.send_bytes(out) if isinstance(out, bytes) else self._socket.send_text(out))

    async def _watch_overrun(self, readers: anyio.CancelScope) -> None:
        await self._overrun.wait()
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
        place = ".".join(str(part) for part in first["loc"]) or "message"
        self._bad_messages += 1
        self._say(ErrorMessage(message=f"{place}: {first['msg']}.", fatal=self._bad_messages >= MAX_BAD_MESSAGES))
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
                await self._changes.put(message)
            case PickMessage():
                await self._pick(message)
            case ExplainMessage():
                await self._explain(message)
            case ClientHello():
                self._say(ErrorMessage(message="`hello` was said already."))
        self._context.render_thread.wake()

    async def _apply_changes(self, connection: anyio.CancelScope) -> None:
        following: Change | None = None
        last = False
        while not last or following is not None:
            change, following = following or await self._changes.get(), None
            if change is None:
                break
            answered = [change.id]
            # A drag sends edits faster than they can be posed: those that the next one replaces anyway are answered with it.
            # One with a key is stored under it, so that it is known when it is sent again.
            while isinstance(change, EditMessage) and change.coalesce is not None and change.key is None and not self._changes.empty():
                following = self._changes.get_nowait()
                last = following is None
                if not isinstance(following, EditMessage) or following.coalesce != change.coalesce:
                    break
                change, following = following, None
                answered.append(change.id)
            try:
                applied = await self._apply(change)
            except ProblemError as problem:
                for number in answered:
                    self._say(RejectedMessage(id=number, reason=problem.detail, overtaken=isinstance(problem, Overtaken)))
            except SQLAlchemyError as error:
                log.error("an edit could not be stored", exc_info=error)
                for number in answered:
                    self._say(RejectedMessage(id=number, reason="The edit could not be stored; is the disk full?"))
            else:
                for number in answered:
                    self._say(AcceptedMessage(id=number, revision=applied.revision))
        connection.cancel()

    async def _apply(self, change: Change) -> Applied:
        sessions, session = self._context.sessions, self._session
        match change:
            case EditMessage():
                return await sessions.apply(session, "edit", change.edit, change.coalesce, change.key)
            case SpliceMessage():
                splice = Splice(change.start, change.remove, tuple(change.edits))
                return await sessions.apply(session, "splice", splice, change.coalesce, change.key, change.revision)
            case UndoMessage() | RedoMessage():
                return await sessions.apply(session, change.type, key=change.key)

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
