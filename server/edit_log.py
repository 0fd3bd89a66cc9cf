"""The edits of a session: a value made by replaying its events, which are only ever added.

An event is an edit, `replace` (the last edit once more, while a slider is dragged), undo or redo. The revision is the number of
events. Same events, same log: that is how a session comes back after a crash.
"""

from dataclasses import dataclass
from typing import Literal

from drgs.scene.edits import Edit
from server import messages

EventKind = Literal["edit", "replace", "undo", "redo"]


class NothingToDo(ValueError):
    """There is nothing to undo or redo."""


@dataclass(frozen=True)
class EditLog:
    """`done` are in force, in order; `undone` can come back, the last one first."""

    revision: int = 0
    done: tuple[Edit, ...] = ()
    undone: tuple[Edit, ...] = ()

    def after(self, kind: EventKind, edit: Edit | None = None) -> "EditLog":
        """The log with one event more.

        Raises:
            NothingToDo: undo, redo or replace has nothing to work on.
        """
        revision = self.revision + 1
        if kind == "undo":
            if not self.done:
                raise NothingToDo("There is nothing to undo.")
            return EditLog(revision, self.done[:-1], (*self.undone, self.done[-1]))
        if kind == "redo":
            if not self.undone:
                raise NothingToDo("There is nothing to redo.")
            return EditLog(revision, (*self.done, self.undone[-1]), self.undone[:-1])
        if edit is None:
            raise ValueError(f"an event of kind {kind!r} needs an edit")
        if kind == "replace":
            if not self.done:
                raise NothingToDo("There is no edit to replace.")
            return EditLog(revision, (*self.done[:-1], edit))
        return EditLog(revision, (*self.done, edit))

    def message(self) -> messages.EditLog:
        """As callers see it."""
        return messages.EditLog(revision=self.revision, edits=list(self.done), can_undo=bool(self.done), can_redo=bool(self.undone))
