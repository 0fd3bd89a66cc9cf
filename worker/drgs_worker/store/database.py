"""Tables of the service (SQLAlchemy) and their migration at start (alembic, if there is one to do). The queue's own tables are DBOS's.

Times are UTC seconds since the epoch: one meaning in SQLite and Postgres, and comparisons need no time zones.
"""

import logging
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from sqlalchemy import JSON, BigInteger, Connection, Engine, ForeignKey, UniqueConstraint, create_engine, event, inspect, text
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column
from sqlalchemy.pool import ConnectionPoolEntry

from drgs_worker.store.backups import advise_restore, check_database
from drgs_worker.store.data_directory import DataDirectory, lock_file

OUTAGE_SECONDS = 60.0
"""How long a worker waits for a database that does not answer."""
OUTAGE_POLL_SECONDS = 0.5
Result = TypeVar("Result")
MIGRATION_LOCK = 0x64726773
"""Any number, the same in all processes."""
_MIGRATIONS = Path(__file__).parent / "migrations"


class Base(DeclarativeBase):
    """Of all tables."""


class AssetRow(Base):
    __tablename__ = "assets"

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str]
    created_at: Mapped[float] = mapped_column(index=True)
    source: Mapped[str]
    """build, upload or session."""
    bytes: Mapped[int] = mapped_column(BigInteger)
    surfel_count: Mapped[int]
    vertex_count: Mapped[int]
    face_count: Mapped[int]
    parent_id: Mapped[str | None]
    """Of the version that this one was made of."""
    version: Mapped[int] = mapped_column(default=1)
    """One more than the parent's."""
    edits: Mapped[list] = mapped_column(JSON, default=list)
    """What was done to the parent."""
    deleted_at: Mapped[float | None] = mapped_column(index=True)
    """Since when it waits for its files to be removed; None: it is there."""


class CaptureRow(Base):
    """A capture that builds can be made of: an uploaded one, or what a search for poses made of one. Those that came with their build (multipart)
    have none; they are their job's."""

    __tablename__ = "captures"

    id: Mapped[str] = mapped_column(primary_key=True)
    """That of its upload, or of the job that made it."""
    name: Mapped[str]
    created_at: Mapped[float] = mapped_column(index=True)
    folder: Mapped[str]
    """Where its files lie below the folder of uploads: ID, or ID/NAME where the archive held one folder."""


class JobRow(Base):
    """What a job is and how far it got. Whether it waits, runs or is over is DBOS's to say."""

    __tablename__ = "jobs"

    id: Mapped[str] = mapped_column(primary_key=True)
    """Also the id of the DBOS workflow."""
    kind: Mapped[str]
    """drgs_worker.jobs.requests.JobKind."""
    name: Mapped[str]
    dataset: Mapped[str]
    """Folder of the capture; empty where there is none."""
    preset: Mapped[str]
    """Empty where there is none."""
    seed: Mapped[int]
    parameters: Mapped[dict] = mapped_column(JSON, default=dict)
    """The request as plain data."""
    priority: Mapped[int] = mapped_column(default=100)
    idempotency_key: Mapped[str | None] = mapped_column(unique=True)
    created_at: Mapped[float] = mapped_column(index=True)
    finished_at: Mapped[float | None]
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    worker_id: Mapped[str | None]
    """Of the worker that last took it."""
    attempts: Mapped[int] = mapped_column(default=0)
    unended: Mapped[int] = mapped_column(default=0)
    """Executions that began and never ended in order, since the job was made or retried: deaths of its workers, and the one under way."""
    stage: Mapped[str] = mapped_column(default="")
    iteration: Mapped[int] = mapped_column(default=0)
    iterations: Mapped[int] = mapped_column(default=0)
    fraction: Mapped[float] = mapped_column(default=0.0)
    psnr: Mapped[float | None]
    eta_seconds: Mapped[float | None]
    message: Mapped[str] = mapped_column(default="")
    preview_version: Mapped[int] = mapped_column(default=0)
    asset_id: Mapped[str | None]
    error: Mapped[str | None]
    capture_report: Mapped[dict | None] = mapped_column(JSON)
    """drgs_worker.jobs.capture_report.CaptureReport of a build, once its capture was looked at."""

    @property
    def source_asset(self) -> str | None:
        """What a job of another kind than `build` works on."""
        return self.parameters.get("asset")


class WorkerRow(Base):
    __tablename__ = "workers"

    id: Mapped[str] = mapped_column(primary_key=True)
    """hostname-slot: the same after a restart, so that DBOS gives a worker its own jobs back."""
    pid: Mapped[int]
    started_at: Mapped[float]
    heartbeat_at: Mapped[float]


class SessionRow(Base):
    __tablename__ = "sessions"

    id: Mapped[str] = mapped_column(primary_key=True)
    asset_id: Mapped[str]
    created_at: Mapped[float] = mapped_column(index=True)


