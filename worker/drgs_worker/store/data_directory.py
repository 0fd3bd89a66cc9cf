"""The folder that holds everything a service keeps: one record of its paths, made on first use with mode 0700.

token               who knows it may use the service (mode 0600)
app.sqlite          assets, jobs, workers, sessions with their edit logs; unless settings name another database
jobs.sqlite         the queue's own state (DBOS), likewise. Whoever can write it runs code in workers, hence the mode of the folder
assets/ID/          finished assets
incoming/ID         uploads that are sent in parts, as far as they have come, and in ID.json what their senders said of them
uploads/ID/         captures as they came, unpacked
looks/ID/           what can be seen of a capture before a build: a sheet of its pictures, its cameras and points; may be deleted
jobs/ID/            a job's working folder: checkpoints, preview, log.txt, and in files/ what can be downloaded
environments/       NAME.exr and NAME.jpg, its small picture; clips/ID/ and weights/HASH.f32, since edits name all relative to one folder
poses/ID.safetensors   what a session's long log has made so far, so that opening it costs little; may be deleted
workers/            locks that give each worker of this machine a stable number
scratch/            what is half made, a folder for each process (worker/drgs_worker/store/scratch.py)
backups/            the last good copy of each SQLite database (worker/drgs_worker/store/backups.py)

Where settings name an artifact store, this folder is a cache of it (worker/drgs_worker/store/artifacts.py), and several machines have one each.
"""

import fcntl
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from platformdirs import user_data_path

from drgs.installation import checkout
from drgs_worker.store.artifact_store import ArtifactStore, open_artifact_store

MOST_TOLD = 600
"""Characters of a sentence about an error: what a caller sent is not sent back whole."""
LEAST_TOKEN, LONGEST_TOKEN = 32, 200
"""Characters of the secret that callers must know, wherever it is kept."""


@dataclass(frozen=True)
class DataDirectory:
    """Paths below one root. Ids in them are made by the server, never by users."""

    root: Path
    """Absolute."""
    database_url: str
    """Of assets, jobs, workers and sessions (SQLAlchemy)."""
    queue_url: str
    """Of DBOS's tables."""
    store: ArtifactStore | None = None
    """What is shared with other machines; None: this folder is all there is."""

    @property
    def token_path(self) -> Path:
        return self.root / "token"

    @property
    def assets(self) -> Path:
        return self.root / "assets"

    @property
    def uploads(self) -> Path:
        return self.root / "uploads"

    @property
    def incoming(self) -> Path:
        return self.root / "incoming"

    @property
    def jobs(self) -> Path:
        return self.root / "jobs"

    @property
    def environments(self) -> Path:
        return self.root / "environments"

    @property
    def workers(self) -> Path:
        return self.root / "workers"

    @property
    def scratch(self) -> Path:
        return self.root / "scratch"

    @property
    def poses(self) -> Path:
        return self.root / "poses"

    def asset(self, asset_id: str) -> Path:
        return self.assets / asset_id

    def look(self, capture_id: str) -> Path:
        return self.root / "looks" / capture_id

    def job(self, job_id: str) -> Path:
        return self.jobs / job_id

    def preview(self, job_id: str) -> Path:
        return self.job(job_id) / "preview.jpg"

    def job_files(self, job_id: str) -> Path:
        return self.job(job_id) / "files"

    def job_log(self, job_id: str) -> Path:
        return self.job(job_id) / "log.txt"

    def clip(self, job_id: str) -> Path:
        """What a `pose` edit calls `clips/ID`."""
        return self.environments / "clips" / job_id

    def growing_clip(self, job_id: str) -> Path:
        """Where it is while it is being made (drgs.deform.clip.growing_clip, which loads torch)."""
        return self.environments / "clips" / f"{job_id}.making"

    def told(self, sentence: str) -> str:
        """A sentence as callers may read it: files of this folder by their place in it, and no more than MOST_TOLD characters."""
        short = sentence.replace(f"{self.root}/", "").replace(str(self.root), "the data folder")
        return short if len(short) <= MOST_TOLD else f"{short[:MOST_TOLD]}..."


