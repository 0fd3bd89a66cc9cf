"""What the doctor says of a capture: a sentence, what to do about it, and which pictures it is about."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

MOST_NAMED = 3


@dataclass(frozen=True)
class Finding:
    """One thing that helps or hurts a build."""

    level: Literal["error", "warning", "info"]
    """error: there is nothing to build from."""
    sentence: str
    advice: str = ""
    pictures: tuple[str, ...] = ()
    """Names of those it is about; none: the capture as a whole."""
    mark: str = ""
    """The same in a word or two, for a small picture's label."""


Section = tuple[dict[str, Any], list[Finding]]
"""Figures of one side of a capture, and what is to be said of them."""


def told(findings: Sequence[Finding]) -> dict[str, Any]:
    """Of a report: `findings`, their `advice` alone, and `marks`, which are labels by picture."""
    marks: dict[str, list[str]] = {}
    for finding in findings:
        for name in finding.pictures if finding.mark else ():
            marks.setdefault(name, []).append(finding.mark)
    return {
        "findings": [{"level": finding.level, "sentence": finding.sentence, "advice": finding.advice} for finding in findings],
        "advice": [finding.advice for finding in findings if finding.advice],
        "marks": marks,
    }


def few(names: Sequence[str]) -> str:
    """The first of many."""
    return ", ".join(names[:MOST_NAMED]) + (", ..." if len(names) > MOST_NAMED else "")
