"""What a server was started with."""

from dataclasses import dataclass, field
from pathlib import Path

SAMPLE_CAPTURE = Path(__file__).resolve().parent.parent / "examples" / "sample_capture"
BUNDLED_ENVIRONMENTS = Path(__file__).resolve().parent.parent / "examples" / "environments"
STATIC_FOLDER = Path(__file__).resolve().parent / "static"
"""Where the web build writes."""


@dataclass(frozen=True)
class ServerSettings:
    data: Path
    host: str = "127.0.0.1"
    port: int = 8000
    host_names: tuple[str, ...] = ("localhost", "127.0.0.1", "[::1]")
    """Values of `Host`, without the port, that are answered."""
    capture_roots: tuple[Path, ...] = ()
    """Folders below which a job may name a capture."""
    sample_capture: Path = SAMPLE_CAPTURE
    bundled_environments: Path = BUNDLED_ENVIRONMENTS
    """EXR files that every data directory gets a copy of."""
    static_folder: Path = STATIC_FOLDER
    device: str = "auto"
    """auto, cpu or cuda: where frames are rendered."""
    limits: "Limits" = field(default_factory=lambda: Limits())


@dataclass(frozen=True)
class Limits:
    """What one caller may ask for."""

    body_bytes: int = 16 << 20
    """Of requests that are not uploads."""
    upload_bytes: int = 4 << 30
    active_jobs: int = 1000
    """That wait or run; more are answered 429."""
    viewers: int = 64
    sessions: int = 1000
    snapshots: int = 200
    """Of one session."""
    undo_delete_seconds: float = 24 * 3600
    """How long a deleted asset can be brought back."""
    edits: int = 20_000
    """In one session's log."""
    loaded_assets: int = 4
    """In memory; the least recently used one without viewers goes first."""
