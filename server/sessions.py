"""Live sessions: one asset, one ordered log of edits, any number of viewers. The log is on disk before an edit is acknowledged.

Loaded assets are kept while memory allows (`Limits.loaded_assets`, `loaded_bytes`); a session whose asset was unloaded, or whose server died, comes
back from its log the next time somebody looks at it.
"""

import asyncio
import re
import uuid
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TypeVar

from sqlalchemy import Engine, delete, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session as DatabaseSession

from drgs.scene.edits import DeformEdit, Edit, EnvironmentEdit, PoseEdit, parse_edits
from server import messages
from server.edit_log import Change, EditLog, EventKind, Splice
from server.environments import EnvironmentStore
from server.metrics import Metrics
from server.problems import ProblemError, artifact_problem
from server.render_session import AbstractLoadedAsset, AbstractRenderer
from server.render_thread import RenderThread, give_way
from server.settings import Limits
from server.settle_memory import settle_memory
from server.viewer import Posed, Viewer
from worker.artifact_store import ArtifactError
from worker.artifacts import has_clip
from worker.asset_folder import folder_bytes
from worker.data_directory import DataDirectory
from worker.database import AssetRow, SessionEventRow, SessionRow, SnapshotRow, now
from worker.save_version import plain_edit

Result = TypeVar("Result")

POSING_THREADS = 4
"""Sessions whose edits are posed at the same time; each session's own come one after the other."""

_CLIP = re.compile(r"clips/[0-9a-f]{32}")


class Overtaken(ProblemError):
    """The log was changed since the caller looked at it."""

    def __init__(self, found: int, expected: int) -> None:
        super().__init__(409, f"This session's edits were changed meanwhile (revision {found}, not {expected}); read them and send again.")


@dataclass(frozen=True)
class Applied:
    """Answer to a change of the log."""

    revision: int
    """Of the log with this change in it."""
    log: messages.EditLog
    """With it; a later one when the change had been applied before and was sent again."""


@dataclass(eq=False)
class LiveSession:
    """State of one session in this process. Everything but `posed` is touched on the event loop only."""

    id: str
    asset_id: str
    asset_name: str
    created_at: float
    log: EditLog
    posed: Posed | None = None
    """None while the asset is not in memory; read by the render thread."""
    loaded: AbstractLoadedAsset | None = None
    viewers: set[Viewer] = field(default_factory=set)
    listeners: set[Callable[[str], None]] = field(default_factory=set)
    """Given the stream's message about every change of the log."""
    keys: dict[str, int] = field(default_factory=dict)
    """Revision that each client key was answered with."""
    coalesce: str | None = None
    """Of the newest change: the next one with the same key belongs to the same gesture."""
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    """Held while the log changes: edits are applied in the order in which they came."""