class SnapshotRow(Base):
    """A named state of a session's edits."""

    __tablename__ = "session_snapshots"

    session_id: Mapped[str] = mapped_column(ForeignKey("sessions.id", ondelete="CASCADE"), primary_key=True)
    name: Mapped[str] = mapped_column(primary_key=True)
    created_at: Mapped[float]
    revision: Mapped[int]
    """Of the log when it was taken."""
    edits: Mapped[list] = mapped_column(JSON)


class SessionEventRow(Base):
    """One change of a session's edit log. Rows are only ever added; the log is their replay (server/drgs_server/live/edit_log.py)."""

    __tablename__ = "session_events"
    __table_args__ = (UniqueConstraint("session_id", "client_key", name="one_event_a_key"),)

    session_id: Mapped[str] = mapped_column(ForeignKey("sessions.id", ondelete="CASCADE"), primary_key=True)
    revision: Mapped[int] = mapped_column(primary_key=True)
    """1, 2, 3, ..."""
    kind: Mapped[str]
    """edit, replace (of the last step, in one slider drag), splice, restore (of a whole list), undo or redo."""
    edit: Mapped[dict | list | None] = mapped_column(JSON)
    """A list for restore."""
    client_key: Mapped[str | None]
    """Chosen by the client, the same when it sends the change again; unique in a session."""


def open_database(directory: DataDirectory) -> Engine:
    """An engine on the migrated database; safe to call from several processes at once.

    Raises:
        ValueError: a SQLite database is damaged or cannot be opened, or the folder holds what only a database that is gone knew of; the sentence
            says what to do.
    """
    url = directory.database_url
    _refuse_lost_database(directory)
    check_database(directory, url)
    if url.startswith("postgresql://"):
        url = url.replace("postgresql://", "postgresql+psycopg://", 1)
    # A connection is tried before it is used: the database may have been restarted meanwhile.
    engine = create_engine(url, pool_pre_ping=not url.startswith("sqlite"))
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _prepare_sqlite)
    with lock_file(directory.root / ".setup.lock"), engine.begin() as connection:
        if engine.dialect.name == "postgresql":  # the file lock holds on one machine only
            connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": MIGRATION_LOCK})
        if _revision(connection) != _newest_revision():
            _migrate(connection)
    return engine


def _newest_revision() -> str:
    """Of the migrations that there are, by the names of their files."""
    return max(path.stem[1:].partition("_")[0] for path in (_MIGRATIONS / "versions").glob("v*.py"))


def _revision(connection: Connection) -> str | None:
    """That a database has; None: it is new."""
    if not inspect(connection).has_table("alembic_version"):
        return None
    return connection.scalar(text("SELECT version_num FROM alembic_version"))


def _migrate(connection: Connection) -> None:
    # Here, and not above: nearly every start finds the newest tables, and loading alembic and its templates takes longer than opening the database.
    from alembic import command
    from alembic.config import Config

    config = Config()
    config.set_main_option("script_location", str(_MIGRATIONS))
    config.attributes["connection"] = connection
    command.upgrade(config, "head")


def _refuse_lost_database(directory: DataDirectory) -> None:
    """A new, empty database beside a full folder would look like a service that never had any assets."""
    path = directory.root / "app.sqlite"
    if directory.database_url != f"sqlite:///{path}" or (path.exists() and path.stat().st_size):
        return
    found = {folder.name: sum(1 for _ in folder.iterdir()) for folder in (directory.assets, directory.jobs)}
    if any(found.values()):
        counts = " and ".join(f"{count} folders in {name}/" for name, count in found.items() if count)
        advice = advise_restore(directory, path) or "put it back, or move those folders away to begin anew"
        raise ValueError(
            f"data directory {directory.root}: {counts}, but app.sqlite is missing or empty, which holds their names and the sessions; {advice}"
        )


def retry_while_database_unavailable(work: Callable[[], Result], patience_seconds: float = OUTAGE_SECONDS) -> Result:
    """Do it again while the database does not answer, since it may be on its way up; for work that may be done twice.

    Raises:
        OperationalError: it did not answer in all that time.
    """
    give_up_at = time.monotonic() + patience_seconds
    while True:
        try:
            return work()
        except OperationalError:
            if time.monotonic() > give_up_at:
                raise
            logging.getLogger(__name__).warning("the database does not answer; trying again")
            time.sleep(OUTAGE_POLL_SECONDS)


def _prepare_sqlite(connection: DBAPIConnection, _: ConnectionPoolEntry) -> None:
    cursor = connection.cursor()
    # WAL: readers never wait for the writer. NORMAL survives kill -9 (only a power cut may lose the last moments).
    for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "busy_timeout=30000", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def now() -> float:
    """UTC seconds since the epoch."""
    return time.time()
