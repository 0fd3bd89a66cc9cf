"""Tables of the service (SQLAlchemy) and their migration at start (alembic). The queue's own tables are DBOS's.

Times are UTC seconds since the epoch: one meaning in SQLite and Postgres, and comparisons need no time zones.
"""

import time
from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import JSON, Engine, ForeignKey, create_engine, event
from sqlalchemy.engine.interfaces import DBAPIConnection
from sqlalchemy.orm import DeclarativeBase, Mapped, mapped_column
from sqlalchemy.pool import ConnectionPoolEntry

from worker.data_directory import DataDirectory, lock_file


class Base(DeclarativeBase):
    """Of all tables."""


class AssetRow(Base):
    __tablename__ = "assets"

    id: Mapped[str] = mapped_column(primary_key=True)
    name: Mapped[str]
    created_at: Mapped[float] = mapped_column(index=True)
    source: Mapped[str]
    """build or upload."""
    bytes: Mapped[int]
    surfel_count: Mapped[int]
    vertex_count: Mapped[int]
    face_count: Mapped[int]


class JobRow(Base):
    """What a job is and how far it got. Whether it waits, runs or is over is DBOS's to say."""

    __tablename__ = "jobs"

    id: Mapped[str] = mapped_column(primary_key=True)
    """Also the id of the DBOS workflow."""
    kind: Mapped[str]
    name: Mapped[str]
    dataset: Mapped[str]
    """Folder of the capture."""
    preset: Mapped[str]
    seed: Mapped[int]
    idempotency_key: Mapped[str | None] = mapped_column(unique=True)
    created_at: Mapped[float] = mapped_column(index=True)
    finished_at: Mapped[float | None]
    cancel_requested: Mapped[bool] = mapped_column(default=False)
    worker_id: Mapped[str | None]
    """Of the worker that last took it."""
    attempts: Mapped[int] = mapped_column(default=0)
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


class SessionEventRow(Base):
    """One change of a session's edit log. Rows are only ever added; the log is their replay (server/edit_log.py)."""

    __tablename__ = "session_events"

    session_id: Mapped[str] = mapped_column(ForeignKey("sessions.id", ondelete="CASCADE"), primary_key=True)
    revision: Mapped[int] = mapped_column(primary_key=True)
    """1, 2, 3, ..."""
    kind: Mapped[str]
    """edit, replace (of the last edit, in one slider drag), undo or redo."""
    edit: Mapped[dict | None] = mapped_column(JSON)


def open_database(directory: DataDirectory) -> Engine:
    """An engine on the migrated database; safe to call from several processes at once."""
    engine = create_engine(directory.database_url)
    if engine.dialect.name == "sqlite":
        event.listen(engine, "connect", _prepare_sqlite)
    with lock_file(directory.root / ".setup.lock"):
        config = Config()
        config.set_main_option("script_location", str(Path(__file__).parent / "migrations"))
        with engine.begin() as connection:
            config.attributes["connection"] = connection
            command.upgrade(config, "head")
    return engine


def _prepare_sqlite(connection: DBAPIConnection, _: ConnectionPoolEntry) -> None:
    cursor = connection.cursor()
    # WAL: readers never wait for the writer. NORMAL survives kill -9 (only a power cut may lose the last moments).
    for pragma in ("journal_mode=WAL", "synchronous=NORMAL", "busy_timeout=30000", "foreign_keys=ON"):
        cursor.execute(f"PRAGMA {pragma}")
    cursor.close()


def now() -> float:
    """UTC seconds since the epoch."""
    return time.time()
