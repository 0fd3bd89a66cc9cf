"""Sessions in the database: their rows, their events, their snapshots. All methods block, and are for any thread.

Knows nothing of what is in memory; a session read here is the same in every server on the same database.
"""

import uuid
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from sqlalchemy import Engine, String, cast, delete, select
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session as DatabaseSession

from drgs.scene.edits import PoseEdit, parse_kept_edits, plain_edit
from drgs_server.api.problems import ProblemError
from drgs_server.live.edit_log import Change, ChangeRequest, EditLog, EventKind, Splice
from drgs_server.settings import Limits
from drgs_worker.store.database import AssetRow, SessionEventRow, SessionRow, SnapshotRow, now

LISTED_SESSIONS = 100


class LogDamaged(ValueError):
    """The events of a session make no log."""


class AssetGone(ProblemError):
    """The session's asset was deleted, perhaps by another server on the same database."""

    def __init__(self) -> None:
        super().__init__(404, "The asset of this session was deleted; for a while it can be brought back.")


class ChangedElsewhere(ProblemError):
    """Another server on the same database has written the revision that was to be written."""

    def __init__(self) -> None:
        super().__init__(409, "Another server changed this session meanwhile; open it again.")


@dataclass(frozen=True)
class StoredSession:
    """A session as its rows tell it."""

    id: str
    asset_id: str
    asset_name: str
    created_at: float
    """Seconds since 1970."""
    log: EditLog
    keys: Mapping[str, int] = field(default_factory=dict)
    """Revision that each client key was answered with."""


class SessionStore:
    """Final."""

    def __init__(self, engine: Engine, limits: Limits) -> None:
        self._engine = engine
        self._limits = limits

    def create(self, asset_id: str) -> StoredSession:
        """
        Raises:
            ProblemError: no such asset, or too many sessions.
        """
        with DatabaseSession(self._engine) as database, database.begin():
            asset = database.get(AssetRow, asset_id)
            if asset is None or asset.deleted_at is not None:
                raise ProblemError(404, f"No asset has the id {asset_id[:64]!r}.")
            if len(database.scalars(select(SessionRow.id)).all()) >= self._limits.sessions:
                raise ProblemError(429, f"There are {self._limits.sessions} sessions already; delete one first.")
            row = SessionRow(id=uuid.uuid4().hex, asset_id=asset_id, created_at=now())
            database.add(row)
            return StoredSession(row.id, asset_id, asset.name, row.created_at, EditLog())

    def read(self, session_id: str) -> StoredSession:
        """Its log is replayed from its events.

        Raises:
            ProblemError: 404, also while its asset is deleted; 409 where its events make no log.
        """
        with DatabaseSession(self._engine) as database:
            row, asset = _rows(database, session_id)
            try:
                log, keys = _read_log(database, session_id)
            except LogDamaged as error:
                raise ProblemError(
                    409, f"The edits of the session {session_id} are damaged ({error}); delete it and open a new one."
                ) from error
            return StoredSession(row.id, row.asset_id, asset.name, row.created_at, log, keys)

    def check_there(self, session_id: str) -> None:
        """
        Raises:
            ProblemError: 404, as of `read`.
        """
        with DatabaseSession(self._engine) as database:
            _rows(database, session_id)

    def newest_ids(self) -> list[str]:
        """Of at most LISTED_SESSIONS whose asset is there, newest first."""
        with DatabaseSession(self._engine) as database:
            there = select(SessionRow.id).join(AssetRow, AssetRow.id == SessionRow.asset_id).where(AssetRow.deleted_at.is_(None))
            return list(database.scalars(there.order_by(SessionRow.created_at.desc()).limit(LISTED_SESSIONS)))

    def any_asset(self) -> bool:
        """Whether there are assets that somebody may open, or come back to."""
        with DatabaseSession(self._engine) as database:
            return database.scalars(select(AssetRow.id).where(AssetRow.deleted_at.is_(None)).limit(1)).first() is not None

    def remove(self, session_id: str) -> None:
        """With its events and snapshots."""
        with DatabaseSession(self._engine) as database, database.begin():
            database.execute(delete(SessionEventRow).where(SessionEventRow.session_id == session_id))
            database.execute(delete(SnapshotRow).where(SnapshotRow.session_id == session_id))
            database.execute(delete(SessionRow).where(SessionRow.id == session_id))

    def assets_there(self, asset_ids: Collection[str]) -> set[str]:
        """Those of the assets that are not deleted."""
        with DatabaseSession(self._engine) as database:
            return set(database.scalars(select(AssetRow.id).where(AssetRow.id.in_(asset_ids), AssetRow.deleted_at.is_(None))))

    def naming_clip(self, clip: str) -> list[str]:
        """Ids of the sessions that own a clip: their edits, those that undo or redo may bring back, or a snapshot name it."""
        with DatabaseSession(self._engine) as database:
            of_logs = select(SessionEventRow.session_id).where(cast(SessionEventRow.edit, String).contains(clip))
            of_snapshots = select(SnapshotRow.session_id).where(cast(SnapshotRow.edits, String).contains(clip))
            found = set(database.scalars(of_snapshots.distinct()))
            for session_id in set(database.scalars(of_logs.distinct())) - found:
                try:
                    log, _ = _read_log(database, session_id)  # what was undone and then written over is nobody's
                except LogDamaged:
                    found.add(session_id)  # nobody knows what it shows
                    continue
                if any(isinstance(edit, PoseEdit) and edit.clip == clip for edit in log.reachable()):
                    found.add(session_id)
        return sorted(found)

    def append(self, session_id: str, revision: int, kind: EventKind, request: ChangeRequest) -> None:
        """One event more, which makes the log's revision this one.

        Raises:
            AssetGone: the asset is deleted; nothing is written.
            ChangedElsewhere: there is an event of this revision or of the request's key; nothing is written.
        """
        event = SessionEventRow(
            session_id=session_id, revision=revision, kind=kind, edit=_plain_change(request.change), client_key=request.key
        )
        try:
            with DatabaseSession(self._engine) as database, database.begin():
                database.add(event)
                database.flush()  # first, so that what is read now holds until the end of this
                there = select(AssetRow.id).join(SessionRow, SessionRow.asset_id == AssetRow.id)
                if database.scalar(there.where(SessionRow.id == session_id, AssetRow.deleted_at.is_(None))) is None:
                    raise AssetGone
        except IntegrityError as error:
            raise ChangedElsewhere from error

    # ---- snapshots ---------------------------------------------------------------------------------------------------

    def snapshots(self, session_id: str) -> list[SnapshotRow]:
        """Oldest first; none of a session that is not there."""
        with DatabaseSession(self._engine) as database:
            wanted = select(SnapshotRow).where(SnapshotRow.session_id == session_id).order_by(SnapshotRow.created_at)
            return list(database.scalars(wanted))

    def snapshot(self, session_id: str, name: str) -> SnapshotRow:
        """
        Raises:
            ProblemError: 404.
        """
        found = next((row for row in self.snapshots(session_id) if row.name == name), None)
        if found is None:
            raise ProblemError(404, f"This session has no snapshot {name[:80]!r}.")
        return found

    def take_snapshot(self, session_id: str, name: str, log: EditLog) -> SnapshotRow:
        """Of the edits in force, in the place of a snapshot of the same name.

        Raises:
            ProblemError: there are too many.
        """
        taken = self.snapshots(session_id)
        if len(taken) >= self._limits.snapshots and name not in {row.name for row in taken}:
            raise ProblemError(422, f"A session has at most {self._limits.snapshots} snapshots; delete one first.")
        row = SnapshotRow(
            session_id=session_id,
            name=name,
            created_at=now(),
            revision=log.revision,
            edits=[plain_edit(edit) for edit in log.done],
        )
        with DatabaseSession(self._engine, expire_on_commit=False) as database, database.begin():
            return database.merge(row)

    def delete_snapshot(self, session_id: str, name: str) -> None:
        """
        Raises:
            ProblemError: 404.
        """
        row = self.snapshot(session_id, name)
        with DatabaseSession(self._engine) as database, database.begin():
            database.delete(row)


