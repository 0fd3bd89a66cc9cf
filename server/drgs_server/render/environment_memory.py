"""Stored environments in memory: each version of a file once, for all assets, as long as somebody holds it or was shown it lately.

A pose holds the environment that it is lit by. When the last pose under one is gone, it leaves memory with the next that is asked for, unless
it is among the last few.
"""

import threading
from collections import OrderedDict
from pathlib import Path
from typing import TYPE_CHECKING
from weakref import WeakValueDictionary

import numpy as np

if TYPE_CHECKING:
    import torch

    from drgs.scene.environment import Environment

RECENT_BYTES = 128 << 20
"""Of environments that stay without a pose: going back to one just left reads no file."""
Key = tuple[str, int, str]
"""Path, time of the file's last change, device."""


class EnvironmentMemory:
    """Final. Safe to use from several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: WeakValueDictionary[Key, Environment] = WeakValueDictionary()
        self._recent: OrderedDict[Key, Environment] = OrderedDict()

    def get(self, path: Path, device: "torch.device") -> "Environment":
        """
        Raises:
            ValueError: it is no longer stored, or cannot be read.
        """
        import torch

        from drgs.exchange.exr import decode_environment
        from drgs.scene.environment import Environment

        try:
            key = (str(path), path.stat().st_mtime_ns, str(device))
        except FileNotFoundError as error:
            raise ValueError(f"The environment {path.name} is no longer stored here.") from error
        with self._lock:
            known = self._held.get(key)
        if known is None:
            radiance = torch.from_numpy(np.ascontiguousarray(decode_environment(path.read_bytes(), path.name)))
            known = Environment(radiance.to(device))
        with self._lock:
            known = self._held.setdefault(key, known)
            self._recent[key] = known
            self._recent.move_to_end(key)
            while len(self._recent) > 1 and sum(map(_bytes, self._recent.values())) > RECENT_BYTES:
                self._recent.popitem(last=False)
        return known

    def bytes(self) -> int:
        """Of all that are in memory."""
        with self._lock:
            return sum(map(_bytes, list(self._held.values())))

    def forget_unused(self) -> None:
        """Keep only those that a pose holds."""
        with self._lock:
            self._recent.clear()


def _bytes(environment: "Environment") -> int:
    return environment.radiance.nbytes
