"""The stored environments: EXR files in one folder, each with a small tone-mapped picture beside it. Some are computed rather than uploaded
(made_environments.py): they are in the list of every installation, and written when they are first asked for."""

import logging
import re
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import simplejpeg

from drgs.maths.color_numpy import luminance, srgb_from_linear
from drgs.maths.constants import MIDDLE_GREY
from drgs_server.api.made_environments import LISTED, SIZE, is_made, make_environment
from drgs_server.api.problems import artifact_problem
from drgs_server.api.rest_records import EnvironmentInfo
from drgs_worker.store.artifact_store import ArtifactError, ArtifactMissing, StoreAway
from drgs_worker.store.artifacts import fetch_environment, share_artifact
from drgs_worker.store.data_directory import DataDirectory

THUMBNAIL_SIZE = (256, 128)
UNSURE_NS = 2_000_000_000
"""A folder that was changed so shortly before may have been changed twice at one time of its clock."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,79}\.exr")


class EnvironmentStore:
    """Final. Names are file names of this folder and of the form `letters-digits.exr`; nothing else is ever joined to a path. What is not here
    is looked for in the store that machines share, if there is one, and fetched; each method may then raise ArtifactError, and
    `has` ProblemError."""

    def __init__(self, directory: DataDirectory) -> None:
        self._directory = directory
        self._folder = directory.environments
        self._sizes: dict[str, tuple[int, int]] = {}
        self._making = threading.Lock()
        self._listed: tuple[int, list[EnvironmentInfo]] | None = None
        """What was in the folder when it had been changed last at this time."""

    def add_bundled(self, source: Path) -> None:
        """Copy the EXR files of a folder that are not there yet."""
        for path in sorted(source.glob("*.exr")) if source.is_dir() else ():
            if _NAME.fullmatch(path.name) and not (self._folder / path.name).exists():
                draft = self._folder / f".{path.name}.new"
                shutil.copyfile(path, draft)
                draft.rename(self._folder / path.name)
        try:
            shared = set(self._directory.store.list("environments")) if self._directory.store is not None else set()
            for path in sorted(source.glob("*.exr")) if source.is_dir() else ():
                if _NAME.fullmatch(path.name) and path.name not in shared:
                    share_artifact(self._directory, "environments", path.name, self._folder / path.name)
        except StoreAway as error:  # the next start shares them
            logging.getLogger(__name__).warning("%s", error)

    def add(self, draft: Path, wanted: str) -> EnvironmentInfo:
        """Take a readable EXR under a free name like the wanted one, shared before it is seen."""
        name = self._free_name(wanted)
        share_artifact(self._directory, "environments", name, draft)
        draft.rename(self._folder / name)
        return self.info(name)

    def has(self, name: str) -> bool:
        if _NAME.fullmatch(name) is None:
            return False
        try:
            if fetch_environment(self._directory, name).is_file():
                return True
        except ArtifactMissing:
            pass  # in no folder yet; it may be one of those that are computed
        except ArtifactError as error:
            raise artifact_problem(error) from error
        if not is_made(name):
            return False
        self._make(name)
        return True

    def _make(self, name: str) -> None:
        """Compute an environment, shared before it is seen; raises ProblemError where the store is away, and OSError where the disk is full."""
        with self._making:
            if (self._folder / name).is_file():
                return
            draft = self._folder / f".{name}.new"
            try:
                draft.write_bytes(make_environment(name))
                share_artifact(self._directory, "environments", name, draft)
                draft.rename(self._folder / name)
            except ArtifactError as error:
                raise artifact_problem(error) from error
            finally:
                draft.unlink(missing_ok=True)

    def path(self, name: str) -> Path:
        """
        Raises:
            KeyError: there is none of this name.
        """
        if not self.has(name):
            raise KeyError(name)
        return self._folder / name

    def all(self) -> list[EnvironmentInfo]:
        """By name; files that are no readable environments are left out, and of computed ones all but those that stand for their kind."""
        if self._directory.store is not None:
            return self._described({path.name for path in self._folder.glob("*.exr")} | set(self._directory.store.list("environments")))
        stamp = self._folder.stat().st_mtime_ns
        if self._listed is None or self._listed[0] != stamp or time.time_ns() - stamp < UNSURE_NS:
            self._listed = stamp, self._described({path.name for path in self._folder.glob("*.exr")})
        return self._listed[1]

    def _described(self, names: set[str]) -> list[EnvironmentInfo]:
        found = []
        for name in sorted({name for name in names if not is_made(name)} | set(LISTED)):
            try:
                found.append(self.info(name))
            except (KeyError, ValueError):  # no name of ours, or not readable
                continue
        return found

    def info(self, name: str) -> EnvironmentInfo:
        """
        Raises:
            KeyError: there is none of this name.
            ValueError: it cannot be read.
        """
        if name in LISTED:  # which need not be there to be described
            return EnvironmentInfo(name=name, title=LISTED[name], width=SIZE[0], height=SIZE[1])
        path = self.path(name)
        if name not in self._sizes:
            self._sizes[name] = exr_size(path)
        width, height = self._sizes[name]
        return EnvironmentInfo(name=name, title=path.stem.replace("_", " ").replace("-", " ").capitalize(), width=width, height=height)

    def _free_name(self, wanted: str) -> str:
        """A name of the wanted kind that no file has, nor one that is computed."""
        stem = re.sub(r"[^A-Za-z0-9_-]+", "-", wanted).strip("-_")[:60] or "environment"
        if stem.startswith(tuple(Path(name).stem for name in LISTED)):
            stem = f"my-{stem}"
        candidates = (f"{stem}.exr", *(f"{stem}-{k}.exr" for k in range(2, 10_000)))
        return next(name for name in candidates if not self.has(name))

    def thumbnail(self, name: str) -> Path:
        """The small picture, made when it is first asked for.

        Raises:
            KeyError: there is no environment of this name.
            ValueError: it cannot be read.
        """
        path = self.path(name)
        picture = path.with_suffix(".jpg")
        with self._making:
            if not picture.exists() or picture.stat().st_mtime < path.stat().st_mtime:
                draft = picture.with_suffix(".new")
                try:
                    draft.write_bytes(environment_thumbnail(path))
                    draft.rename(picture)
                finally:
                    draft.unlink(missing_ok=True)
        return picture


def environment_thumbnail(path: Path) -> bytes:
    """JPEG of an environment, exposed so that its median is middle grey, highlights rolled off (Reinhard)."""
    from drgs.exchange.exr import decode_environment

    radiance = decode_environment(path.read_bytes(), path.name)
    height, width, _ = radiance.shape
    rows = (np.arange(THUMBNAIL_SIZE[1]) + 0.5) * height / THUMBNAIL_SIZE[1]
    columns = (np.arange(THUMBNAIL_SIZE[0]) + 0.5) * width / THUMBNAIL_SIZE[0]
    small = radiance[rows.astype(int)][:, columns.astype(int)]
    small = small * (MIDDLE_GREY / max(float(np.median(luminance(small))), 1e-6))
    small = small / (1 + small)
    return simplejpeg.encode_jpeg(
        np.ascontiguousarray((srgb_from_linear(small).clip(0, 1) * 255).astype(np.uint8)), quality=85, colorspace="RGB"
    )


def exr_size(path: Path) -> tuple[int, int]:
    """Width and height from an EXR's header, which is not decoded any further.

    Raises:
        ValueError: no EXR, or its header has no dataWindow.
    """
    from drgs.exchange.exr import picture_claim

    with path.open("rb") as file:
        claim = picture_claim(file)
    if claim is None:
        raise ValueError(f"{path.name}: expected an OpenEXR file with a dataWindow in its header")
    return claim.width, claim.height
