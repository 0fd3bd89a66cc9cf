"""Whether something failed because there is no room left: that is nobody's wrong input, and passes."""

import errno

SENTENCE = "The disk is full; nothing was changed. Free some space and try again."
_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""The disk, the user's share of it, or the largest file that the process may write."""


def is_disk_full(error: BaseException) -> bool:
    """By its number, or its words where a library has made an error of its own of it."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in _ERRORS
    return any(words in str(error) for words in ("No space left on device", "os error 28", "os error 122"))
