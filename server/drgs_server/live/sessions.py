"""Live sessions: one asset, one ordered log of edits, any number of viewers. The log is on disk before an edit is acknowledged.

Loaded assets are kept while memory allows (`Limits.loaded_assets`, `loaded_bytes`); a session whose asset was unloaded, or whose server died, comes
back from its log the next time somebody looks at it.
"""

import asyncio
import logging
from collections import OrderedDict
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from sqlalchemy import Engine

from drgs.scene.edits import Edit, parse_kept_edits
from drgs_server.api.environments import EnvironmentStore
from drgs_server.api.metrics import Metrics
from drgs_server.api.problems import ProblemError
from drgs_server.live.admission import Admission, Caller
from drgs_server.live.edit_log import ChangeRequest, EditLog, EventKind
from drgs_server.live.edit_references import EditReferences
from drgs_server.live.live_session import Applied, LiveSession, Overtaken
from drgs_server.live.pose_edits import PosedEdits, passes, pose_edits
from drgs_server.live.pose_work import PoseThreads, PoseWork
from drgs_server.live.session_store import AssetGone, ChangedElsewhere, SessionStore, StoredSession
from drgs_server.live.viewer import Posed
from drgs_server.render.interface import AbstractLoadedAsset, AbstractRenderer
from drgs_server.render.settle_memory import settle_memory
from drgs_server.render.thread import RenderThread
from drgs_server.settings import Limits
from drgs_worker.store.asset_folder import folder_bytes
from drgs_worker.store.data_directory import DataDirectory
from drgs_worker.store.database import SnapshotRow

Result = TypeVar("Result")

