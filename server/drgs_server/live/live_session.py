"""A session in this process, and the answers to changes of its log."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field

from drgs_server.api.problems import ProblemError
from drgs_server.live import messages
from drgs_server.live.edit_log import EditLog
from drgs_server.live.pose_work import PoseWork
from drgs_server.live.viewer import Posed, Viewer
from drgs_server.render.interface import AbstractLoadedAsset


class Overtaken(ProblemError):
    """The log was changed since the caller looked at it."""

    def __init__(self, found: int, expected: int) -> None:
        super().__init__(409, f"This session's edits were changed meanwhile (revision {found}, not {expected}); read them and send again.")


@dataclass(frozen=True)
class Applied:
    """Answer to a change of the log."""

    revision: int
    """Of the log with this change in it."""
    state: EditLog
    """With it; a later one when the change had been applied before and was sent again."""

    @property
    def log(self) -> messages.EditLog:
        """The state as callers see it."""
        return self.state.message()


@dataclass(eq=False)
class LiveSession:
    """State of one session in this process. Everything but `posed` is touched on the event loop only."""

    id: str
    asset_id: str
    asset_name: str
    created_at: float
    log: EditLog
    posed: Posed | None = None
    """None while the asset is not in memory; read by the render thread."""
    loaded: AbstractLoadedAsset | None = None
    viewers: set[Viewer] = field(default_factory=set)
    listeners: set[Callable[[str], None]] = field(default_factory=set)
    """Given the stream's message about every change of the log, which the log is after."""
    keys: dict[str, int] = field(default_factory=dict)
    """Revision that each client key was answered with."""
    work: PoseWork | None = None
    """Of the change that is being posed, so that it can be cancelled."""
    lock: asyncio.Lock = field(default_factory=asyncio.Lock)
    """Held while the log changes: edits are applied in the order in which they came."""
    gone: asyncio.Event = field(default_factory=asyncio.Event)
    """Set once its asset was deleted: nothing is shown or applied here any more."""
