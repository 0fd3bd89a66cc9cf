"""Whether something failed because the disk is full, may not be written, or does not answer: that is nobody's wrong input, and passes."""

import errno

SENTENCE = "The disk is full; nothing was changed. Free some space and try again."
_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""The disk, the user's share of it, or the largest file that the process may write."""
_SENTENCES = dict.fromkeys(_FULL, SENTENCE) | {
    errno.EROFS: "The data folder cannot be written now; nothing was changed. Look whether its disk is still mounted for writing, and try again.",
    errno.EACCES: "The server may not write into its data folder; nothing was changed. Give it back its rights there, and try again.",
    errno.EPERM: "The server may not write into its data folder; nothing was changed. Give it back its rights there, and try again.",
    errno.EIO: "The disk does not answer as it should; nothing was changed. Look whether it is failing, and try again.",
    errno.EMFILE: "The server has as many files open as the system lets it; nothing was changed. Try again in a moment.",
    errno.ENFILE: "The system has as many files open as it can; nothing was changed. Try again in a moment.",
}
"""What a caller reads."""


def is_disk_full(error: BaseException) -> bool:
    """By its number, or its words where a library has made an error of its own of it."""
    if isinstance(error, OSError) and error.errno is not None:
        return error.errno in _FULL
    return any(words in str(error) for words in ("No space left on device", "os error 28", "os error 122"))


def sentence_of(error: BaseException) -> str | None:
    """What a caller can be told and may try again after; None where it is something else."""
    if is_disk_full(error):
        return SENTENCE
    return _SENTENCES.get(error.errno) if isinstance(error, OSError) and error.errno is not None else None
