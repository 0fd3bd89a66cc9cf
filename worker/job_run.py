"""One execution of one job in this process: an ordered list of durable steps, and how to do each.

A step's result must be on disk when `run` returns, since after a crash another process goes on behind it; and running a step again
that a crash interrupted must do no harm. What steps share in memory is kept in the object, which lives as long as the execution.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Engine

from drgs.scene.edits import Edit
from worker.artifacts import bring_asset, bring_edit_files, patiently
from worker.builders import Builder, BuildProgress
from worker.data_directory import DataDirectory


@dataclass(frozen=True)
class JobContext:
    """What a job works with."""

    job_id: str
    name: str
    parameters: dict
    """Its request, as plain data."""
    dataset: Path | None
    """Of builds."""
    directory: DataDirectory
    engine: Engine
    builder: Builder
    device: str
    progress: Callable[[BuildProgress], None]
    should_stop: Callable[[], bool]
    """Cheap; to be asked several times a second. Raises ValueError when a limit of the job is passed."""

    @property
    def folder(self) -> Path:
        return self.directory.job(self.job_id)

    @property
    def files(self) -> Path:
        """Results that can be downloaded."""
        return self.directory.job_files(self.job_id)

    def bring_asset(self, asset_id: str) -> Path:
        """Its folder on this machine; waits for a store that is away.

        Raises:
            BuildStopped, StoreAway, ArtifactMissing, ArtifactDamaged
        """
        return patiently(lambda: bring_asset(self.directory, asset_id), self.should_stop)

    def bring_edit_files(self, edits: Sequence[Edit]) -> None:
        """The same of what edits name."""
        patiently(lambda: bring_edit_files(self.directory, edits), self.should_stop)


class AbstractJobRun(ABC):
    """Of one kind of job."""

    steps: tuple[str, ...]
    """In order; the same in every execution of the job."""

    @abstractmethod
    def run(self, step: str) -> None:
        """Do a step.

        Raises:
            BuildStopped: should_stop() was true; what is finished is on disk.
            ValueError: a sentence, when the job cannot be done.
        """