def default_data_folder() -> Path:
    """`data` below the present folder where drgs runs from a checkout, else the place that the system has for a user's data."""
    return Path("data") if checkout() else user_data_path("drgs", appauthor=False)


def open_data_directory(
    root: Path, database_url: str | None = None, queue_url: str | None = None, artifact_url: str | None = None
) -> DataDirectory:
    """Make what is missing and return the paths.

    Args:
        database_url: SQLite in the folder where None.
        queue_url: where None, the database NAME_jobs beside `database_url`'s NAME, or SQLite in the folder.
        artifact_url: of the store that is shared with other machines, if there is one.

    Raises:
        ValueError: `root` is a file, or cannot be made or entered; or the store's address is wrong.
    """
    root = root.expanduser().resolve()
    if root.exists() and not root.is_dir():
        raise ValueError(f"data directory {root}: expected a folder, found a file")
    try:
        root.mkdir(mode=0o700, parents=True, exist_ok=True)
        root.chmod(0o700)
        for name in ("assets", "incoming", "uploads", "looks", "jobs", "environments", "poses", "workers", "scratch"):
            (root / name).mkdir(mode=0o700, exist_ok=True)
    except OSError as error:
        raise ValueError(f"data directory {root}: {error.strerror}; name a folder you may write with --data") from error
    if database_url is not None and queue_url is None and not database_url.startswith("sqlite"):
        queue_url = f"{database_url}_jobs" if "?" not in database_url else database_url.replace("?", "_jobs?", 1)
    directory = DataDirectory(
        root,
        database_url or f"sqlite:///{root / 'app.sqlite'}",
        queue_url or f"sqlite:///{root / 'jobs.sqlite'}",
        open_artifact_store(artifact_url) if artifact_url is not None else None,
    )
    _ensure_token(directory)
    return directory


def check_token(token: str) -> str:
    """A token that is hard to guess and that a header can carry.

    Raises:
        ValueError: what was found, without the token, and what is expected.
    """
    if len(token) < LEAST_TOKEN:
        raise ValueError(f"expected {LEAST_TOKEN} characters or more, such as `openssl rand -hex 32` makes; found {len(token)}")
    if len(token) > LONGEST_TOKEN:
        raise ValueError(f"expected at most {LONGEST_TOKEN} characters, such as `openssl rand -hex 32` makes; found {len(token)}")
    if not all("!" <= character <= "~" for character in token):
        raise ValueError("expected letters, digits and signs of ASCII without blanks, such as `openssl rand -hex 32` makes")
    return token


def read_token(directory: DataDirectory) -> str:
    """The 256-bit token that callers must know.

    Raises:
        ValueError: the file is no token: it may be half written, or somebody emptied it.
    """
    try:
        return check_token(directory.token_path.read_text().strip())
    except (OSError, ValueError) as error:
        reason = "it is not text" if isinstance(error, UnicodeDecodeError) else error.strerror if isinstance(error, OSError) else error
        raise ValueError(
            f"the token in {directory.token_path} cannot be used: {reason}; delete the file, and the next start makes a new one"
        ) from error


def _ensure_token(directory: DataDirectory) -> None:
    with lock_file(directory.root / ".setup.lock"):
        if not directory.token_path.exists():
            draft = directory.root / ".token.new"
            draft.unlink(missing_ok=True)
            with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as file:
                file.write(secrets.token_hex(32) + "\n")
            draft.rename(directory.token_path)
        directory.token_path.chmod(0o600)


@contextmanager
def lock_file(path: Path) -> Iterator[None]:
    """Hold an exclusive lock between processes; the kernel releases it when its holder dies."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX)
        yield
    finally:
        os.close(descriptor)


def try_lock_file(path: Path) -> int | None:
    """Descriptor of an exclusive lock, to be kept open while it is wanted; None when another process holds it."""
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(descriptor)
        return None
    return descriptor
