"""What the server freed goes back to the system."""

import threading

import numpy as np
import psutil

from drgs_server.live.return_memory import memory_returner


def test_memory_that_threads_freed_is_given_back() -> None:
    """Small blocks, which the allocator keeps: 200 MB on a thread of their own."""
    process = psutil.Process()

    def use() -> None:
        blocks = [np.ones(8192) for _ in range(3200)]
        kept.append(blocks[::64])

    kept: list[list[np.ndarray]] = []
    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    held = process.memory_info().rss
    memory_returner()()
    assert held - process.memory_info().rss > 100 << 20
