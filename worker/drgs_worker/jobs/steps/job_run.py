"""One execution of one job in this process: an ordered list of durable steps, and how to do each.

A step's result is on disk when `run` returns: after a crash another process goes on from there. A step that a crash interrupted is run
again, which must do no harm. What steps share in memory is kept in the object, which lives as long as the execution.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Engine

from drgs.scene.edits import Edit
from drgs_worker.jobs.builders import Builder
from drgs_worker.jobs.progress import Tell
from drgs_worker.jobs.retry_while_unavailable import retry_while_unavailable
from drgs_worker.store.artifacts import fetch_asset, fetch_edit_files
from drgs_worker.store.data_directory import DataDirectory


@dataclass(frozen=True)
class JobContext:
    """What a job works with."""

    job_id: str
    name: str
    parameters: dict
    """Its request, as plain data."""
    dataset: Path | None
    """Folder of the capture; builds and searches for poses have one."""
    directory: DataDirectory
    engine: Engine
    builder: Builder
    device: str
    progress: Tell
    should_stop: Callable[[], bool]
    """Cheap; to be asked several times a second. Raises ValueError when a limit of the job is passed."""

    @property
    def folder(self) -> Path:
        return self.directory.job(self.job_id)

    @property
    def files(self) -> Path:
        """Results that can be downloaded."""
        return self.directory.job_files(self.job_id)

    def fetch_asset(self, asset_id: str) -> Path:
        """The folder of an asset on this machine; waits for a store that is away.

        Raises:
            JobStopped, StoreAway, ArtifactMissing, ArtifactDamaged
        """
        return retry_while_unavailable(lambda: fetch_asset(self.directory, asset_id), self.should_stop)

    def fetch_edit_files(self, edits: Sequence[Edit]) -> None:
        """The same for the files and clips that edits name."""
        retry_while_unavailable(lambda: fetch_edit_files(self.directory, edits), self.should_stop)


class AbstractJobRun(ABC):
    """A job of one kind."""

    steps: tuple[str, ...]
    """In order; the same in every execution of the job."""

    @abstractmethod
    def run(self, step: str) -> None:
        """Do a step.

        Raises:
            JobStopped: should_stop() was true; what is finished is on disk.
            ValueError: a sentence, when the job cannot be done.
        """
