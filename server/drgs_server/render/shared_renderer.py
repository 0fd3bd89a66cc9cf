"""A renderer that first fetches, from the store that several machines share, what is not on this one."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from drgs.scene.edits import Edit
from drgs_server.api.problems import artifact_problem
from drgs_server.render.interface import AbstractLoadedAsset, AbstractPose, AbstractRenderer
from drgs_worker.store.artifact_store import ArtifactError
from drgs_worker.store.artifacts import fetch_asset, fetch_edit_files
from drgs_worker.store.data_directory import DataDirectory


class SharedRenderer(AbstractRenderer):
    """Final. Around another renderer; the folders of assets are called by their ids."""

    def __init__(self, renderer: AbstractRenderer, directory: DataDirectory) -> None:
        self._renderer = renderer
        self._directory = directory

    def load(self, folder: Path, environments: Path) -> "SharedAsset":
        """
        Raises:
            ProblemError: the store is away, or what it holds is damaged.
            ValueError: the folder holds no readable asset.
        """
        with _as_problems():
            fetch_asset(self._directory, folder.name)
        return SharedAsset(self._renderer.load(folder, environments), self._directory)

    def environment_bytes(self) -> int:
        return self._renderer.environment_bytes()

    def forget_environments(self) -> None:
        self._renderer.forget_environments()

    def prepare(self) -> None:
        self._renderer.prepare()


class SharedAsset(AbstractLoadedAsset):
    """Final."""

    def __init__(self, asset: AbstractLoadedAsset, directory: DataDirectory) -> None:
        self._asset = asset
        self._directory = directory
        self.bounds, self.start_view, self.light_camera = asset.bounds, asset.start_view, asset.light_camera

    def pose(self, edits: Sequence[Edit], previous: AbstractPose | None, go_on: Callable[[], None] | None = None) -> AbstractPose:
        """
        Raises:
            ProblemError: the store is away, or what it holds is damaged.
            ValueError: a sentence, when an edit cannot be applied.
        """
        with _as_problems():
            fetch_edit_files(self._directory, edits)
        return self._asset.pose(edits, previous, go_on)

    def keep(self, edits: Sequence[Edit], path: Path) -> None:
        self._asset.keep(edits, path)

    def recall(self, edits: Sequence[Edit], path: Path) -> bool:
        return self._asset.recall(edits, path)

    def simulation_bytes(self) -> int:
        return self._asset.simulation_bytes()

    def forget_simulations(self) -> None:
        self._asset.forget_simulations()


@contextmanager
def _as_problems() -> Iterator[None]:
    try:
        yield
    except ArtifactError as error:
        raise artifact_problem(error) from error