class SessionRegistry:
    """Final. All methods are called on the event loop."""

    def __init__(
        self,
        directory: DataDirectory,
        engine: Engine,
        renderer: AbstractRenderer,
        render_thread: RenderThread,
        environments: EnvironmentStore,
        limits: Limits,
        metrics: Metrics,
    ) -> None:
        self._directory = directory
        self._engine = engine
        self._renderer = renderer
        self._thread = render_thread
        self._environments = environments
        self._limits = limits
        self._metrics = metrics
        self._live: dict[str, LiveSession] = {}
        self._loaded: OrderedDict[str, AbstractLoadedAsset] = OrderedDict()
        self._loading = asyncio.Lock()
        # Loading and posing may take long (a simulation up to a late moment); the render thread goes on with other sessions meanwhile.
        self._posing = ThreadPoolExecutor(POSING_THREADS, thread_name_prefix="pose", initializer=give_way)

    def close(self) -> None:
        """Poses under way are finished, those that wait are not begun."""
        self._posing.shutdown(wait=False, cancel_futures=True)

    async def create(self, asset_id: str) -> LiveSession:
        """
        Raises:
            ProblemError: no such asset, or too many sessions.
        """
        return await asyncio.to_thread(self._create, asset_id)

    def _create(self, asset_id: str) -> LiveSession:
        with DatabaseSession(self._engine) as database, database.begin():
            asset = database.get(AssetRow, asset_id)
            if asset is None or asset.deleted_at is not None:
                raise ProblemError(404, f"No asset has the id {asset_id[:64]!r}.")
            if len(database.scalars(select(SessionRow.id)).all()) >= self._limits.sessions:
                raise ProblemError(429, f"There are {self._limits.sessions} sessions already; delete one first.")
            row = SessionRow(id=uuid.uuid4().hex, asset_id=asset_id, created_at=now())
            database.add(row)
            session = LiveSession(row.id, asset_id, asset.name, row.created_at, EditLog())
        self._live[session.id] = session
        return session

    async def get(self, session_id: str) -> LiveSession:
        """The live one, or one replayed from its log.

        Raises:
            ProblemError: 404.
        """
        found = self._live.get(session_id)
        if found is None:
            replayed = await asyncio.to_thread(self._replay, session_id)
            found = self._live.setdefault(session_id, replayed)
        return found

    def _replay(self, session_id: str) -> LiveSession:
        with DatabaseSession(self._engine) as database:
            row = database.get(SessionRow, session_id)
            asset = database.get(AssetRow, row.asset_id) if row else None
            if row is None or asset is None or asset.deleted_at is not None:
                raise ProblemError(404, f"No session has the id {session_id[:64]!r}.")
            events = database.scalars(
                select(SessionEventRow).where(SessionEventRow.session_id == session_id).order_by(SessionEventRow.revision)
            ).all()
            log, keys = EditLog(), {}
            for event in events:
                log = log.after(event.kind, _change_of(event))  # type: ignore[arg-type]
                if event.client_key is not None:
                    keys[event.client_key] = event.revision
            return LiveSession(row.id, row.asset_id, asset.name, row.created_at, log, keys=keys)

    async def all(self) -> list[LiveSession]:
        """Newest first."""

        def ids() -> list[str]:
            with DatabaseSession(self._engine) as database:
                there = select(SessionRow.id).join(AssetRow, AssetRow.id == SessionRow.asset_id).where(AssetRow.deleted_at.is_(None))
                return list(database.scalars(there.order_by(SessionRow.created_at.desc()).limit(100)))

        found: list[LiveSession] = []
        for session_id in await asyncio.to_thread(ids):
            live = self._live.get(session_id)
            # Replayed ones are not kept: they may live in another server, whose changes would not arrive here.
            found.append(live if live is not None else await asyncio.to_thread(self._replay, session_id))
        return found

    def any(self) -> bool:
        """Whether there are sessions that somebody may come back to."""
        with DatabaseSession(self._engine) as database:
            return database.scalars(select(SessionRow.id).limit(1)).first() is not None

    async def remove(self, session_id: str) -> None:
        """
        Raises:
            ProblemError: 404, or 409 while somebody looks at it.
        """
        session = await self.get(session_id)
        if session.viewers:
            raise ProblemError(409, "Somebody is looking at this session; close the viewer first.")
        self._live.pop(session_id, None)

        def forget() -> None:
            with DatabaseSession(self._engine) as database, database.begin():
                database.execute(delete(SessionEventRow).where(SessionEventRow.session_id == session_id))
                database.execute(delete(SnapshotRow).where(SnapshotRow.session_id == session_id))
                database.execute(delete(SessionRow).where(SessionRow.id == session_id))

        await asyncio.to_thread(forget)

    def viewer_count(self) -> int:
        return sum(len(session.viewers) for session in list(self._live.values()))

    def live_count(self) -> int:
        return len(self._live)

    def loaded_count(self) -> int:
        return len(self._loaded)

    def uses(self, asset_id: str) -> bool:
        """Whether somebody looks at this asset."""
        return any(session.asset_id == asset_id and session.viewers for session in self._live.values())

    def forget_asset(self, asset_id: str) -> None:
        """The asset was deleted, and its sessions with it: nobody finds them any more."""
        self._loaded.pop(asset_id, None)
        for session_id in [session.id for session in self._live.values() if session.asset_id == asset_id]:
            del self._live[session_id]

    async def load(self, session: LiveSession) -> Posed:
        """Bring the asset and the pose into memory.

        Raises:
            ProblemError: the asset cannot be read, or its edits no longer apply.
        """
        async with session.lock:
            return await self._load(session)

    async def _load(self, session: LiveSession) -> Posed:
        if session.posed is not None:
            return session.posed
        async with self._loading:
            if session.asset_id not in self._loaded:
                folder, environments = self._directory.asset(session.asset_id), self._directory.environments

                def load() -> AbstractLoadedAsset:
                    loaded = self._renderer.load(folder, environments)
                    settle_memory()
                    return loaded

                self._loaded[session.asset_id] = await self._call(load)
            loaded = self._loaded[session.asset_id]
            self._loaded.move_to_end(session.asset_id)
            self._unload_some()
        edits = session.log.done
        pose = await self._call(lambda: loaded.pose(edits, None))
        session.loaded, session.posed = loaded, Posed(session.log.revision, pose)
        return session.posed

    def _unload_some(self) -> None:
        """The least recently used first; one that somebody looks at stays, and so does the newest."""
        for asset_id in list(self._loaded)[:-1]:
            used = sum(folder_bytes(self._directory.asset(name)) for name in self._loaded)
            if len(self._loaded) <= self._limits.loaded_assets and used <= self._limits.loaded_bytes:
                return
            if not self.uses(asset_id):
                del self._loaded[asset_id]
                for session in self._live.values():
                    if session.asset_id == asset_id:
                        session.loaded = session.posed = None

    async def _call(self, function: Callable[[], Result]) -> Result:
        try:
            return await asyncio.get_running_loop().run_in_executor(self._posing, function)
        except ValueError as error:
            raise ProblemError(422, str(error)) from error

    async def apply(
        self,
        session: LiveSession,
        kind: EventKind,
        change: Change | None = None,
        coalesce: str | None = None,
        key: str | None = None,
        revision: int | None = None,
    ) -> Applied:
        """One change of the log: posed, then stored, then shown to all viewers.

        Args:
            change: the edit, the splice, or what `restore` brings.
            key: of the client; a change whose key is known already is not applied again.
            revision: of the log that the change is meant for; None for whichever there is.

        Raises:
            Overtaken: the log has another revision; it is as before.
            ProblemError: a sentence; the log is as before.
        """
        for edit in _edits_of(change):
            if isinstance(edit, PoseEdit):  # may have to be fetched
                await asyncio.to_thread(self.check_edit, edit)
            else:
                self.check_edit(edit)
        async with session.lock:
            if key is not None and key in session.keys:
                return Applied(session.keys[key], session.log.message())
            posed = await self._load(session)
            if revision is not None and revision != session.log.revision:
                raise Overtaken(session.log.revision, revision)
            same_gesture = coalesce is not None and coalesce == session.coalesce
            if kind in ("edit", "splice") and change is not None and same_gesture and session.log.can_replace(change):
                kind = "replace"
            try:
                log = session.log.after(kind, change)
            except ValueError as error:
                raise ProblemError(409, str(error)) from error
            if len(log.done) > max(self._limits.edits, len(session.log.done)):
                raise ProblemError(422, f"A session has at most {self._limits.edits} edits in force.")
            loaded = session.loaded
            assert loaded is not None
            pose = await self._call(lambda: loaded.pose(log.done, posed.pose))
            try:
                await asyncio.to_thread(self._store, session.id, log.revision, kind, change, key)
            except IntegrityError as error:
                self._live.pop(session.id, None)
                raise ProblemError(409, "Another server changed this session meanwhile; open it again.") from error
            if key is not None:
                session.keys[key] = log.revision
            session.log, session.posed = log, Posed(log.revision, pose)
            session.coalesce = coalesce
        for viewer in session.viewers:
            viewer.scene_changed()
        self._thread.wake()
        self._metrics.add("drgs_edits_total", kind=kind)
        message = log.message()
        if session.listeners:
            state = messages.StateMessage(log=message).model_dump_json()  # once for all: a long log takes milliseconds
            for listener in list(session.listeners):
                listener(state)
        return Applied(log.revision, message)

    def _store(self, session_id: str, revision: int, kind: str, change: Change | None, key: str | None) -> None:
        values: object = None
        if isinstance(change, Splice):
            values = {"start": change.start, "remove": change.remove, "edits": [plain_edit(edit) for edit in change.edits]}
        elif isinstance(change, Sequence):
            values = [plain_edit(edit) for edit in change]
        elif change is not None:
            values = plain_edit(change)
        with DatabaseSession(self._engine) as database, database.begin():
            database.add(SessionEventRow(session_id=session_id, revision=revision, kind=kind, edit=values, client_key=key))

    # ---- snapshots ---------------------------------------------------------------------------------------------------

    async def snapshots(self, session_id: str) -> list[SnapshotRow]:
        """Oldest first.

        Raises:
            ProblemError: 404.
        """
        await self.get(session_id)

        def read() -> list[SnapshotRow]:
            with DatabaseSession(self._engine) as database:
                wanted = select(SnapshotRow).where(SnapshotRow.session_id == session_id).order_by(SnapshotRow.created_at)
                return list(database.scalars(wanted))

        return await asyncio.to_thread(read)

    async def take_snapshot(self, session_id: str, name: str) -> SnapshotRow:
        """
        Raises:
            ProblemError: 404, or there are too many.
        """
        session = await self.get(session_id)
        taken = await self.snapshots(session_id)
        if len(taken) >= self._limits.snapshots and name not in {row.name for row in taken}:
            raise ProblemError(422, f"A session has at most {self._limits.snapshots} snapshots; delete one first.")
        log = session.log
        row = SnapshotRow(
            session_id=session_id,
            name=name,
            created_at=now(),
            revision=log.revision,
            edits=[plain_edit(edit) for edit in log.done],
        )

        def store() -> SnapshotRow:
            with DatabaseSession(self._engine, expire_on_commit=False) as database, database.begin():
                return database.merge(row)

        return await asyncio.to_thread(store)

    async def restore(self, session: LiveSession, name: str, key: str | None = None) -> Applied:
        """Put a snapshot's edits in place of those in force.

        Raises:
            ProblemError: 404, or its edits no longer apply.
        """
        row = await self._snapshot(session.id, name)
        return await self.apply(session, "restore", parse_edits(row.edits), key=key)

    async def delete_snapshot(self, session_id: str, name: str) -> None:
        """
        Raises:
            ProblemError: 404.
        """
        row = await self._snapshot(session_id, name)

        def forget() -> None:
            with DatabaseSession(self._engine) as database, database.begin():
                database.delete(row)

        await asyncio.to_thread(forget)

    async def _snapshot(self, session_id: str, name: str) -> SnapshotRow:
        found = next((row for row in await self.snapshots(session_id) if row.name == name), None)
        if found is None:
            raise ProblemError(404, f"This session has no snapshot {name[:80]!r}.")
        return found

    def check_edit(self, edit: Edit) -> None:
        """Edits from a network name nothing but what the server keeps.

        Raises:
            ProblemError: it does.
        """
        if isinstance(edit, EnvironmentEdit) and edit.file is not None and not self._environments.has(edit.file):
            raise ProblemError(422, f"No environment is called {edit.file[:100]!r}; GET /api/environments lists them.")
        if isinstance(edit, DeformEdit) and edit.vertices is not None:
            raise ProblemError(
                422, "A deform edit over the network has a `map` or `handles`; `vertices` names a file and works with `drgs render` only."
            )
        if isinstance(edit, PoseEdit) and not self._has_clip(edit.clip):
            raise ProblemError(422, f"There is no clip {edit.clip[:100]!r}; a simulate job that is done names its clip.")

    def _has_clip(self, clip: str) -> bool:
        try:
            return _CLIP.fullmatch(clip) is not None and has_clip(self._directory, clip)
        except ArtifactError as error:
            raise artifact_problem(error) from error


def _edits_of(change: Change | None) -> Sequence[Edit]:
    if isinstance(change, Splice):
        return change.edits
    return change if isinstance(change, Sequence) else [change] if change is not None else []


def _change_of(event: SessionEventRow) -> Change | None:
    values = event.edit
    if isinstance(values, list):
        return parse_edits(values)
    if values is None:
        return None
    if "start" in values:
        return Splice(values["start"], values["remove"], tuple(parse_edits(values["edits"])))
    return parse_edits([values])[0]
