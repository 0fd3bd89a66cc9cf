"""Where a process keeps what is half made: a folder of its own in the data directory, on the same disk, so that what is done is moved into its place.

The folder belongs to whoever holds its lock; the kernel lets go of that when a process dies, however it does. What the dead left is
removed by whoever starts next.
"""

import os
import shutil
import time
from dataclasses import dataclass
from pathlib import Path

from drgs_worker.store.data_directory import DataDirectory, lock_file, try_lock_file

MOST_PROCESSES = 256
STALE_SECONDS = 24 * 3600.0
"""Drafts outside of these folders (of what is fetched from a store, say) have no owner; older ones are nobody's."""


@dataclass(frozen=True)
class Scratch:
    """Keep it as long as the folder is wanted."""

    folder: Path
    lock: int
    """Descriptor of the lock."""

    def close(self) -> None:
        """Remove the folder and let go of its number."""
        shutil.rmtree(self.folder, ignore_errors=True)
        os.close(self.lock)


def claim_scratch(directory: DataDirectory) -> Scratch:
    """An empty folder for this process, and none left of those that died.

    Raises:
        ValueError: very many processes use the data directory.
        OSError: the disk is full, or the folder cannot be written.
    """
    with lock_file(directory.scratch / "claiming.lock"):  # nobody begins while it is found out who else there is
        own, alone = _claim(directory)
        if alone:
            _remove_drafts_of_servers(directory)
    _remove_stale_drafts(directory)
    return own


def _claim(directory: DataDirectory) -> tuple[Scratch, bool]:
    """A folder, and whether no other process has one; raises like claim_scratch."""
    known = {int(path.stem) for path in directory.scratch.glob("*.lock") if path.stem.isdecimal()}
    own: Scratch | None = None
    alone = True
    for number in range(MOST_PROCESSES):
        if own is not None and number not in known:
            continue
        lock = try_lock_file(directory.scratch / f"{number}.lock")
        if lock is None:
            alone = False
            continue
        folder = directory.scratch / str(number)
        shutil.rmtree(folder, ignore_errors=True)
        if own is None:
            folder.mkdir(mode=0o700, exist_ok=True)
            own = Scratch(folder, lock)
        else:
            os.close(lock)
    if own is None:
        raise ValueError(f"{MOST_PROCESSES} processes already use {directory.root}; expected fewer")
    return own, alone


def _remove_drafts_of_servers(directory: DataDirectory) -> None:
    """What is half written beside its place (poses, thumbnails, environments): by servers only, of which none lives but this one."""
    for path in (*directory.poses.glob("*.new"), *directory.environments.glob("*.new"), *directory.environments.glob(".*.new")):
        path.unlink(missing_ok=True)


def _remove_stale_drafts(directory: DataDirectory) -> None:
    before = time.time() - STALE_SECONDS
    for folder in (directory.assets, directory.uploads, directory.jobs, directory.environments, directory.environments / "clips"):
        for path in folder.glob(".*") if folder.is_dir() else ():
            try:
                if path.stat().st_mtime > before:
                    continue
                shutil.rmtree(path) if path.is_dir() else path.unlink()
            except OSError:  # somebody else was quicker, or holds it: the next start looks again
                continue
