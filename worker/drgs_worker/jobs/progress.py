"""What a job says while it runs, and how it ends when it is asked to."""

from collections.abc import Callable

from drgs.reconstruct.progress import Progress
from drgs_worker.jobs.capture_report import CaptureReport

Tell = Callable[[Progress | CaptureReport], None]
"""Takes how far a job is; and of a build once, before its capture is read, what the doctor found in it."""


class JobStopped(Exception):
    """should_stop() was true; what is finished is on disk."""
