"""The SQLite databases of a data directory: whether they can be read, and a good copy of each.

A copy is made by SQLite's own backup, which other processes may write through, is looked at, and then takes the place of the one before: there is
always one that could be read. Postgres has its own tools; nothing here does anything for it. Source: sqlite.org/backup.html.
"""

import os
import shutil
import sqlite3
import time
from collections.abc import Iterator
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path

from drgs_worker.store.data_directory import DataDirectory, try_lock_file

WAIT_SECONDS = 30.0
"""For a database that another process has locked."""
_BESIDE = ("-wal", "-shm", "-journal")
"""Endings of what SQLite keeps beside a database, and what belongs to no other."""


class DatabaseDamaged(ValueError):
    """The text is a sentence that says what to do."""


def check_database(directory: DataDirectory, url: str) -> None:
    """Read a database through, if it is SQLite and there.

    Raises:
        DatabaseDamaged: it is no database, or a part of it cannot be read.
        ValueError: it cannot be opened.
    """
    path = _sqlite_path(url)
    if path is None or not path.is_file():
        return
    try:
        damage = _damage(path)
    except sqlite3.OperationalError as error:
        raise ValueError(f"the database {path} cannot be opened: {error}") from error
    if damage is None:
        return
    advice = advise_restore(directory, path)
    raise DatabaseDamaged(
        f"the database {path} is damaged ({damage}): "
        + (advice or "there is no copy of it yet; put one from a backup of yours in its place, or move it away to begin anew")
    )


def advise_restore(directory: DataDirectory, path: Path) -> str | None:
    """What to do to begin with the copy of a database, if there is one."""
    backup = _backup(directory, path)
    if not backup.is_file():
        return None
    made = datetime.fromtimestamp(backup.stat().st_mtime, UTC).strftime("%Y-%m-%d %H:%M UTC")
    return f"`drgs serve --restore-backup` starts with the last good copy, of {made}, and keeps what is damaged; stop all that uses the folder first"


def back_up_databases(directory: DataDirectory, drafts: Path) -> None:
    """Keep a copy of each database, in place of the one before.

    Args:
        drafts: folder on the same disk, of this process.

    Raises:
        DatabaseDamaged: one cannot be read; the copy before stays.
        ValueError, OSError: it cannot be opened now, or the disk is full; likewise.
    """
    for path in filter(Path.is_file, _databases(directory)):
        draft, backup = drafts / f"{path.name}.backup", _backup(directory, path)
        try:
            with closing(_open(path)) as source, closing(_open(draft)) as copy:
                copy.execute("PRAGMA synchronous=OFF")  # of what nobody needs until it is whole
                source.backup(copy)
                copy.execute("PRAGMA journal_mode=DELETE")  # one file, with nothing beside it
            damage = _damage(draft)
            if damage is not None:
                raise DatabaseDamaged(f"the database {path} is damaged ({damage}); the copy of before was kept")
            backup.parent.mkdir(mode=0o700, exist_ok=True)
            with draft.open("rb+") as file:
                os.fsync(file.fileno())
            os.replace(draft, backup)
        except sqlite3.OperationalError as error:
            raise ValueError(f"the database {path} was not copied: {error}") from error
        except sqlite3.DatabaseError as error:
            raise DatabaseDamaged(f"the database {path} is damaged ({error}); the copy of before was kept") from error
        finally:
            draft.unlink(missing_ok=True)


def restore_backups(directory: DataDirectory) -> list[Path]:
    """Put the copy in the place of each database that is damaged or gone, and that one into a folder `damaged-TIME`. Returns the databases.

    Raises:
        ValueError: a server or worker still runs on the folder; or one cannot be opened, or has no copy.
    """
    for path in (*directory.scratch.glob("*.lock"), *directory.workers.glob("*.lock")):
        lock = try_lock_file(path)
        if lock is None:
            raise ValueError(f"a server or worker runs on {directory.root}; stop it before its databases are exchanged")
        os.close(lock)
    restored = []
    for path in _databases(directory):
        backup = _backup(directory, path)
        try:
            check_database(directory, f"sqlite:///{path}")
            if path.is_file() or not backup.is_file():
                continue
        except DatabaseDamaged:
            if not backup.is_file():
                raise
        for found in (path, *(path.with_name(path.name + ending) for ending in _BESIDE)):
            if found.exists():
                aside = directory.root / f"damaged-{time.strftime('%Y%m%d-%H%M%S')}"
                aside.mkdir(mode=0o700, exist_ok=True)
                found.rename(aside / found.name)
        draft = path.with_name(f".{path.name}.new")
        shutil.copyfile(backup, draft)
        os.replace(draft, path)
        restored.append(path)
    return restored


def _databases(directory: DataDirectory) -> Iterator[Path]:
    for url in (directory.database_url, directory.queue_url):
        path = _sqlite_path(url)
        if path is not None:
            yield path


def _sqlite_path(url: str) -> Path | None:
    return Path(url.removeprefix("sqlite:///")) if url.startswith("sqlite:///") else None


def _backup(directory: DataDirectory, path: Path) -> Path:
    return directory.root / "backups" / path.name


def _open(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(path, timeout=WAIT_SECONDS)


def _damage(path: Path) -> str | None:
    """What is wrong with a database, in SQLite's words; None: nothing.

    Raises:
        OperationalError: it is locked, or cannot be opened.
    """
    try:
        with closing(_open(path)) as connection:
            (first,) = connection.execute("PRAGMA quick_check(1)").fetchone()
    except sqlite3.OperationalError as error:
        if "malformed" in str(error):
            return str(error)
        raise
    except sqlite3.DatabaseError as error:
        return str(error)
    return None if first == "ok" else str(first).splitlines()[-1]
