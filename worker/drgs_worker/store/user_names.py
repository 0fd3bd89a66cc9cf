"""What users call things: assets, jobs, snapshots, environments. One type for all of them, checked where a name comes in.

What programs call things (ids, keys, paths) is looked up and never shown: it only has to be text that a database and a path can hold.

A name is one line of text that a list can show, a database keep and an address hold. In: text from a request, or a file's name. Out: the
name in Unicode's composed form (NFC), without blanks at its ends.
"""

import unicodedata
from typing import Annotated

from pydantic import AfterValidator, Field

LONGEST_NAME = 100
"""Characters."""
_UNSEEN = ("Cc", "Cs", "Zl", "Zp")
"""Unicode's categories of control characters, halves of pairs, and separators of lines and paragraphs."""
_TURNING = frozenset("\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069")
"""Change the direction of what follows them: a list with such a name reads otherwise than it is."""
_MARKS = ("Mn", "Mc", "Me", "Cf", "Zs")
"""Categories of what is seen on, between or around other characters only."""
_BLANK = frozenset("\u115f\u1160\u2800\u3164\uffa0")
"""Letters and signs that are drawn as nothing."""
_PLACES = frozenset("/\\")
"""Divide addresses and paths."""


def _is_allowed(character: str) -> bool:
    return unicodedata.category(character) not in _UNSEEN and character not in _TURNING | _PLACES


def _is_seen(character: str) -> bool:
    return unicodedata.category(character) not in _MARKS and character not in _BLANK


def check_text(text: str) -> str:
    """A text that databases and paths can hold.

    Raises:
        ValueError: it holds NUL, or half a character.
    """
    bad = next((character for character in text if character == "\0" or unicodedata.category(character) == "Cs"), None)
    if bad is not None:
        raise ValueError(f"expected text without NUL and halves of characters; found {bad!a}")
    return text


def check_name(text: str) -> str:
    """The name that a text is.

    Raises:
        ValueError: it is empty, too long, only dots, nothing that can be seen, or holds a character that names do not have.
    """
    bad = next((character for character in text if not _is_allowed(character)), None)
    if bad is not None:
        raise ValueError(f"a name is one line of text without slashes; found the character {bad!a}")
    name = unicodedata.normalize("NFC", text).strip()
    if not name.strip("."):
        raise ValueError(f"a name has at least one character besides blanks and dots; found {text[:20]!r}")
    if not any(_is_seen(character) for character in name):
        raise ValueError(f"a name can be seen; found nothing but {text[:20]!a}")
    if len(name) > LONGEST_NAME:
        raise ValueError(f"a name has at most {LONGEST_NAME} characters; found {len(name)}")
    return name


def name_from_file(stem: str, otherwise: str) -> str:
    """A name like that of a file or folder, which nobody chose for us; `otherwise` where nothing of it is left."""
    kept = "".join(character if _is_allowed(character) else "-" for character in stem)
    name = unicodedata.normalize("NFC", kept).strip()[:LONGEST_NAME].strip()
    return name if name.strip(".-") and any(_is_seen(character) for character in name) else otherwise


UserName = Annotated[str, Field(min_length=1, max_length=LONGEST_NAME), AfterValidator(check_name)]
"""Of a body, a query or a path."""
PlainText = AfterValidator(check_text)
"""Of a string that is looked up."""
