"""Whether the kernels of pictures were compiled on this machine, so that a server need not load torch and Warp to know.

Warp compiles a kernel when it is first used and keeps it; of a fresh installation the first picture waits ten seconds for thirteen modules. Who has
compiled them (drgs/render/compile_kernels.py) leaves a file whose name says of which code and for which of Warp's folders. The file is a note, not
the cache: where it is wrong, kernels are compiled when they are used, as always.
"""

import hashlib
import os
import sys
from pathlib import Path

PACKAGE = Path(__file__).parent
KERNELS = ("maths", "render", "warp_torch.py")
"""Where they are written."""


def note() -> Path:
    """The file that says that they are compiled."""
    cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return cache / "drgs" / f"kernels-{_fingerprint()}"


def are_compiled() -> bool:
    """As far as the note tells."""
    try:
        return note().is_file()
    except (OSError, RuntimeError):  # no home folder
        return False


def _fingerprint() -> str:
    """Of the code, by the sizes and times of its files, of the interpreter and of Warp's folder."""
    told = hashlib.sha256(f"{sys.prefix} {sys.version} {os.environ.get('WARP_CACHE_PATH', '')}".encode())
    for part in KERNELS:
        place = PACKAGE / part
        for path in sorted([place] if place.is_file() else [*place.rglob("*.py"), *place.rglob("*.h")]):
            state = path.stat()
            told.update(f"{path.relative_to(PACKAGE)} {state.st_size} {state.st_mtime_ns} ".encode())
    return told.hexdigest()[:16]
