"""Pose an asset by a session's edits, though some of them apply no longer: a file of theirs is gone, or this version reads them otherwise.

What is in a log may not keep the session from opening. An edit that fails is left out, with the sentence that says why; only one that has just
come is refused, since nobody would look for it later.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from drgs.scene.edits import Edit
from drgs_server.api.problems import ProblemError
from drgs_server.render.interface import AbstractPose

FAILURES = (ValueError, OSError, ArithmeticError, ProblemError)
"""Of a pose: edits that do not fit, files that cannot be read, numbers that cannot be computed with."""


@dataclass(frozen=True)
class PosedEdits:
    """An asset under the edits of a list that apply."""

    pose: AbstractPose
    broken: dict[int, str] = field(default_factory=dict)
    """Place in the list -> why the edit there was left out, a sentence."""


def pose_edits(
    pose: Callable[[Sequence[Edit]], AbstractPose],
    edits: Sequence[Edit],
    is_new: Callable[[Edit], bool],
    missing: Callable[[Edit], str | None],
) -> PosedEdits:
    """Pose by all edits that apply.

    Args:
        pose: the asset under some edits, or one of FAILURES.
        is_new: whether an edit has just come, and must apply.
        missing: why what an edit refers to is not there, if so; asked only when something fails.

    Raises:
        FAILURES: a new edit does not apply, or what fails may be there again in a moment.
    """
    broken: dict[int, str] = {}
    searched = False
    while True:
        try:
            return PosedEdits(pose(_without(edits, broken)), broken)
        except FAILURES as error:
            if passes(error):
                raise
            kept = [place for place in range(len(edits)) if place not in broken]
            if not searched:  # a lost file may have broken many
                searched = True
                lost = {place: reason for place in kept if not is_new(edits[place]) and (reason := missing(edits[place])) is not None}
                if lost:
                    broken |= lost
                    continue
            count, reason = _first_failure(pose, [edits[place] for place in kept], error)
            place = kept[count - 1] if count else None
            if place is None or is_new(edits[place]):
                raise
            broken[place] = reason


def _without(edits: Sequence[Edit], broken: dict[int, str]) -> Sequence[Edit]:
    """The edits that apply; all of a long list as it is, for that takes no time."""
    return [edit for place, edit in enumerate(edits) if place not in broken] if broken else edits


def passes(error: Exception) -> bool:
    """Whether the same may go well in a moment: a store that is away, a queue that is full. No edit is broken by that."""
    return isinstance(error, ProblemError) and error.retry_after is not None


def _first_failure(pose: Callable[[Sequence[Edit]], AbstractPose], edits: Sequence[Edit], error: Exception) -> tuple[int, str]:
    """How many edits it takes to fail, found by halving, and how that fails; 0 where the asset itself does.

    Args:
        error: of all edits together.
    """
    fine, failing = -1, len(edits)
    while failing - fine > 1:
        count = (fine + failing) // 2
        try:
            pose(edits[:count])
            fine = count
        except FAILURES as earlier:
            if passes(earlier):
                raise
            failing, error = count, earlier
    return failing, ProblemError(422, str(error)).detail
