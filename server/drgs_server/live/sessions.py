"""Live sessions: one asset, one ordered log of edits, any number of viewers. The log is on disk before an edit is acknowledged.

Loaded assets are kept while memory allows (`Limits.loaded_assets`, `loaded_bytes`); a session whose asset was unloaded, or whose server died, comes
back from its log the next time somebody looks at it.
"""

import asyncio
import logging
import re
import uuid
from collections import OrderedDict
from collections.abc import Callable, Coroutine, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from sqlalchemy import Engine, String, cast, delete, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session as DatabaseSession

from drgs.scene.edits import DeformEdit, Edit, EnvironmentEdit, MaterialEdit, PoseEdit, parse_edits, plain_edit
from drgs_server.api.environments import EnvironmentStore
from drgs_server.api.metrics import Metrics
from drgs_server.api.problems import ProblemError, artifact_problem
from drgs_server.live import messages
from drgs_server.live.admission import WAITING_SIMULATIONS, Admission, Caller, Place
from drgs_server.live.edit_log import Change, ChangeRequest, EditLog, EventKind, Splice
from drgs_server.live.pose_edits import PosedEdits, passes, pose_edits
from drgs_server.live.pose_work import PoseCancelled, PoseWork
from drgs_server.live.viewer import Posed, Viewer
from drgs_server.render.interface import AbstractLoadedAsset, AbstractRenderer
from drgs_server.render.settle_memory import settle_memory
from drgs_server.render.thread import RenderThread, give_way
from drgs_server.settings import Limits
from drgs_worker.store.artifact_store import ArtifactError
from drgs_worker.store.artifacts import has_clip, has_weights
from drgs_worker.store.asset_folder import folder_bytes
from drgs_worker.store.data_directory import DataDirectory
from drgs_worker.store.database import AssetRow, SessionEventRow, SessionRow, SnapshotRow, now

Result = TypeVar("Result")

LONG_LOG = 256
"""Edits in force from which on opening a session again begins with what was kept of its pose."""
KEEP_EVERY = 256
"""Changes of such a log after which it is kept anew."""
POSED_SESSIONS = 64
"""Whose pose stays in memory while nobody looks at them; others are posed again when somebody does."""

_CLIP = re.compile(r"clips/[0-9a-f]{32}")


class Overtaken(ProblemError):
    """The log was changed since the caller looked at it."""

    def __init__(self, found: int, expected: int) -> None:
        super().__init__(409, f"This session's edits were changed meanwhile (revision {found}, not {expected}); read them and send again.")


class AssetGone(ProblemError):
    """The session's asset was deleted, perhaps by another server on the same database."""

    def __init__(self) -> None:
        super().__init__(404, "The asset of this session was deleted; for a while it can be brought back.")


