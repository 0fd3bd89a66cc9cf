"""Zip files that anybody may have made: what can be wrong with one is a ValueError that says what, and nothing else is raised.

In: a zip and what to call it in sentences. Out: its entries, as `zipfile` gives them. Names, sizes and ratios are for the caller to judge.
Only plain and deflated entries are read, so that nothing but deflate can fail while one is unpacked.
"""

import zipfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED, _PATCHED, _STRONGLY_ENCRYPTED = 0x1, 0x20, 0x40
"""Flag bits of entries."""


def open_zip(source: Path | IO[bytes], what: str) -> zipfile.ZipFile:
    """
    Args:
        what: begins the sentences, such as a path and a colon.

    Raises:
        ValueError: it is none, its list of entries is damaged, or it was made by a later kind of program.
        OSError: it cannot be read at all.
    """
    try:
        return zipfile.ZipFile(source)
    except zipfile.BadZipFile as error:
        raise ValueError(f"{what} is no zip, or the list of what it holds is damaged ({error})") from error
    except NotImplementedError as error:
        raise ValueError(f"{what} was zipped in a way that is not read here ({error})") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{what} is damaged: it holds a name that is no text ({error})") from error


@contextmanager
def open_entry(archive: zipfile.ZipFile, entry: zipfile.ZipInfo, what: str) -> Iterator[IO[bytes]]:
    """An entry's content; damage that is met while it is read ends the `with` block.

    Raises:
        ValueError: it is encrypted, packed by another method, or damaged.
    """
    if entry.flag_bits & (_ENCRYPTED | _STRONGLY_ENCRYPTED):
        raise ValueError(f"{what} is encrypted; zip it without a password")
    if entry.compress_type not in _METHODS or entry.flag_bits & _PATCHED:
        raise ValueError(f"{what} is packed by method {entry.compress_type}; expected a plain or deflated entry")
    if not 0 <= entry.header_offset < archive.start_dir:
        raise ValueError(f"{what} is damaged: it is said to begin outside the zip")
    try:
        with archive.open(entry) as stream:
            yield stream
    except zlib.error as error:
        raise ValueError(f"{what} is damaged: it does not unpack ({error})") from error
    except EOFError as error:
        raise ValueError(f"{what} is damaged: it ends too early") from error
    except zipfile.BadZipFile as error:
        raise ValueError(f"{what} is damaged ({error})") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"{what} is damaged: its name is no text ({error})") from error
