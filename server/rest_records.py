"""Bodies of the REST interface. `generate_types.py` writes them to TypeScript beside the stream's messages."""

from datetime import datetime
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from drgs.scene.edits import Edit

JobState = Literal["queued", "running", "stalled", "done", "failed", "cancelled", "unknown"]
"""stalled: its worker died and no other took it over yet. unknown: the queue has never heard of it, which is not done."""


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class BuildRequest(_Body):
    """A build of a capture that the server can already see. A zip is uploaded as multipart instead, with the same fields."""

    dataset: Annotated[str, Field(max_length=1000)]
    """`sample` for the bundled capture, or a folder below a root that was allowed when the server started."""
    name: Annotated[str, Field(max_length=100)] | None = None
    """Of the asset; the folder's name when absent."""
    preset: Literal["draft", "fast", "full"] = "fast"
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0


class JobInfo(_Body):
    id: str
    kind: Literal["build"]
    name: str
    preset: str
    state: JobState
    created_at: datetime
    finished_at: datetime | None
    stage: str
    """Of the build; empty before it starts."""
    iteration: int
    iterations: int
    fraction: float
    """Of the whole job, 0..1."""
    psnr: float | None
    eta_seconds: float | None
    message: str
    attempts: int
    """How often the work was started: 1 unless a worker died or it was retried."""
    asset_id: str | None
    """Set when done."""
    error: str | None
    """A sentence, when failed."""
    preview_version: int
    """Rises with each new preview picture; 0 while there is none. Use it to get round the browser's cache."""


class JobList(_Body):
    jobs: list[JobInfo]
    """Newest first."""
    total: int
    workers_alive: int


class AssetInfo(_Body):
    id: str
    name: str
    created_at: datetime
    bytes: int
    source: str
    """build, upload or session."""
    surfel_count: int
    """0 for an asset made from a mesh."""
    vertex_count: int
    face_count: int
    has_thumbnail: bool


class AssetList(_Body):
    assets: list[AssetInfo]
    """Newest first."""
    total: int


class EnvironmentInfo(_Body):
    name: str
    """What an environment edit's `file` says."""
    title: str
    width: int
    height: int


class EnvironmentList(_Body):
    environments: list[EnvironmentInfo]


class SessionRequest(_Body):
    asset: str


class SessionInfo(_Body):
    id: str
    asset: str
    asset_name: str
    created_at: datetime
    revision: int
    edits: list[Edit]
    can_undo: bool
    can_redo: bool
    viewers: int


class SessionList(_Body):
    sessions: list[SessionInfo]


class EditRequest(_Body):
    edit: Edit


class TokenRequest(_Body):
    token: Annotated[str, Field(max_length=200)]


class Health(_Body):
    status: Literal["ok"] = "ok"


class Problem(BaseModel):
    """RFC 9457 problem details; `detail` is a sentence a user can act on."""

    model_config = ConfigDict(json_schema_serialization_defaults_required=True)

    type: str = "about:blank"
    title: str
    status: int
    detail: str