@dataclass(frozen=True)
class Applied:
    """Answer to a change of the log."""

    revision: int
    """Of the log with this change in it."""
    state: EditLog
    """With it; a later one when the change had been applied before and was sent again."""

    @property
    def log(self) -> messages.EditLog:
        """The state as callers see it."""
        return self.state.message()


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
    """Given the stream's message about every change of the log, which the log is after."""
    keys: dict[str, int] = field(default_factory=dict)
    """Revision that each client key was answered with."""
    work: PoseWork | None = None
    """Of the change that is being posed, so that it can be cancelled."""
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    """Held while the log changes: edits are applied in the order in which they came."""
    gone: asyncio.Event = field(default_factory=asyncio.Event)
    """Set once its asset was deleted: nothing is shown or applied here any more."""


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
        admission: Admission,
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
        self._asset_bytes: dict[str, int] = {}
        """Of the folders of loaded assets."""
        self._posed: OrderedDict[str, LiveSession] = OrderedDict()
        """Sessions with a pose in memory, the one used last at the end."""
        self._loading = asyncio.Lock()
        self._admission = admission
        # Loading and posing may take long (a simulation up to a late moment); the render thread goes on with other sessions meanwhile.
        threads = limits.poses_at_once + limits.simulations_at_once + WAITING_SIMULATIONS
        self._posing = ThreadPoolExecutor(threads, thread_name_prefix="pose", initializer=give_way)
        self._keeping = ThreadPoolExecutor(1, thread_name_prefix="keep", initializer=give_way)

    def close(self) -> None:
        """Poses under way are finished, those that wait are not begun."""
        self._posing.shutdown(wait=False, cancel_futures=True)
        self._keeping.shutdown(wait=True, cancel_futures=True)

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
            log, keys = _read_log(database, session_id)
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
        self._posed.pop(session_id, None)

        def forget() -> None:
            (self._directory.poses / f"{session_id}.safetensors").unlink(missing_ok=True)
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
        self._unload(asset_id)
        for session_id in [session.id for session in self._live.values() if session.asset_id == asset_id]:
            del self._live[session_id]

    async def forget_deleted(self) -> None:
        """What another server on the same database has deleted is not shown here either. Whoever looks at it is told."""
        wanted = {session.asset_id for session in self._live.values()}

        def there() -> set[str]:
            with DatabaseSession(self._engine) as database:
                return set(database.scalars(select(AssetRow.id).where(AssetRow.id.in_(wanted), AssetRow.deleted_at.is_(None))))

        for asset_id in wanted - await asyncio.to_thread(there) if wanted else ():
            for session in [session for session in self._live.values() if session.asset_id == asset_id]:
                session.gone.set()
            self.forget_asset(asset_id)

    def naming_clip(self, clip: str) -> list[str]:
        """Ids of the sessions that own a clip: their edits, those that undo or redo may bring back, or a snapshot name it. For any thread."""
        with DatabaseSession(self._engine) as database:
            of_logs = select(SessionEventRow.session_id).where(cast(SessionEventRow.edit, String).contains(clip))
            of_snapshots = select(SnapshotRow.session_id).where(cast(SnapshotRow.edits, String).contains(clip))
            found = set(database.scalars(of_snapshots.distinct()))
            for session_id in set(database.scalars(of_logs.distinct())) - found:
                log, _ = _read_log(database, session_id)  # what was undone and then written over is nobody's
                if any(isinstance(edit, PoseEdit) and edit.clip == clip for edit in log.reachable()):
                    found.add(session_id)
        return sorted(found)

    def cancel(self, session: LiveSession) -> None:
        """Give up the change that is being posed, if there is one: it is rejected, and the log stays as it is."""
        if session.work is not None:
            session.work.cancel()

    async def load(self, session: LiveSession, caller: Caller) -> Posed:
        """Bring the asset and the pose into memory. Edits that no longer apply are skipped (EditLog.broken).

        Raises:
            ProblemError: the asset cannot be read.
        """
        async with session.lock:
            return await self._load(session, caller)

    async def applied(self, session: LiveSession, caller: Caller) -> list[Edit]:
        """The edits in force that apply; whether one does is known once the asset is loaded.

        Raises:
            ProblemError: the asset cannot be read.
        """
        if session.log.done:
            await self.load(session, caller)
        return session.log.applied

    async def _load(self, session: LiveSession, caller: Caller) -> Posed:
        if session.posed is not None:
            self._posed.move_to_end(session.id)
            return session.posed
        async with self._loading:
            if session.asset_id not in self._loaded:
                folder, environments = self._directory.asset(session.asset_id), self._directory.environments

                def load() -> tuple[AbstractLoadedAsset, int]:
                    loaded = self._renderer.load(folder, environments)
                    settle_memory()
                    return loaded, folder_bytes(folder)

                new, self._asset_bytes[session.asset_id] = await self._call(lambda _: load(), caller)
                self._loaded[session.asset_id] = new
            loaded = self._loaded[session.asset_id]
            self._loaded.move_to_end(session.asset_id)
        edits = session.log.done
        is_long, path, recalled = len(edits) >= LONG_LOG, self._directory.poses / f"{session.id}.safetensors", False

        def pose(work: PoseWork) -> PosedEdits:
            nonlocal recalled
            recalled = is_long and loaded.recall(edits, path)
            return pose_edits(lambda kept: loaded.pose(kept, None, work.go_on), edits, lambda _: False, self._missing)

        posed = await self._pose(session, pose, caller)
        session.log = replace(session.log, broken=self._told(posed))
        session.loaded, session.posed = loaded, Posed(session.log.revision, posed.pose)
        self._make_room(session)
        if is_long and not recalled:
            self._keep_pose(session)
        return session.posed

    def _keep_pose(self, session: LiveSession) -> None:
        """Write what a long log has made so far, on a thread of its own; nobody waits for it."""
        loaded, edits, path = session.loaded, session.log.applied, self._directory.poses / f"{session.id}.safetensors"
        assert loaded is not None

        def keep() -> None:
            try:
                loaded.keep(edits, path)
            except (OSError, ValueError) as error:  # opening it takes longer then
                logging.getLogger(__name__).warning("a pose could not be kept: %s", error)

        self._keeping.submit(keep)

    def loaded_bytes(self) -> int:
        """Of assets in memory, and of the environments that they are shown under."""
        return sum(self._asset_bytes[name] for name in self._loaded) + self._renderer.environment_bytes()

    def _make_room(self, newest: LiveSession) -> None:
        """Let go of what was used least recently: environments that light nothing, then poses with theirs, then assets. What somebody looks at stays,
        and so does the session whose pose is new."""
        self._posed[newest.id] = newest
        self._posed.move_to_end(newest.id)
        if self.loaded_bytes() > self._limits.loaded_bytes:
            self._renderer.forget_environments()
        for session in [session for session in self._posed.values() if not session.viewers and session is not newest]:
            if len(self._posed) <= POSED_SESSIONS and self.loaded_bytes() <= self._limits.loaded_bytes:
                break
            session.posed = None
            del self._posed[session.id]
        for asset_id in list(self._loaded):
            if len(self._loaded) <= self._limits.loaded_assets and self.loaded_bytes() <= self._limits.loaded_bytes:
                return
            if asset_id != newest.asset_id and not self.uses(asset_id):
                self._unload(asset_id)

    def _unload(self, asset_id: str) -> None:
        self._loaded.pop(asset_id, None)
        for session in self._live.values():
            if session.asset_id == asset_id:
                session.loaded = session.posed = None
                self._posed.pop(session.id, None)

    async def _pose(self, session: LiveSession, function: Callable[[PoseWork], PosedEdits], caller: Caller) -> PosedEdits:
        """The caller holds the session's lock."""

        def begun(work: PoseWork) -> None:
            session.work = work

        try:
            return await self._call(function, caller, begun)
        finally:
            session.work = None

    async def _call(
        self, function: Callable[[PoseWork], Result], caller: Caller, begun: Callable[[PoseWork], None] = lambda work: None
    ) -> Result:
        """What the function returns, on a thread of its own once it is its turn. Cancelled, it ends at its next step."""
        place, loop = Place(self._admission, "pose", caller, 0), asyncio.get_running_loop()
        await place.enter()
        work = PoseWork(place)
        begun(work)

        def leave(_: object) -> None:
            with suppress(RuntimeError):  # the loop has ended, and with it all waiting
                loop.call_soon_threadsafe(place.leave)

        future = self._posing.submit(function, work)
        # The place is free when the thread is, which may be later than nobody wants its result any more.
        future.add_done_callback(leave)
        try:
            return await asyncio.wrap_future(future)
        except asyncio.CancelledError:
            work.cancel()
            raise
        except PoseCancelled as error:
            raise ProblemError(409, "This change was cancelled while it was computed; everything is as before.") from error
        except ValueError as error:
            raise ProblemError(422, str(error)) from error
        except ArithmeticError as error:
            raise ProblemError(422, f"The edits hold numbers that cannot be computed with ({error}).") from error

    async def apply(self, session: LiveSession, request: ChangeRequest, caller: Caller = (), kept: bool = False) -> Applied:
        """One change of the log: posed, then stored, then shown to all viewers. Cancelled before it is stored, it leaves no trace; while it is, it
        is finished first.

        Args:
            kept: the edits were in the log before: those that no longer apply are skipped like others of the log.

        Raises:
            Overtaken: the log has another revision; it is as before.
            ProblemError: a sentence; the log is as before.
        """
        brought = [] if kept else await self._checked(session, _edits_of(request.change))
        async with session.lock:
            if request.key is not None and request.key in session.keys:
                return Applied(session.keys[request.key], session.log)
            posed = await self._load(session, caller)
            kind, log = session.log.event_of(request), self._changed_log(session.log, request)
            loaded, before = session.loaded, session.log.done
            assert loaded is not None

            def is_new(edit: Edit) -> bool:
                return any(edit is other for other in brought) and edit not in before

            def pose(work: PoseWork) -> PosedEdits:
                return pose_edits(lambda kept: loaded.pose(kept, posed.pose, work.go_on), log.done, is_new, self._missing)

            after = await self._pose(session, pose, caller)
            return await _finished(self._commit(session, request, kind, log, after))

    async def _checked(self, session: LiveSession, edits: Sequence[Edit]) -> list[Edit]:
        """Those of a change whose files are there. Others may be in the log already, and then stay.

        Raises:
            ProblemError: one that is not refers to what is not there.
        """
        whole: list[Edit] = []
        for edit in edits:
            try:
                if isinstance(edit, PoseEdit) or (isinstance(edit, MaterialEdit) and edit.select.weights_file):  # may have to be fetched
                    await asyncio.to_thread(self.check_edit, edit)
                else:
                    self.check_edit(edit)
            except ProblemError as problem:
                if passes(problem) or edit not in session.log.done:
                    raise
                continue
            whole.append(edit)
        return whole

    def _missing(self, edit: Edit) -> str | None:
        """Why what an edit refers to is not there, if so.

        Raises:
            ProblemError: the store that machines share is away.
        """
        try:
            self.check_edit(edit)
        except ProblemError as problem:
            if passes(problem):
                raise
            return problem.detail
        return None

    def _told(self, posed: PosedEdits) -> dict[int, str]:
        """What callers hear of the edits that were left out."""
        return {place: self._directory.told(reason) for place, reason in posed.broken.items()}

    async def _commit(self, session: LiveSession, request: ChangeRequest, kind: EventKind, log: EditLog, posed: PosedEdits) -> Applied:
        try:
            await asyncio.to_thread(self._store, session.id, log.revision, kind, request)
        except AssetGone:
            session.gone.set()
            self.forget_asset(session.asset_id)
            raise
        except IntegrityError as error:
            self._live.pop(session.id, None)
            self._posed.pop(session.id, None)
            raise ProblemError(409, "Another server changed this session meanwhile; open it again.") from error
        if request.key is not None:
            session.keys[request.key] = log.revision
        log = replace(log, broken=self._told(posed))
        before, session.log, session.posed = session.log, log, Posed(log.revision, posed.pose)
        self._make_room(session)
        if log.revision % KEEP_EVERY == 0 and len(log.done) >= LONG_LOG:
            self._keep_pose(session)
        self._metrics.edits.labels(kind=kind).inc()
        self._show(session, before)
        return Applied(log.revision, log)

    def _changed_log(self, log: EditLog, request: ChangeRequest) -> EditLog:
        """The log with the request in it.

        Raises:
            Overtaken: the request counts in a log of another revision.
            ProblemError: it does not fit the log.
        """
        if request.revision is not None and request.revision != log.revision:
            raise Overtaken(log.revision, request.revision)
        try:
            changed = log.with_request(request)
        except ValueError as error:
            raise ProblemError(409, str(error)) from error
        if len(changed.done) > max(self._limits.edits, len(log.done)):
            raise ProblemError(422, f"A session has at most {self._limits.edits} edits in force.")
        return changed

    def _show(self, session: LiveSession, before: EditLog) -> None:
        """To all viewers: what has changed in the log, and a picture of it as soon as there is one."""
        for viewer in session.viewers:
            viewer.scene_changed()
        self._thread.wake()
        if session.listeners:
            change = session.log.change_since(before).model_dump_json()  # once for all
            for listener in list(session.listeners):
                listener(change)

    def _store(self, session_id: str, revision: int, kind: EventKind, request: ChangeRequest) -> None:
        change = request.change
        values: object = None
        if isinstance(change, Splice):
            values = {"start": change.start, "remove": change.remove, "edits": [plain_edit(edit) for edit in change.edits]}
        elif isinstance(change, Sequence):
            values = [plain_edit(edit) for edit in change]
        elif change is not None:
            values = plain_edit(change)
        with DatabaseSession(self._engine) as database, database.begin():
            database.add(SessionEventRow(session_id=session_id, revision=revision, kind=kind, edit=values, client_key=request.key))
            database.flush()  # first, so that what is read now holds until the end of this
            there = select(AssetRow.id).join(SessionRow, SessionRow.asset_id == AssetRow.id)
            if database.scalar(there.where(SessionRow.id == session_id, AssetRow.deleted_at.is_(None))) is None:
                raise AssetGone

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

    async def restore(self, session: LiveSession, name: str, key: str | None = None, caller: Caller = ()) -> Applied:
        """Put a snapshot's edits in place of those in force.

        Raises:
            ProblemError: 404.
        """
        row = await self._snapshot(session.id, name)
        return await self.apply(session, ChangeRequest("restore", parse_edits(row.edits), key=key), caller, kept=True)

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
        if isinstance(edit, MaterialEdit) and edit.select.weights_file is not None and not self._has_weights(edit.select.weights_file):
            raise ProblemError(422, f"There are no weights {edit.select.weights_file[:100]!r}; POST them to /api/weights first.")
        if isinstance(edit, PoseEdit) and not self._has_clip(edit.clip):
            raise ProblemError(422, f"There is no clip {edit.clip[:100]!r}; a simulate job that is done names its clip.")

    def _has_weights(self, name: str) -> bool:
        try:
            return has_weights(self._directory, name)
        except ArtifactError as error:
            raise artifact_problem(error) from error

    def _has_clip(self, clip: str) -> bool:
        try:
            return _CLIP.fullmatch(clip) is not None and has_clip(self._directory, clip)
        except ArtifactError as error:
            raise artifact_problem(error) from error


async def _finished(work: Coroutine[Any, Any, Result]) -> Result:
    """What the work returns; who is cancelled meanwhile waits for its end first."""
    task = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.wait({task})
        raise


def _read_log(database: DatabaseSession, session_id: str) -> tuple[EditLog, dict[str, int]]:
    """A session's log by its events, and the revision that each client key was answered with."""
    events = database.scalars(select(SessionEventRow).where(SessionEventRow.session_id == session_id).order_by(SessionEventRow.revision))
    log, keys = EditLog(), {}
    for event in events:
        log = log.after(event.kind, _change_of(event))  # type: ignore[arg-type]
        if event.client_key is not None:
            keys[event.client_key] = event.revision
    return log, keys


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