def _rows(database: DatabaseSession, session_id: str) -> tuple[SessionRow, AssetRow]:
    """
    Raises:
        ProblemError: 404.
    """
    row = database.get(SessionRow, session_id)
    asset = database.get(AssetRow, row.asset_id) if row else None
    if row is None or asset is None or asset.deleted_at is not None:
        raise ProblemError(404, f"No session has the id {session_id[:64]!r}.")
    return row, asset


def _read_log(database: DatabaseSession, session_id: str) -> tuple[EditLog, dict[str, int]]:
    """A session's log by its events, and the revision that each client key was answered with.

    Raises:
        LogDamaged: an event is no JSON, or there is nothing for it to work on.
    """
    events = select(SessionEventRow).where(SessionEventRow.session_id == session_id).order_by(SessionEventRow.revision)
    log, keys = EditLog(), {}
    try:
        for event in database.scalars(events):
            log = log.after(event.kind, _change_of(event))  # type: ignore[arg-type]
            if event.client_key is not None:
                keys[event.client_key] = event.revision
    except (ValueError, KeyError, TypeError) as error:
        raise LogDamaged(f"behind revision {log.revision}: {error}") from error
    return log, keys


def _plain_change(change: Change | None) -> dict | list | None:
    """As an event's row holds it; `_change_of` reads it."""
    if isinstance(change, Splice):
        return {"start": change.start, "remove": change.remove, "edits": [plain_edit(edit) for edit in change.edits]}
    if isinstance(change, Sequence):
        return [plain_edit(edit) for edit in change]
    return None if change is None else plain_edit(change)


def _change_of(event: SessionEventRow) -> Change | None:
    """Edits that this version does not read stand in it as such, and are shown as broken."""
    values: object = event.edit
    match event.kind:
        case "undo" | "redo":
            return None
        case "splice":
            if not isinstance(values, dict):
                raise ValueError("a splice without its edits")
            return Splice(values["start"], values["remove"], tuple(parse_kept_edits(values["edits"])))
        case "restore":
            return parse_kept_edits(values)
        case _:
            return parse_kept_edits([values])[0]
