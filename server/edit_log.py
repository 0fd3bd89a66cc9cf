"""The edits of a session: a value made by replaying its events, which are only ever added.

An event is an edit, `replace` (the last step once more, while a slider is dragged), `splice` (some edits in the place of some of those in
force), `restore` (the list of a snapshot instead of all of them), undo or redo. A splice and a restore are one step of undo, as an edit is.
The revision is the number of events. Same events, same log: that is how a session comes back after a crash.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from typing import Literal

from drgs.scene.edits import Edit
from server import messages

EventKind = Literal["edit", "replace", "splice", "restore", "undo", "redo"]


class NothingToDo(ValueError):
    """There is nothing to undo or redo."""


@dataclass(frozen=True)
class Splice:
    """Of the edits in force the first `start` stay, the next `remove` go, and `edits` come in their place."""

    start: int
    remove: int
    edits: tuple[Edit, ...]


@dataclass(frozen=True)
class Restored:
    """Stands for everything in force, whatever came before."""

    edits: tuple[Edit, ...]


Entry = Edit | Restored
Change = Edit | Sequence[Edit] | Splice


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

    def after(self, kind: EventKind, change: Change | None = None) -> "EditLog":
        """The log with one event more.

        Args:
            change: the edit, the splice, or the edits that restore brings.

        Raises:
            NothingToDo: undo, redo or replace has nothing to work on.
            ValueError: the change does not fit the kind, or a splice removes edits that are not there.
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
        if change is None:
            raise ValueError(f"an event of kind {kind!r} needs what it puts into the log")
        entry = self._entry(change)
        if kind == "replace":
            if not self.can_replace(change):
                raise NothingToDo("There is no such step to replace.")
            return EditLog(revision, (*self.entries[:-1], entry))
        return EditLog(revision, (*self.entries, entry))

    def _entry(self, change: Change) -> Entry:
        if isinstance(change, Splice):
            done = self.done
            end = change.start + change.remove
            if end > len(done):
                raise ValueError(f"The splice removes edits up to number {end}, but {len(done)} are in force.")
            return Restored(done[: change.start] + change.edits + done[end:])
        return Restored(tuple(change)) if isinstance(change, Sequence) else change

    def can_replace(self, change: Change) -> bool:
        """Whether the last step of undo is of the kind that this change makes."""
        return bool(self.entries) and isinstance(self.entries[-1], Restored) == isinstance(change, Splice)

    @property
    def appended(self) -> int:
        """How many edits, counted from the last, are steps of undo of their own."""
        return sum(1 for _ in takewhile(_is_edit, reversed(self.entries)))

    def message(self) -> messages.EditLog:
        """As callers see it. Its parts are valid already; looking once more takes milliseconds of a long log."""
        return messages.EditLog.model_construct(
            revision=self.revision,
            edits=list(self.done),
            can_undo=bool(self.entries),
            can_redo=bool(self.undone),
            appended=self.appended,
            undone=list(takewhile(_is_edit, reversed(self.undone))),  # type: ignore[arg-type]
        )


def _is_edit(entry: Entry) -> bool:
    return not isinstance(entry, Restored)
