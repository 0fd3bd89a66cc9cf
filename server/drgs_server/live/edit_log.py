"""The edits of a session: a value made by replaying its events, which are only ever added; and the changes on their way to it.

An event is an edit, `replace` (the last step once more, while a slider is dragged), `splice` (some edits in the place of some of those in
force), `restore` (the list of a snapshot instead of all of them), undo or redo. A splice and a restore are one step of undo, as an edit is.
The revision is the number of events. Same events, same log: that is how a session comes back after a crash.

Changes of one gesture become one step here and nowhere else (docs/decisions/0007): where the newest change in the log belongs to the same
gesture, the next one replaces it; where it still waits (ChangeQueue), the next one takes its place. What a gesture is, the client says.
"""

import asyncio
import hashlib
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal

from drgs.scene.edits import Edit, shared_beginning
from drgs_server.live import messages

RequestKind = Literal["edit", "splice", "restore", "undo", "redo"]
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


EMPTY_DIGEST = "0" * 16
"""Of a log without events."""

Entry = Edit | Restored
Change = Edit | Sequence[Edit] | Splice


@dataclass(frozen=True)
class ChangeRequest:
    """A change of the log that a client asks for."""

    kind: RequestKind
    change: Change | None = None
    """The edit, the splice, or the edits that restore brings."""
    gesture: str | None = None
    """Key that changes of one movement of the hand share, and no others."""
    key: str | None = None
    """Of the client; a request whose key is known already is not applied again."""
    revision: int | None = None
    """Of the log that it is meant for; None for whichever there is."""

    @property
    def edits(self) -> Sequence[Edit]:
        """Those that it brings."""
        if isinstance(self.change, Splice):
            return self.change.edits
        return self.change if isinstance(self.change, Sequence) else [self.change] if self.change is not None else []

    def continues(self, before: "ChangeRequest") -> bool:
        """Whether it is the same step of undo as the request just before it."""
        return self.kind in ("edit", "splice") and self.gesture is not None and (self.kind, self.gesture) == (before.kind, before.gesture)


@dataclass(frozen=True)
class Steps:
    """Steps of undo, the newest last. Knows where everything was restored, so that nobody looks through all of them."""

    entries: tuple[Entry, ...] = ()
    restored_at: tuple[int, ...] = ()
    """Places of those that are Restored."""

    def pushed(self, entry: Entry) -> "Steps":
        place = (len(self.entries),) if isinstance(entry, Restored) else ()
        return Steps((*self.entries, entry), self.restored_at + place)

    def popped(self) -> "Steps":
        was_restored = isinstance(self.entries[-1], Restored)
        return Steps(self.entries[:-1], self.restored_at[:-1] if was_restored else self.restored_at)

    @property
    def edit_count(self) -> int:
        """How many, counted from the newest, are edits."""
        return len(self.entries) - (self.restored_at[-1] + 1 if self.restored_at else 0)

    @property
    def edits(self) -> tuple[Edit, ...]:
        """Those, the newest last."""
        return self.entries[len(self.entries) - self.edit_count :]  # type: ignore[return-value]


