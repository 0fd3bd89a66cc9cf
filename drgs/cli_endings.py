"""How commands end: wrong input, full disks and missing packages with one sentence on stderr and an exit code of their own.

Typer runs `Commands` around every command, so nothing heavy is imported here.
"""

import errno
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import typer
from typer.core import TyperGroup

from drgs.installation import missing_package

INPUT_EXIT_CODE = 1
USAGE_EXIT_CODE = 2
INTERRUPT_EXIT_CODE = 130


class UsageError(ValueError):
    """The command was called wrongly, which can be seen without looking at any file."""


class Commands(TyperGroup):
    def invoke(self, ctx: Any) -> Any:
        """Run the command; turn what a user can cause into one sentence and an exit code."""
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            print("drgs: stopped by Ctrl-C", file=sys.stderr)
            raise typer.Exit(INTERRUPT_EXIT_CODE) from None
        except BrokenPipeError:
            raise  # the reader of our pipe has gone: typer ends quietly
        except (ValueError, OSError) as error:
            if os.environ.get("DRGS_TRACEBACK"):
                raise
            print(f"drgs: {_sentence(error)}", file=sys.stderr)
            raise typer.Exit(USAGE_EXIT_CODE if isinstance(error, UsageError) else INPUT_EXIT_CODE) from None


def _sentence(error: ValueError | OSError) -> str:
    """What the error says, on one line; the system's own errors without their number."""
    if isinstance(error, OSError) and error.strerror:
        what = f"{error.filename}: {error.strerror}" if error.filename else error.strerror
        return f"{what}; free some space and try again" if error.errno == errno.ENOSPC else what
    return " ".join(f"{error} {getattr(error, 'advice', '')}".split())  # a CaptureFault knows what to do about it


def stopped(how_to_go_on: str) -> typer.Exit:
    """The end of a command that Ctrl-C stopped and whose work can be gone on with; says how."""
    print(f"drgs: stopped; go on with: {how_to_go_on}", file=sys.stderr)
    return typer.Exit(INTERRUPT_EXIT_CODE)


@contextmanager
def with_extra(what: str, extra: str) -> Iterator[None]:
    """Around the imports of a command that needs an extra.

    Raises:
        ValueError: one of its packages is missing; the sentence holds the command that installs it.
    """
    try:
        yield
    except ModuleNotFoundError as error:
        missing = (error.name or "").split(".")[0]
        if missing == "fcntl":
            raise ValueError(f"{what} runs on Linux and macOS; on Windows, use it in the Windows Subsystem for Linux") from error
        if missing.startswith("drgs"):
            raise
        raise ValueError(missing_package(what, missing, extra)) from error
