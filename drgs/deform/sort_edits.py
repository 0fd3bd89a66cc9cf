"""A list of edits, sorted by what they change, with digests that stand for every beginning of it.

In: edits in their order, and the folder that names in them belong to. Out: those of material and those of shape, and what is left of the light.
The list before is remembered by the identity of its edits, which are frozen: a list that is one longer, or a few shorter, costs one edit,
not all of them. Knows nothing of what edits do.
"""

import hashlib
import threading
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Generic, NamedTuple, TypeAlias, TypeVar
from weakref import WeakKeyDictionary

from drgs.deform.clip import MANIFEST, growing_clip
from drgs.scene.asset import Asset
from drgs.scene.edits import (
    DeformEdit,
    Edit,
    EnvironmentEdit,
    MaterialEdit,
    MatterEdit,
    PoseEdit,
    SimulateEdit,
    UnreadableEdit,
    VariantEdit,
    shared_beginning,
    split_rig_clip,
)

MOST_FOUND = 200
"""Characters of what is shown of an edit that cannot be read."""
ShapeEdit: TypeAlias = DeformEdit | PoseEdit | SimulateEdit
"""Edits that move things."""

REMEMBERED_LISTS = 16
"""Lists of edits that are remembered for each asset: as many sessions of one asset can be changed in turns."""
DIGEST_BYTES = 16

AnyEdit = TypeVar("AnyEdit", bound=MaterialEdit | DeformEdit | PoseEdit | SimulateEdit)


@dataclass(frozen=True)
class EditFiles:
    """Turns the names in edits into paths. A clip that is not there is looked for where it is being made."""

    base_directory: Path | None
    confine: bool
    """Refuse names that lead out of the base directory."""

    def path(self, name: str, or_folder: bool = False) -> Path:
        """
        Raises:
            ValueError: it is not there, or lies outside.
        """
        base = Path.cwd() if self.base_directory is None else Path(self.base_directory)
        path = (base / name).resolve()
        growing = growing_clip(path.parent) / MANIFEST
        if path.name == MANIFEST and not path.exists() and growing.is_file():
            path = growing
        if self.confine and not path.is_relative_to(base.resolve()):
            raise ValueError(f"the file {name!r} lies outside the folder that edits may read")
        if not path.is_file() and not (or_folder and path.is_dir()):
            raise ValueError(f"{path}: does not exist")
        return path

    def stamp(self, name: str) -> tuple:
        """Changes when the file does."""
        path = self.path(name, or_folder=True)
        states = [(file.name, file.stat()) for file in (sorted(path.iterdir()) if path.is_dir() else [path])]
        return str(path), tuple((file, state.st_mtime_ns, state.st_size) for file, state in states)


@dataclass(frozen=True, eq=False)
class EditSteps(Generic[AnyEdit]):
    """Edits of one kind, in order."""

    count: int
    _steps: list[tuple[AnyEdit, bytes]]
    """Each with the digest of the steps up to it; behind the first `count` those of longer lists."""

    def edit(self, index: int) -> AnyEdit:
        return self._steps[index][0]

    def digest(self, count: int) -> bytes:
        """Stands for the first `count`, and the files that they name: equal for equal ones."""
        return self._steps[count - 1][1] if count else b""


class Light(NamedTuple):
    """What the environment edits of a list come to."""

    rotation_degrees: float = 0.0
    intensity: float = 1.0
    files: tuple[str, ...] = ()
    """All that are named, each once, the one in force at the end; all must be there."""


@dataclass(frozen=True, eq=False)
class SortedEdits:
    """What a list of edits changes, by kind."""

    material: EditSteps[MaterialEdit]
    shape: EditSteps[ShapeEdit]
    light: Light


class _Sum(NamedTuple):
    """Of the edits up to one."""

    material: int = 0
    shape: int = 0
    changeable: int = 0
    light: Light = Light()


