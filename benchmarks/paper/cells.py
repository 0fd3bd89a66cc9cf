"""What is finished stays: a cell of the evidence is a JSON file, written whole or not at all, and made once.

In: a name, what was asked, and what makes it. Out: the document. A process that is killed leaves the cells that were whole; the next call goes on.
"""

import json
import os
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import safetensors.torch
from torch import Tensor

from benchmarks.measures.machine import machine
from benchmarks.reconstruct.ablate import commit


class NotMade(Exception):
    """A cell is wanted that only a longer run would make."""


@dataclass(frozen=True)
class CellFolder:
    """Cells of one evidence."""

    folder: Path
    command: str
    """That a reader repeats them with."""
    finished_only: bool = False
    """Make none."""

    def cell(self, name: str, asked: dict, make: Callable[[], dict], files: Sequence[Path] = ()) -> dict:
        """The cell of that name as asked; made where there is none, or one of other settings, or a file of it is gone.

        Args:
            files: that `make` writes.

        Returns:
            What `make` gave, and under "made": the command, commit, time and machine; under "asked": the settings.

        Raises:
            NotMade: it is not there, and none is to be made.
        """
        path = self.folder / "cells" / f"{name}.json"
        plain = json.loads(json.dumps(asked))
        if path.is_file() and all(file.is_file() for file in files):
            kept = json.loads(path.read_text())
            if kept["asked"] == plain:
                return kept
        if self.finished_only:
            raise NotMade(name)
        print(f"paper: {name} ...", file=sys.stderr, flush=True)
        document = {"asked": plain, **make(), "made": self._made()}
        write_whole(path, json.dumps(document, indent=1).encode())
        return document

    def _made(self) -> dict:
        now = datetime.now(UTC).strftime("%Y-%m-%d %H:%M UTC")
        return {"command": self.command, "commit": commit(), "time": now, "machine": machine()}


def write_tensors(path: Path, tensors: dict[str, Tensor]) -> None:
    """A file that safetensors.torch.load_file reads; each tensor by itself, though one may be another's view."""
    write_whole(path, safetensors.torch.save({name: value.contiguous().clone() for name, value in tensors.items()}))


def write_whole(path: Path, content: bytes) -> None:
    """Write a file so that a kill leaves the old one or the new one."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f"{path.name}.part")
    with part.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)
