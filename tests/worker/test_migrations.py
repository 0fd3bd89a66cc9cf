"""A database is brought to the newest tables, and one that has them is opened without a look at migrations."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from alembic.config import Config
from alembic.script import ScriptDirectory

from drgs_worker.store import database
from drgs_worker.store.data_directory import open_data_directory
from tests.new_databases import put_new_databases


def newest() -> str | None:
    config = Config()
    config.set_main_option("script_location", str(Path(database.__file__).parent / "migrations"))
    return ScriptDirectory.from_config(config).get_current_head()


def test_a_new_database_has_the_newest_tables_and_is_left_alone_from_then_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    directory = open_data_directory(tmp_path)
    database.open_database(directory).dispose()
    with closing(sqlite3.connect(tmp_path / "app.sqlite")) as connection:
        assert connection.execute("SELECT version_num FROM alembic_version").fetchall() == [(newest(),)]
    monkeypatch.setattr(database, "_migrate", lambda _: pytest.fail("there is nothing to migrate"))
    database.open_database(directory).dispose()


def test_an_older_database_gets_what_it_lacks(tmp_path: Path) -> None:
    put_new_databases(tmp_path)
    with closing(sqlite3.connect(tmp_path / "app.sqlite")) as connection, connection:
        connection.execute("DROP TABLE captures")
        connection.execute("UPDATE alembic_version SET version_num = '0004'")
    database.open_database(open_data_directory(tmp_path)).dispose()
    with closing(sqlite3.connect(tmp_path / "app.sqlite")) as connection:
        assert connection.execute("SELECT count(*) FROM captures").fetchone() == (0,)
        assert connection.execute("SELECT version_num FROM alembic_version").fetchall() == [(newest(),)]
