"""The two trees that are compared: commits checked out beside the repository, or its working tree as it is.

In: the repository and two words for commits. Out: for each a folder and the environment in which Python runs that folder's code.
It does not know what is run.
"""

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from drgs.openmp import BLAS_ASLEEP, SPINS

WORKING_TREE = (".", "worktree")
"""Words for it."""
IMPORT_FOLDERS = ("", "server", "worker")
GENERATED = ("server/drgs_server/static", "drgs/convert/page/page.html", "web/node_modules")
"""What benchmarks of services and pages need and git ignores: both sides take the working tree's."""
OF_A_HOOK = ("GIT_DIR", "GIT_WORK_TREE", "GIT_INDEX_FILE", "GIT_COMMON_DIR", "GIT_PREFIX")
"""Git tells them its hooks; in another worktree they would name the wrong one."""


@dataclass(frozen=True)
class Side:
    """One of the two that are compared."""

    letter: str
    """A or B."""
    title: str
    """The commit's full hash, or "worktree at" the hash of HEAD."""
    root: Path
    """Absolute, of its tree."""

    def environment(self) -> dict[str, str]:
        """In which Python imports this tree's packages, whatever folder it is started in and whatever is installed."""
        # What `python -m benchmarks` chose for itself each commit chooses anew.
        chosen = {"GOMP_SPINCOUNT": SPINS, "OPENBLAS_THREAD_TIMEOUT": BLAS_ASLEEP}
        kept = {name: value for name, value in os.environ.items() if chosen.get(name) != value}
        paths = [str(self.root / folder) for folder in IMPORT_FOLDERS] + [path for path in [os.environ.get("PYTHONPATH")] if path]
        return kept | {"PYTHONPATH": os.pathsep.join(paths), "PYTHONSAFEPATH": "1"}


@contextmanager
def checked_out(repository: Path, words: tuple[str, str], folder: Path) -> Iterator[tuple[Side, Side]]:
    """Both sides while the context lasts; commits in folder/A and folder/B, which are gone afterwards.

    Raises:
        ValueError: a word names no commit, or one of the two folders is there already.
    """
    commits = [commit_hash(repository, "HEAD" if word in WORKING_TREE else word) for word in words]
    with ExitStack() as stack:
        sides = []
        for letter, word, commit in zip("AB", words, commits, strict=True):
            if word in WORKING_TREE:
                sides.append(Side(letter, f"worktree at {commit}", repository))
            else:
                root = stack.enter_context(_worktree(repository, commit, folder.resolve() / letter))
                sides.append(Side(letter, commit, root))
        yield sides[0], sides[1]


def commit_hash(repository: Path, word: str) -> str:
    """Full hash of the commit that a word names."""
    done = _git(repository, "rev-parse", "--verify", f"{word}^{{commit}}")
    if done.returncode != 0:
        raise ValueError(f"{word!r} names no commit of {repository.name} ({done.stderr.strip()}); expected one, or . for the working tree")
    return done.stdout.strip()


@contextmanager
def _worktree(repository: Path, commit: str, root: Path) -> Iterator[Path]:
    if root.exists():
        raise ValueError(f"{root} exists; a checkout is to be made there: remove it, or choose another --out")
    try:
        done = _git(repository, "worktree", "add", "--detach", "--quiet", str(root), commit)
        if done.returncode != 0:
            raise ValueError(f"git could not check out {commit}: {done.stderr.strip()}")
        _link_generated(repository, root)
        yield root
    finally:
        # A checkout that was stopped halfway is none yet, so that git may refuse.
        if _git(repository, "worktree", "remove", "--force", str(root)).returncode != 0:
            shutil.rmtree(root, ignore_errors=True)
            _git(repository, "worktree", "prune")


def _link_generated(repository: Path, root: Path) -> None:
    for name in GENERATED:
        made, wanted = repository / name, root / name
        if made.exists() and wanted.parent.is_dir() and not wanted.exists():
            wanted.symlink_to(made.resolve())


def _git(repository: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name not in OF_A_HOOK}
    return subprocess.run(["git", "-C", str(repository), *arguments], capture_output=True, text=True, env=environment)