LONG_LOG = 256
"""Edits in force from which on opening a session again begins with what was kept of its pose."""
KEEP_EVERY = 256
"""Changes of such a log after which it is kept anew."""
POSED_SESSIONS = 64
"""Whose pose stays in memory while nobody looks at them; others are posed again when somebody does."""
FEW_POSED_SESSIONS = 8
"""Whose pose stays longer than simulations that nobody asked for last."""


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
        self._store = SessionStore(engine, limits)
        self.references = EditReferences(directory, environments)
        self._renderer = renderer
        self._thread = render_thread
        self._limits = limits
        self._metrics = metrics
        self._live: dict[str, LiveSession] = {}
        self._loaded: OrderedDict[str, AbstractLoadedAsset] = OrderedDict()
        self._asset_bytes: dict[str, int] = {}
        """Of the folders of loaded assets."""
        self._posed: OrderedDict[str, LiveSession] = OrderedDict()
        """Sessions with a pose in memory, the one used last at the end."""
        self._loading = asyncio.Lock()
        self._prepared = False
        self._threads = PoseThreads(limits, admission)

    def close(self) -> None:
        """Poses under way are finished, those that wait are not begun."""
        self._threads.close()

    async def create(self, asset_id: str) -> LiveSession:
        """
        Raises:
            ProblemError: no such asset, or too many sessions.
        """
        session = _live(await asyncio.to_thread(self._store.create, asset_id))
        self._live[session.id] = session
        return session

    async def get(self, session_id: str) -> LiveSession:
        """The live one, or one replayed from its log.

        Raises:
            ProblemError: 404.
        """
        found = self._live.get(session_id)
        if found is None:
            replayed = _live(await asyncio.to_thread(self._store.read, session_id))
            found = self._live.setdefault(session_id, replayed)
        return found

    async def all(self) -> list[LiveSession]:
        """Newest first."""
        found: list[LiveSession] = []
        for session_id in await asyncio.to_thread(self._store.newest_ids):
            live = self._live.get(session_id)
            # Replayed ones are not kept: they may live in another server, whose changes would not arrive here.
            try:
                found.append(live if live is not None else _live(await asyncio.to_thread(self._store.read, session_id)))
            except ProblemError as problem:  # deleted meanwhile, or damaged: no reason to hide the others
                logging.getLogger(__name__).warning("the session %s is not listed: %s", session_id, problem.detail)
        return found

    async def prepare_if_any(self) -> None:
        """The renderer, where there are assets that somebody may open."""
        if await asyncio.to_thread(self._store.any_asset):
            self.prepare_soon()

    def prepare_soon(self) -> None:
        """The renderer, on a thread of its own, once: somebody is about to have an asset, and shall not wait two seconds more for its first picture."""
        if not self._prepared:
            self._prepared = True
            asyncio.get_running_loop().run_in_executor(None, self._renderer.prepare)

    async def remove(self, session_id: str) -> None:
        """
        Raises:
            ProblemError: 404, or 409 while somebody looks at it.
        """
        session = self._live.get(session_id)
        if session is None:
            await asyncio.to_thread(self._store.check_there, session_id)  # whatever its log is like
        elif session.viewers:
            raise ProblemError(409, "Somebody is looking at this session; close the viewer first.")
        self._live.pop(session_id, None)
        self._posed.pop(session_id, None)

        def forget() -> None:
            self._pose_file(session_id).unlink(missing_ok=True)
            self._store.remove(session_id)

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
        for asset_id in wanted - await asyncio.to_thread(self._store.assets_there, wanted) if wanted else ():
            for session in [session for session in self._live.values() if session.asset_id == asset_id]:
                session.gone.set()
            self.forget_asset(asset_id)

    def naming_clip(self, clip: str) -> list[str]:
        """Ids of the sessions that own a clip (SessionStore.naming_clip). For any thread."""
        return self._store.naming_clip(clip)

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

                new, self._asset_bytes[session.asset_id] = await self._threads.call(lambda _: load(), caller)
                self._loaded[session.asset_id] = new
            loaded = self._loaded[session.asset_id]
            self._loaded.move_to_end(session.asset_id)
        edits = session.log.done
        is_long, path, recalled = len(edits) >= LONG_LOG, self._pose_file(session.id), False

        def pose(work: PoseWork) -> PosedEdits:
            nonlocal recalled
            recalled = is_long and loaded.recall(edits, path)
            return pose_edits(lambda kept: loaded.pose(kept, None, work.go_on), edits, lambda _: False, self.references.missing)

        posed = await self._pose(session, pose, caller)
        session.log = replace(session.log, broken=self._told(posed))
        session.loaded, session.posed = loaded, Posed(session.log.revision, posed.pose)
        self._make_room(session)
        if is_long and not recalled:
            self._keep_pose(session)
        return session.posed

    def _keep_pose(self, session: LiveSession) -> None:
        """Write what a long log has made so far, on a thread of its own; nobody waits for it."""
        assert session.loaded is not None
        self._threads.keep(session.loaded, session.log.applied, self._pose_file(session.id))

    def _pose_file(self, session_id: str) -> Path:
        return self._directory.poses / f"{session_id}.safetensors"

    def loaded_bytes(self) -> int:
        """Of assets in memory, of the frames of their simulations, of the environments that they are shown under, and of poses: each about as
        much as its asset (18 MB of a tracer and its faces for an asset of 28 MB, and 32 bytes a face of light kept for whoever moves)."""
        assets = sum(self._asset_bytes[name] + loaded.simulation_bytes() for name, loaded in self._loaded.items())
        poses = sum(self._asset_bytes.get(session.asset_id, 0) for session in self._posed.values())
        return assets + poses + self._renderer.environment_bytes()

    def _make_room(self, newest: LiveSession) -> None:
        """Let go of what was used least recently: all but a few poses, then environments that light nothing and simulations that nobody asked for last, then the other poses with theirs,
        then assets. What somebody looks at stays, and so does the session whose pose is new."""
        self._posed[newest.id] = newest
        self._posed.move_to_end(newest.id)
        self._forget_poses(newest, FEW_POSED_SESSIONS)
        if self.loaded_bytes() > self._limits.loaded_bytes:
            self._renderer.forget_environments()
            for loaded in self._loaded.values():
                loaded.forget_simulations()
        self._forget_poses(newest, 0)
        for asset_id in list(self._loaded):
            if len(self._loaded) <= self._limits.loaded_assets and self.loaded_bytes() <= self._limits.loaded_bytes:
                return
            if asset_id != newest.asset_id and not self.uses(asset_id):
                self._unload(asset_id)

    def _forget_poses(self, newest: LiveSession, kept: int) -> None:
        """Of sessions that nobody looks at, the oldest first, until there is room or only `kept` are left."""
        for session in [session for session in self._posed.values() if not session.viewers and session is not newest]:
            there_is_room = len(self._posed) <= POSED_SESSIONS and self.loaded_bytes() <= self._limits.loaded_bytes
            if there_is_room or len(self._posed) <= kept:
                return
            session.posed = None
            del self._posed[session.id]

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
            return await self._threads.call(function, caller, begun)
        finally:
            session.work = None

    async def apply(self, session: LiveSession, request: ChangeRequest, caller: Caller = (), kept: bool = False) -> Applied:
        """One change of the log: posed, then stored, then shown to all viewers. Cancelled before it is stored, it leaves no trace; while it is, it
        is finished first.

        Args:
            kept: the edits were in the log before: those that no longer apply are skipped like others of the log.

        Raises:
            Overtaken: the log has another revision; it is as before.
            ProblemError: a sentence; the log is as before.
        """
        brought = [] if kept else await self._checked(session, request.edits)
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
                return pose_edits(lambda kept: loaded.pose(kept, posed.pose, work.go_on), log.done, is_new, self.references.missing)

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
                if self.references.may_wait(edit):
                    await asyncio.to_thread(self.references.check, edit)
                else:
                    self.references.check(edit)
            except ProblemError as problem:
                if passes(problem) or edit not in session.log.done:
                    raise
                continue
            whole.append(edit)
        return whole

    def _told(self, posed: PosedEdits) -> dict[int, str]:
        """What callers hear of the edits that were left out."""
        return {place: self._directory.told(reason) for place, reason in posed.broken.items()}

    async def _commit(self, session: LiveSession, request: ChangeRequest, kind: EventKind, log: EditLog, posed: PosedEdits) -> Applied:
        try:
            await asyncio.to_thread(self._store.append, session.id, log.revision, kind, request)
        except AssetGone:
            session.gone.set()
            self.forget_asset(session.asset_id)
            raise
        except ChangedElsewhere:
            self._live.pop(session.id, None)
            self._posed.pop(session.id, None)
            raise
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

    # ---- snapshots ---------------------------------------------------------------------------------------------------

    async def snapshots(self, session_id: str) -> list[SnapshotRow]:
        """Oldest first.

        Raises:
            ProblemError: 404.
        """
        await self.get(session_id)
        return await asyncio.to_thread(self._store.snapshots, session_id)

    async def take_snapshot(self, session_id: str, name: str) -> SnapshotRow:
        """
        Raises:
            ProblemError: 404, or there are too many.
        """
        session = await self.get(session_id)
        return await asyncio.to_thread(self._store.take_snapshot, session_id, name, session.log)

    async def restore(self, session: LiveSession, name: str, key: str | None = None, caller: Caller = ()) -> Applied:
        """Put a snapshot's edits in place of those in force.

        Raises:
            ProblemError: 404.
        """
        await self.get(session.id)  # it may be gone by now
        row = await asyncio.to_thread(self._store.snapshot, session.id, name)
        return await self.apply(session, ChangeRequest("restore", parse_kept_edits(row.edits), key=key), caller, kept=True)

    async def delete_snapshot(self, session_id: str, name: str) -> None:
        """
        Raises:
            ProblemError: 404.
        """
        await self.get(session_id)
        await asyncio.to_thread(self._store.delete_snapshot, session_id, name)


def _live(stored: StoredSession) -> LiveSession:
    return LiveSession(stored.id, stored.asset_id, stored.asset_name, stored.created_at, stored.log, keys=dict(stored.keys))


async def _finished(work: Coroutine[Any, Any, Result]) -> Result:
    """What the work returns; who is cancelled meanwhile waits for its end first."""
    task = asyncio.ensure_future(work)
    try:
        return await asyncio.shield(task)
    except asyncio.CancelledError:
        await asyncio.wait({task})
        raise
