"""Keep what a process made while it got ready out of Python's garbage collection.

Loading torch, Warp and an asset leaves some 400 000 objects that live until the end. A full collection looks at all of them while it
holds Python's lock: a tenth of a second on an idle machine, in which no call is answered.
"""

import gc


def settle_memory() -> None:
    """Collect once, then leave alone all that is there now; reference counting still frees it when it is dropped."""
    gc.collect()
    gc.freeze()
