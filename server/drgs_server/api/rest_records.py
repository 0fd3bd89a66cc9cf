"""Bodies of the REST interface, but for what jobs are asked for (worker/drgs_worker/jobs/requests.py). `generate_types.py` writes them to TypeScript
beside the stream's messages."""

from datetime import datetime
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from drgs.scene.edits import Edit, MaterialEdit, MaterialVariant, Triple
from drgs.scene.strokes import StrokeList
from drgs_server.live.messages import BrokenEdit, Row
from drgs_worker.jobs.capture_report import CaptureFinding, CaptureReport
from drgs_worker.jobs.requests import (
    BuildRequest,
    ExportRequest,
    JobKind,
    PoseRequest,
    RedecoupleRequest,
    RenderRequest,
    SimulateRequest,
)
from drgs_worker.store.user_names import PlainText, UserName

__all__ = ["BuildRequest", "ExportRequest", "PoseRequest", "RedecoupleRequest", "RenderRequest", "SimulateRequest"]

JobState = Literal["queued", "running", "stalled", "done", "failed", "cancelled", "unknown"]
"""stalled: its worker died and no other took it over yet. unknown: the queue has never heard of it, which is not done."""


class _Body(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class CaptureRequest(_Body):
    upload: Annotated[str, Field(pattern=r"^[0-9a-f]{32}$")]
    """Id of a complete upload: a zip of a capture."""
    name: UserName | None = None
    """That of the uploaded file when absent."""


class CaptureInfo(_Body):
    id: str
    """A build says `capture:ID` to read it."""
    name: str
    created_at: datetime
    jobs: list[str]
    """Ids of builds, of re-decouplings of what they made, and of searches for poses, that read it. Without any, it is removed a day after it came."""


class CaptureList(_Body):
    captures: list[CaptureInfo]
    """Newest first."""
    total: int


class TrainingView(_Body):
    """One camera of the capture that an asset was built from."""

    name: str
    """Of the photograph's file, without its ending."""
    width: int
    """Pixels of the photograph as the build saw it."""
    height: int
    world_from_camera: tuple[Row, Row, Row, Row]
    """OpenGL camera-to-world, rows, as of a camera message."""
    left: float
    """This and the next three: edges of the picture on the plane at distance 1 before the camera, x to the right and y up. The picture's
    middle need not lie on the axis."""
    right: float
    bottom: float
    top: float


class SheetLayout(_Body):
    """Where the tiles of a capture's sheet lie, so that a page can show them in rows of its own. Lengths are shares of the sheet's width or height."""

    count: int
    """Of tiles."""
    columns: int
    left: float
    """Of the first tile."""
    top: float
    across: float
    """From one tile to the next in its row."""
    down: float
    """From one row to the next; a tile with its label is as high."""
    width: float
    """Of a tile."""
    aspect: float
    """A tile's width over its height."""


class CaptureLook(_Body):
    """What can be seen of a capture before a build."""

    ok: bool
    """Whether a build can start."""
    summary: str
    """How many pictures of what size and with what around them; empty where the capture cannot be read."""
    findings: list[CaptureFinding]
    has_sheet: bool
    """Whether there are pictures to show (GET .../sheet.jpg)."""
    sheet: SheetLayout | None = None
    """None where there are none."""
    camera_count: int
    """0 where a build finds them first, or the capture cannot be read."""
    cameras: list[TrainingView]
    """All, or 400 evenly chosen."""
    up: Triple | None
    """The mean of the cameras' own up, in the capture's world; None without cameras."""
    box_low: Triple | None
    """This and the next: corners of the object's box [world units]; None without cameras."""
    box_high: Triple | None
    box_origin: Literal["masks", "cameras"] | None
    """Whether the box is what all masks allow, or a guess by what all cameras see."""
    outermost: list[float] = []
    """Three numbers for each place that tells how far the object reaches in a turned world: boxes about them hold the hull of the masks. None where
    the box is a guess; that is as wide in all directions."""
    points: list[float]
    """Three numbers for each point on or about the object [world units]; 3000 points at most, none where nothing is known of them."""
    colors: list[float]
    """Three for each point, sRGB 0..1."""


class MasksRequest(_Body):
    strokes: StrokeList
    """At least one over the object and one over what is not."""


class CaptureMasks(_Body):
    """Masks of all pictures by strokes, to be looked at; a build that is told the same strokes finds them again."""

    version: str
    """Names the sheet: GET .../masks/{version}.jpg."""
    sheet: SheetLayout


class JobInfo(_Body):
    id: str
    kind: JobKind
    name: str
    preset: str
    """Empty where the kind has none."""
    priority: int
    """Lower runs first."""
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
    """What a build or a re-decoupling made; set when done."""
    capture_id: str | None
    """The capture that a `pose` made; set when done."""
    source_asset: str | None
    """What a job of another kind than `build` and `pose` works on."""
    clip: str | None
    """What a `pose` edit names to show a simulation; set when done."""
    error: str | None
    """A sentence, when failed."""
    capture: CaptureReport | None
    """What `drgs doctor` finds in the capture of a build; there soon after it began. Of a `pose`, which pictures found no place."""
    preview_version: int
    """Rises with each new preview picture; 0 while there is none. Use it to get round the browser's cache."""


class JobList(_Body):
    jobs: list[JobInfo]
    """Newest first."""
    total: int
    workers_alive: int


class JobFile(_Body):
    name: str
    bytes: int
    media_type: str


class JobFileList(_Body):
    files: list[JobFile]
    """By name; complete once the job is done."""


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
    version: int
    """1, or one more than the parent's."""
    parent_id: str | None
    """The version that this one was made of."""
    edits: list[Edit]
    """What was done to the parent."""
    deleted_at: datetime | None
    """Since when it can be brought back, for a while."""


class AssetList(_Body):
    assets: list[AssetInfo]
    """Newest first."""
    total: int


class TrainingViewList(_Body):
    views: list[TrainingView]
    """In the order of the asset's cameras; empty for an imported mesh."""
    has_photographs: bool
    """False for assets that were built before photographs were kept with them."""


class EnvironmentInfo(_Body):
    name: str
    """What an environment edit's `file` says."""
    title: str
    width: int
    height: int


class EnvironmentList(_Body):
    environments: list[EnvironmentInfo]


class SessionRequest(_Body):
    asset: Annotated[str, Field(max_length=64), PlainText]


class SessionInfo(_Body):
    id: str
    asset: str
    asset_name: str
    created_at: datetime
    revision: int
    edits: list[Edit]
    can_undo: bool
    can_redo: bool
    appended: int
    undone: list[Edit]
    """This, `appended` and `broken` as in EditLog."""
    broken: list[BrokenEdit]
    viewers: int


class SessionList(_Body):
    sessions: list[SessionInfo]


class EditRequest(_Body):
    edit: Edit


class EditsRequest(_Body):
    edits: list[Edit]
    revision: Annotated[int, Field(ge=0)] | None = None
    """Of the log that they are meant for: refused once there is a newer one. Absent: whatever is in force goes."""


class WeightsInfo(_Body):
    file: str
    """What a selection's `weights_file` says."""
    vertices: int


class SnapshotInfo(_Body):
    name: str
    created_at: datetime
    revision: int
    """Of the log when it was taken."""
    edits: list[Edit]


class SnapshotList(_Body):
    snapshots: list[SnapshotInfo]
    """Oldest first."""


class VariantRequest(_Body):
    edits: Annotated[list[MaterialEdit], Field(max_length=1000)] | None = None
    """Those in force when absent."""


class VariantNameRequest(_Body):
    name: UserName


class VariantList(_Body):
    variants: list[MaterialVariant]
    """In the order in which they came."""


class SaveRequest(_Body):
    name: UserName | None = None
    """Of the new version; the asset's name when absent."""


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
