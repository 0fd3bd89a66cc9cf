"""Damaged databases are named with what to do, and a good copy of each is kept."""

import sqlite3
from contextlib import closing
from pathlib import Path

import pytest
from sqlalchemy.orm import Session

from drgs_worker.jobs.queue import migrate_queue
from drgs_worker.store.backups import DatabaseDamaged, back_up_databases, restore_backups
from drgs_worker.store.data_directory import DataDirectory, open_data_directory
from drgs_worker.store.database import AssetRow, now, open_database
from drgs_worker.store.scratch import claim_scratch


@pytest.fixture
def directory(tmp_path: Path) -> DataDirectory:
    directory = open_data_directory(tmp_path / "data")
    add_assets(directory, 200)
    return directory


def add_assets(directory: DataDirectory, count: int) -> None:
    engine = open_database(directory)
    with Session(engine) as session, session.begin():
        for k in range(count):
            name = f"{k} " + "x" * 500
            session.add(
                AssetRow(
                    id=f"{k}-{now()}", name=name, created_at=now(), source="upload", bytes=1, surfel_count=0, vertex_count=1, face_count=1
                )
            )
    engine.dispose()


def count_assets(path: Path) -> int:
    with closing(sqlite3.connect(path)) as connection:
        return connection.execute("SELECT count(*) FROM assets").fetchone()[0]


def damage(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[4096:] = b"\xa5" * (len(data) - 4096)
    path.write_bytes(data)


def test_a_damaged_database_is_named_and_its_last_good_copy_takes_its_place(directory: DataDirectory, tmp_path: Path) -> None:
    path = directory.root / "app.sqlite"
    back_up_databases(directory, tmp_path)
    damage(path)
    with pytest.raises(
        DatabaseDamaged, match=r"app\.sqlite is damaged .*`drgs serve --restore-backup` starts with the last good copy, of 20"
    ):
        open_database(directory)
    with pytest.raises(DatabaseDamaged, match="the copy of before was kept"):
        back_up_databases(directory, tmp_path)
    assert restore_backups(directory) == [path]
    (aside,) = directory.root.glob("damaged-*/app.sqlite")
    assert aside.stat().st_size == path.stat().st_size
    open_database(directory).dispose()
    assert count_assets(path) == 200 and restore_backups(directory) == []


def test_a_database_that_is_gone_comes_back_from_its_copy_too(directory: DataDirectory, tmp_path: Path) -> None:
    path = directory.root / "app.sqlite"
    back_up_databases(directory, tmp_path)
    directory.asset("a").mkdir()
    path.unlink()
    with pytest.raises(ValueError, match=r"app\.sqlite is missing.*`drgs serve --restore-backup` starts with the last good copy"):
        open_database(directory)
    assert restore_backups(directory) == [path] and count_assets(path) == 200


def test_without_a_copy_there_is_a_sentence_too(directory: DataDirectory) -> None:
    for name, opened in (("app", open_database), ("jobs", migrate_queue)):
        (directory.root / f"{name}.sqlite").write_bytes(b"no database at all" * 1000)
        with pytest.raises(DatabaseDamaged, match=rf"{name}\.sqlite is damaged .*there is no copy of it yet"):
            opened(directory)
    with pytest.raises(DatabaseDamaged, match="no copy"):
        restore_backups(directory)


def test_a_copy_is_one_whole_file_made_beside_a_writer(directory: DataDirectory, tmp_path: Path) -> None:
    engine = open_database(directory)
    with engine.begin() as writer:
        writer.exec_driver_sql("DELETE FROM assets WHERE name LIKE '1 %'")
        back_up_databases(directory, tmp_path)
    engine.dispose()
    assert [path.name for path in (directory.root / "backups").iterdir()] == ["app.sqlite"]
    assert count_assets(directory.root / "backups" / "app.sqlite") == 200 and list(tmp_path.glob("*.backup*")) == []
    back_up_databases(directory, tmp_path)
    assert count_assets(directory.root / "backups" / "app.sqlite") == 199


def test_databases_are_not_exchanged_under_a_server(directory: DataDirectory) -> None:
    scratch = claim_scratch(directory)
    with pytest.raises(ValueError, match="stop it before"):
        restore_backups(directory)
    scratch.close()
    assert restore_backups(directory) == []
