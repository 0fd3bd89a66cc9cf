"""What the doctor found in a capture, as the service keeps it with a build and tells it.

In: a folder. Out: the report, which is also kept beside the build's checkpoints, so that a build that goes on does not look again.
"""

import os
from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict


class CaptureFinding(BaseModel):
    """One thing that helps or hurts a build."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)

    level: Literal["error", "warning", "info"]
    """error: there is nothing to build from."""
    sentence: str
    advice: str
    """What to do about it; may be empty."""


class CaptureReport(BaseModel):
    """Of `drgs doctor`."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)

    summary: str
    """How many pictures of what size and with what around them; empty where the capture cannot be read."""
    findings: list[CaptureFinding]


def examine_capture(capture: Path, kept: Path) -> CaptureReport:
    """Report on a capture, or what was reported on it before.

    Args:
        kept: file that the report is written to and read from.
    """
    from drgs.evaluate.doctor import doctor

    if kept.is_file():
        return CaptureReport.model_validate_json(kept.read_text())
    found = doctor(capture)
    report = CaptureReport.model_validate({"summary": found["summary"], "findings": found["findings"]})
    kept.parent.mkdir(exist_ok=True)
    draft = kept.with_suffix(".part")
    draft.write_text(report.model_dump_json())
    os.replace(draft, kept)
    return report