@dataclass(frozen=True)
class EditLog:
    """What undo takes away one by one, and what redo brings back, the last one first."""

    revision: int = 0
    steps: Steps = Steps()
    redoable: Steps = Steps()
    digest: str = field(default=EMPTY_DIGEST, compare=False)
    """Of all events behind it, each hashed with the digest before: who holds the same digest holds the same log."""
    newest: ChangeRequest | None = field(default=None, compare=False)
    """The request behind the newest event; not stored, for a gesture does not last over a crash."""
    broken: Mapping[int, str] = field(default_factory=dict, compare=False)
    """Place in `done` -> why the edit there is skipped, a sentence: what posing by this log has found, none before."""

    @property
    def entries(self) -> tuple[Entry, ...]:
        """What undo takes away, the next one last."""
        return self.steps.entries

    @property
    def undone(self) -> tuple[Entry, ...]:
        """What redo brings back, the next one last."""
        return self.redoable.entries

    @cached_property
    def done(self) -> tuple[Edit, ...]:
        """The edits in force, in order."""
        if not self.steps.restored_at:
            return self.steps.edits
        restored = self.entries[self.steps.restored_at[-1]]
        assert isinstance(restored, Restored)
        return restored.edits + self.steps.edits

    def event_of(self, request: ChangeRequest) -> EventKind:
        """What a request becomes in this log."""
        return "replace" if self.newest is not None and request.continues(self.newest) else request.kind

    def with_request(self, request: ChangeRequest) -> "EditLog":
        """The log with one request more.

        Raises:
            NothingToDo: undo or redo has nothing to work on.
            ValueError: a splice removes edits that are not there.
        """
        return replace(self.after(self.event_of(request), request.change), newest=request)

    def after(self, kind: EventKind, change: Change | None = None) -> "EditLog":
        """The log with one event more.

        Args:
            change: the edit, the splice, or the edits that restore brings.

        Raises:
            NothingToDo: undo, redo or replace has nothing to work on.
            ValueError: the change does not fit the kind, or a splice removes edits that are not there.
        """
        changed = self._after(kind, change)
        return replace(changed, digest=_next_digest(self.digest, kind, change))

    def _after(self, kind: EventKind, change: Change | None) -> "EditLog":
        revision = self.revision + 1
        if kind == "undo":
            if not self.entries:
                raise NothingToDo("There is nothing to undo.")
            return EditLog(revision, self.steps.popped(), self.redoable.pushed(self.entries[-1]))
        if kind == "redo":
            if not self.undone:
                raise NothingToDo("There is nothing to redo.")
            return EditLog(revision, self.steps.pushed(self.undone[-1]), self.redoable.popped())
        if change is None:
            raise ValueError(f"an event of kind {kind!r} needs what it puts into the log")
        entry = self._entry(change)
        if kind == "replace":
            if not self.entries:
                raise NothingToDo("There is no such step to replace.")
            return EditLog(revision, self.steps.popped().pushed(entry))
        return EditLog(revision, self.steps.pushed(entry))

    def _entry(self, change: Change) -> Entry:
        if isinstance(change, Splice):
            done = self.done
            end = change.start + change.remove
            if end > len(done):
                raise ValueError(f"The splice removes edits up to number {end}, but {len(done)} are in force.")
            return Restored(done[: change.start] + change.edits + done[end:])
        return Restored(tuple(change)) if isinstance(change, Sequence) else change

    @property
    def applied(self) -> list[Edit]:
        """The edits in force without those that are skipped."""
        return [edit for place, edit in enumerate(self.done) if place not in self.broken]

    def reachable(self) -> Iterator[Edit]:
        """The edits in force, and all that undo or redo may bring into force again."""
        for entry in (*self.entries, *self.undone):
            yield from entry.edits if isinstance(entry, Restored) else (entry,)

    @property
    def appended(self) -> int:
        """How many edits, counted from the last, are steps of undo of their own."""
        return self.steps.edit_count

    @cached_property
    def redone_next(self) -> tuple[Edit, ...]:
        """The edits that redo brings back one by one, the next one first."""
        return self.redoable.edits[::-1]

    def message(self) -> messages.EditLog:
        """As callers see it. Its parts are valid already; looking once more takes milliseconds of a long log."""
        return messages.EditLog.model_construct(
            revision=self.revision,
            edits=list(self.done),
            can_undo=bool(self.entries),
            can_redo=bool(self.undone),
            appended=self.appended,
            undone=list(self.redone_next),
            digest=self.digest,
            broken=self._broken_message(),
        )

    def change_since(self, before: "EditLog") -> messages.LogChangeMessage:
        """What makes this log of one before it, as callers see both."""
        return messages.LogChangeMessage.model_construct(
            before=before.digest,
            digest=self.digest,
            revision=self.revision,
            edits=_list_change(before.done, self.done),
            undone=_list_change(before.redone_next, self.redone_next),
            can_undo=bool(self.entries),
            can_redo=bool(self.undone),
            appended=self.appended,
            broken=self._broken_message(),
        )

    def _broken_message(self) -> list[messages.BrokenEdit]:
        return [messages.BrokenEdit(index=place, reason=reason) for place, reason in sorted(self.broken.items())]


def _next_digest(before: str, kind: EventKind, change: Change | None) -> str:
    """Of a log after one event more; 64 bits, which tell logs apart that nobody made alike on purpose."""
    said = hashlib.sha256(f"{before} {kind}".encode())
    if isinstance(change, Splice):
        said.update(f" {change.start} {change.remove}".encode())
        change = change.edits
    for edit in () if change is None else change if isinstance(change, Sequence) else (change,):
        said.update(edit.model_dump_json(exclude_none=True).encode() + b"\n")
    return said.hexdigest()[:16]


def _list_change(before: tuple[Edit, ...], after: tuple[Edit, ...]) -> messages.ListChange:
    start = shared_beginning(before, after)
    gone, come = before[start:], after[start:]
    kept = shared_beginning(gone[::-1], come[::-1])
    return messages.ListChange.model_construct(start=start, remove=len(gone) - kept, edits=list(come[: len(come) - kept]))


@dataclass(frozen=True)
class WaitingChange:
    """A request on its way into the log, and the messages that are answered by what becomes of it."""

    request: ChangeRequest
    message_ids: tuple[int, ...]


class ChangeQueue:
    """Final. Requests of one client, in order, until they are applied; on the event loop.

    A drag sends edits faster than they can be posed. One that waits gives its place to the next of its gesture, which would replace it at once, and
    both get one answer. One with a key of the client's stays: it is stored under it, so that it is known when it is sent again. A splice
    stays too, for it counts in the log of a revision.
    """

    def __init__(self, room: int) -> None:
        self._room = room
        self._waiting: deque[WaitingChange] = deque()
        self._closed = False
        self._moved = asyncio.Condition()

    async def put(self, request: ChangeRequest, message_id: int) -> None:
        """Returns once there is room for it."""
        async with self._moved:
            last = self._waiting[-1] if self._waiting else None
            if last is not None and request.kind == "edit" and last.request.key is None and request.continues(last.request):
                self._waiting[-1] = WaitingChange(request, (*last.message_ids, message_id))
                return
            await self._moved.wait_for(lambda: len(self._waiting) < self._room)
            self._waiting.append(WaitingChange(request, (message_id,)))
            self._moved.notify_all()

    async def take(self) -> WaitingChange | None:
        """The oldest, as soon as there is one; None once no more will come."""
        async with self._moved:
            await self._moved.wait_for(lambda: bool(self._waiting) or self._closed)
            taken = self._waiting.popleft() if self._waiting else None
            self._moved.notify_all()
            return taken

    async def close(self) -> None:
        """No more will come; those that wait are still taken."""
        async with self._moved:
            self._closed = True
            self._moved.notify_all()
