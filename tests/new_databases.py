"""The SQLite files of a service that nobody used yet, for tests to begin with: to go through all migrations takes longer than most tests."""

import sqlite3
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

from drgs_worker.jobs.queue import migrate_queue
from drgs_worker.store.data_directory import open_data_directory
from drgs_worker.store.database import open_database


def put_new_databases(folder: Path) -> None:
    """Where there may be no folder yet."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, content in _new_databases().items():
        (folder / name).write_bytes(content)


@cache
def _new_databases() -> dict[str, bytes]:
    with TemporaryDirectory() as folder:
        directory = open_data_directory(Path(folder))
        open_database(directory).dispose()
        migrate_queue(directory)
        files = sorted(Path(folder).glob("*.sqlite"))
        for file in files:
            connection = sqlite3.connect(file)
            connection.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            connection.close()
        return {file.name: file.read_bytes() for file in files}