class _SortedList:
    """A list that grows at its end: shorter ones share it, and hold how much of it is theirs."""

    def __init__(self, begun: "_SortedList | None" = None, count: int = 0) -> None:
        """
        Args:
            begun: of which the first `count` edits are the same.
        """
        self.edits: list[Edit] = [] if begun is None else begun.edits[:count]
        self.sums: list[_Sum] = [_Sum()] if begun is None else begun.sums[: count + 1]
        """Of none, of the first, of the first two, ..."""
        last = self.sums[-1]
        self.material: list[tuple[MaterialEdit, bytes]] = [] if begun is None else begun.material[: last.material]
        self.shape: list[tuple[ShapeEdit, bytes]] = [] if begun is None else begun.shape[: last.shape]
        self.changeable: list[tuple[int, bytes]] = [] if begun is None else begun.changeable[: last.changeable]
        """Places of edits that may stand for something else now, with what they stood for."""

    def sorted(self, count: int) -> SortedEdits:
        found = self.sums[count]
        return SortedEdits(EditSteps(found.material, self.material), EditSteps(found.shape, self.shape), found.light)

    def append(self, edit: Edit, files: EditFiles) -> None:
        """
        Raises:
            ValueError: a file that the edit names is missing, or it is none that can be read; the list is as before.
        """
        last = self.sums[-1]
        if isinstance(edit, UnreadableEdit):
            raise ValueError(f"an edit that this version does not read: {edit.found[:MOST_FOUND]}")
        if isinstance(edit, EnvironmentEdit):
            named = last.light.files
            if edit.file is not None:
                named = (*(name for name in named if name != edit.file), edit.file)
            self.sums.append(last._replace(light=Light(edit.rotation, edit.intensity, named)))
        elif isinstance(edit, MatterEdit):
            from drgs.deform.matter.simulation_scene import parse_simulation_scene

            parse_simulation_scene(edit.scene)  # refused here, not when somebody simulates
            self.sums.append(last)
        elif isinstance(edit, VariantEdit):
            self.sums.append(last)
        else:
            word = _word(edit, files)
            if _may_change(edit):
                self.changeable.append((len(self.edits), word))
            if isinstance(edit, MaterialEdit):
                self.material.append((edit, _next_digest(self.material, word)))
            else:
                self.shape.append((edit, _next_digest(self.shape, word)))
            self.sums.append(_Sum(len(self.material), len(self.shape), len(self.changeable), last.light))
        self.edits.append(edit)

    def unchanged(self, count: int, files: EditFiles) -> int:
        """How many of the first edits, at most `count`, still stand for the same."""
        for place, word in self.changeable[: self.sums[count].changeable]:
            if _word(self.edits[place], files) != word:  # type: ignore[arg-type]
                return place
        return count


_lock = threading.Lock()
_known: WeakKeyDictionary[Asset, list[_SortedList]] = WeakKeyDictionary()
"""The one used last at the end."""


def sort_edits(asset: Asset, edits: Sequence[Edit], files: EditFiles) -> SortedEdits:
    """Edits by kind, in their order.

    Args:
        asset: lists are remembered as long as it lives.

    Raises:
        ValueError: a file that an edit names is missing, or an edit cannot be read.
    """
    wanted = list(edits)
    with _lock:
        lists = _known.setdefault(asset, [])
        known = next((known for known in reversed(lists) if known.edits[:1] and wanted[:1] and known.edits[0] is wanted[0]), None)
        if known is None:
            known, count = _SortedList(), 0
        else:
            lists.remove(known)
            count = known.unchanged(shared_beginning(known.edits, wanted), files)
            if count < min(len(known.edits), len(wanted)):
                known = _SortedList(known, count)  # whoever uses what it went on with holds the old one
        lists.append(known)
        del lists[:-REMEMBERED_LISTS]
        for edit in wanted[count:]:
            known.append(edit, files)
        return known.sorted(len(wanted))


def _may_change(edit: MaterialEdit | ShapeEdit) -> bool:
    """Whether what an edit stands for may become something else: by its file, or by whoever holds a list or a dictionary of it."""
    if isinstance(edit, MaterialEdit):
        return edit.select.weights_file is not None or edit.select.vertex_weights is not None
    return isinstance(edit, SimulateEdit) or _file(edit) is not None


def _word(edit: MaterialEdit | ShapeEdit, files: EditFiles) -> bytes:
    """Stands for an edit and the files that it names; equal for equal ones."""
    names = [edit.select.weights_file] if isinstance(edit, MaterialEdit) else file_names(edit)
    stamps = [files.stamp(name) for name in names if name is not None]
    return hashlib.blake2b(f"{edit.model_dump_json()} {stamps}".encode(), digest_size=DIGEST_BYTES).digest()


def file_names(edit: ShapeEdit) -> list[str]:
    """Of all files that an edit reads: whoever changes one must be noticed."""
    if isinstance(edit, SimulateEdit):
        from drgs.deform.matter.simulation_scene import mesh_files, parse_simulation_scene

        return list(mesh_files(parse_simulation_scene(edit.scene)))
    return [] if (name := _file(edit)) is None else [name]


def _file(edit: DeformEdit | PoseEdit) -> str | None:
    if isinstance(edit, PoseEdit):
        rig = split_rig_clip(edit.clip)
        return f"{edit.clip}/clip.json" if rig is None else rig[0]
    return edit.vertices


def _next_digest(steps: Sequence[tuple[object, bytes]], word: bytes) -> bytes:
    before = steps[-1][1] if steps else b""
    return hashlib.blake2b(before + word, digest_size=DIGEST_BYTES).digest()
