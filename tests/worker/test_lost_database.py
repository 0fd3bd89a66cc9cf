"""A database that is gone while what it listed is still there."""

from pathlib import Path

import pytest

from drgs_worker.store.data_directory import open_data_directory
from drgs_worker.store.database import open_database


@pytest.mark.parametrize("folder", ["assets", "jobs"])
def test_a_full_folder_without_its_database_is_refused_and_not_begun_anew(folder: str, tmp_path: Path) -> None:
    directory = open_data_directory(tmp_path / "data")
    open_database(directory).dispose()
    (directory.root / folder / ("a" * 32)).mkdir()
    open_database(directory).dispose()
    for path in directory.root.glob("app.sqlite*"):
        path.unlink()
    with pytest.raises(ValueError, match=rf"1 folders in {folder}/, but app\.sqlite is missing or empty"):
        open_database(directory)
    assert not (directory.root / "app.sqlite").exists()
    (directory.root / "app.sqlite").touch()
    with pytest.raises(ValueError, match="is missing or empty"):
        open_database(directory)


def test_a_new_folder_gets_a_database(tmp_path: Path) -> None:
    directory = open_data_directory(tmp_path / "data")
    open_database(directory).dispose()
    assert (directory.root / "app.sqlite").is_file()
