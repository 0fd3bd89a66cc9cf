"""Jobs outlast a short outage of the store that machines share."""

import time
from collections.abc import Callable
from typing import TypeVar

from drgs_worker.jobs.progress import JobStopped
from drgs_worker.store.artifact_store import StoreAway

Result = TypeVar("Result")

OUTAGE_SECONDS = 120.0
"""How long a job waits for a store that is away; then it fails with a sentence and can be retried."""
OUTAGE_POLL_SECONDS = 1.0


def retry_while_unavailable(
    work: Callable[[], Result], should_stop: Callable[[], bool], patience_seconds: float = OUTAGE_SECONDS
) -> Result:
    """Do it again while the store is away.

    Raises:
        JobStopped: should_stop() was true.
        StoreAway: it did not come back in all that time.
    """
    give_up_at = time.monotonic() + patience_seconds
    while True:
        try:
            return work()
        except StoreAway:
            if should_stop():
                raise JobStopped from None
            if time.monotonic() > give_up_at:
                raise
            time.sleep(OUTAGE_POLL_SECONDS)
