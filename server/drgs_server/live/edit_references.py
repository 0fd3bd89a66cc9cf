"""What edits refer to: environments, clips, painted weights, and files of the machine, which no edit from a network may name."""

import re

from drgs.scene.edits import DeformEdit, Edit, EnvironmentEdit, MaterialEdit, PoseEdit, UnreadableEdit, VariantEdit
from drgs_server.api.environments import EnvironmentStore
from drgs_server.api.problems import ProblemError, artifact_problem
from drgs_server.live.pose_edits import passes
from drgs_worker.store.artifact_store import ArtifactError
from drgs_worker.store.artifacts import has_clip, has_weights
from drgs_worker.store.data_directory import DataDirectory

_CLIP = re.compile(r"clips/[0-9a-f]{32}")


class EditReferences:
    """Final. For any thread."""

    def __init__(self, directory: DataDirectory, environments: EnvironmentStore) -> None:
        self._directory = directory
        self._environments = environments

    def check(self, edit: Edit) -> None:
        """Edits from a network name nothing but what the server keeps.

        Raises:
            ProblemError: it does, or the store that machines share is away.
        """
        if isinstance(edit, UnreadableEdit):
            raise ProblemError(422, f"This edit was kept by another version, and this one does not read it: {edit.found[:100]}")
        if isinstance(edit, EnvironmentEdit) and edit.file is not None and not self._environments.has(edit.file):
            raise ProblemError(422, f"No environment is called {edit.file[:100]!r}; GET /api/environments lists them.")
        if isinstance(edit, DeformEdit) and edit.vertices is not None:
            raise ProblemError(
                422, "A deform edit over the network has a `map` or `handles`; `vertices` names a file and works with `drgs render` only."
            )
        if isinstance(edit, MaterialEdit) and edit.select.weights_file is not None and not self._has_weights(edit.select.weights_file):
            raise ProblemError(422, f"There are no weights {edit.select.weights_file[:100]!r}; POST them to /api/weights first.")
        if isinstance(edit, VariantEdit):
            for worn in edit.edits:
                self.check(worn)
        if isinstance(edit, PoseEdit) and not self._has_clip(edit.clip):
            raise ProblemError(
                422,
                f"There is no clip {edit.clip[:100]!r}; a simulate job that is done names its clip, and one that runs on this machine has `clips/ID` by its own id.",
            )

    def missing(self, edit: Edit) -> str | None:
        """Why what an edit refers to is not there, if so.

        Raises:
            ProblemError: the store that machines share is away.
        """
        try:
            self.check(edit)
        except ProblemError as problem:
            if passes(problem):
                raise
            return problem.detail
        return None

    def may_wait(self, edit: Edit) -> bool:
        """Whether `check` may have to fetch a file, and is nothing for the event loop."""
        if isinstance(edit, VariantEdit):
            return any(self.may_wait(worn) for worn in edit.edits)
        return isinstance(edit, PoseEdit) or (isinstance(edit, MaterialEdit) and bool(edit.select.weights_file))

    def _has_weights(self, name: str) -> bool:
        try:
            return has_weights(self._directory, name)
        except ArtifactError as error:
            raise artifact_problem(error) from error

    def _has_clip(self, clip: str) -> bool:
        try:
            return _CLIP.fullmatch(clip) is not None and has_clip(self._directory, clip, or_growing=True)
        except ArtifactError as error:
            raise artifact_problem(error) from error
