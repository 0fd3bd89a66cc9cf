"""The edits of a session: a value made by replaying its events, which are only ever added.

An event is an edit, `replace` (the last edit once more, while a slider is dragged), `restore` (the list of a snapshot instead of what
is in force, one step of undo like an edit), undo or redo. The revision is the number of events. Same events, same log: that is how a
session comes back after a crash.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from drgs.scene.edits import Edit
from server import messages

EventKind = Literal["edit", "replace", "restore", "undo", "redo"]


class NothingToDo(ValueError):
    """There is nothing to undo or redo."""


@dataclass(frozen=True)
class Restored:
    """Stands for everything in force, whatever came before."""

    edits: tuple[Edit, ...]


Entry = Edit | Restored


@dataclass(frozen=True)
class EditLog:
    """What undo takes away one by one, and what redo brings back, the last one first."""

    revision: int = 0
    entries: tuple[Entry, ...] = ()
    undone: tuple[Entry, ...] = ()

    @cached_property
    def done(self) -> tuple[Edit, ...]:
        """The edits in force, in order."""
        for index in range(len(self.entries) - 1, -1, -1):
            if isinstance(entry := self.entries[index], Restored):
                return entry.edits + self.entries[index + 1 :]  # type: ignore[operator]
        return self.entries  # type: ignore[return-value]

    def after(self, kind: EventKind, change: Edit | Sequence[Edit] | None = None) -> "EditLog":
        """The log with one event more.

        Args:
            change: the edit, or the edits that restore brings.

        Raises:
            NothingToDo: undo, redo or replace has nothing to work on.
        """
        revision = self.revision + 1
        if kind == "undo":
            if not self.entries:
                raise NothingToDo("There is nothing to undo.")
            return EditLog(revision, self.entries[:-1], (*self.undone, self.entries[-1]))
        if kind == "redo":
            if not self.undone:
                raise NothingToDo("There is nothing to redo.")
            return EditLog(revision, (*self.entries, self.undone[-1]), self.undone[:-1])
        if kind == "restore":
            if not isinstance(change, Sequence):
                raise ValueError("an event of kind 'restore' needs a list of edits")
            return EditLog(revision, (*self.entries, Restored(tuple(change))))
        if change is None or isinstance(change, Sequence):
            raise ValueError(f"an event of kind {kind!r} needs an edit")
        if kind == "replace":
            if not self.can_replace:
                raise NothingToDo("There is no edit to replace.")
            return EditLog(revision, (*self.entries[:-1], change))
        return EditLog(revision, (*self.entries, change))

    @property
    def can_replace(self) -> bool:
        """Whether the last step of undo is an edit."""
        return bool(self.entries) and not isinstance(self.entries[-1], Restored)

    def message(self) -> messages.EditLog:
        """As callers see it."""
        return messages.EditLog(revision=self.revision, edits=list(self.done), can_undo=bool(self.entries), can_redo=bool(self.undone))
