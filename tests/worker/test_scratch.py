"""Drafts of a process that died are gone at the next start; those of one that lives are left alone."""

import os
import subprocess
import sys
import time
from pathlib import Path

from drgs_worker.store.data_directory import open_data_directory
from drgs_worker.store.scratch import STALE_SECONDS, claim_scratch
from tests.patience import PATIENCE_SECONDS

PROGRAM = """
import os, sys
from pathlib import Path
from drgs_worker.store.data_directory import open_data_directory
from drgs_worker.store.scratch import claim_scratch
folder = claim_scratch(open_data_directory(Path(sys.argv[1]))).folder
(folder / ".version-x").mkdir()
(folder / ".version-x" / "asset").write_bytes(b"half")
os.kill(os.getpid(), 9)
"""


def test_what_a_killed_process_left_is_swept_and_what_a_living_one_has_is_kept(tmp_path: Path) -> None:
    directory = open_data_directory(tmp_path)
    living = claim_scratch(directory)
    (living.folder / "draft").write_bytes(b"half")
    assert subprocess.run([sys.executable, "-c", PROGRAM, str(tmp_path)], timeout=PATIENCE_SECONDS).returncode == -9
    assert len(list(directory.scratch.rglob(".version-x"))) == 1
    another = claim_scratch(directory)
    assert list(directory.scratch.rglob(".version-x")) == [] and list(another.folder.iterdir()) == []
    assert (living.folder / "draft").exists() and living.folder != another.folder
    for scratch in (living, another):
        scratch.close()
    assert [path for path in directory.scratch.iterdir() if path.is_dir()] == []


def test_old_drafts_without_an_owner_are_removed_and_nothing_else(tmp_path: Path) -> None:
    directory = open_data_directory(tmp_path)
    for place in (
        directory.uploads / ".version-old",
        directory.assets / ".fetched",
        directory.assets / "asset",
        directory.uploads / ".new",
    ):
        place.mkdir()
        if place.name != ".new":
            os.utime(place, (time.time() - 2 * STALE_SECONDS,) * 2)
    (directory.environments / ".sky.exr.new").write_bytes(b"half")
    os.utime(directory.environments / ".sky.exr.new", (0, 0))
    claim_scratch(directory).close()
    left = {path.name for folder in (directory.uploads, directory.assets, directory.environments) for path in folder.iterdir()}
    assert left == {"asset", ".new"}


def test_half_written_poses_and_pictures_are_swept_by_the_first_server_and_left_alone_by_a_second(tmp_path: Path) -> None:
    directory = open_data_directory(tmp_path)
    drafts = [directory.poses / "a.new", directory.environments / "sky.new", directory.environments / ".sky.exr.new"]
    whole = [directory.poses / "a.safetensors", directory.environments / "sky.exr", directory.environments / "sky.jpg"]
    for path in (*drafts, *whole):
        path.write_bytes(b"half")
    first = claim_scratch(directory)
    assert not any(path.exists() for path in drafts) and all(path.exists() for path in whole)
    for path in drafts:
        path.write_bytes(b"half")
    second = claim_scratch(directory)
    assert all(path.exists() for path in drafts), "the first one may be writing them"
    for scratch in (first, second):
        scratch.close()
