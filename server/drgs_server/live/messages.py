"""What passes over WebSocket /api/sessions/{id}/stream: JSON text both ways. Pictures go to the client as
binary frames (frame_header.py).

`generate_types.py` writes web/src/session/protocol.gen.ts from these models, and docs/protocol.md explains them in prose.
Source of the ack window and the lossless last frame: jupyter_rfb.
"""

from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, model_validator

from drgs.scene.edits import Edit
from drgs.scene.tone_curve import ToneCurve
from drgs_worker.jobs.requests import MAX_PICTURE_SAMPLES, Matrix, check_rigid
from drgs_worker.store.user_names import PlainText

PROTOCOL_VERSION = 1
"""A client of another version is told so and closed with 1002."""

MAX_FRAMES_IN_FLIGHT = 2
"""Frames sent but not yet acknowledged, a viewer."""

CLOSE_VERSION_MISMATCH = 1002
CLOSE_POLICY = 1008
CLOSE_TRY_AGAIN = 1013

MAX_SIDE = 4096
"""Largest width or height that a viewer may ask for [pixels]."""
MAX_PIXELS = 4_194_304
MAX_STILL_PIXELS = 4096 * 2160
"""Of one picture over REST, which is rendered once: what its sums fill of the memory is the limit."""
MAX_LAYERED_PIXELS = MAX_STILL_PIXELS // 4
"""Of one with all channels, whose pixels take four times the memory."""
MAX_STILL_SAMPLES = MAX_PICTURE_SAMPLES
MAX_SPP_TARGET = 65535
"""The header holds 16 bits."""

Channel = Literal[
    "final", "albedo", "roughness", "metallic", "normal", "depth", "visibility", "indirect", "variance", "surfels", "certainty"
]
"""visibility: open share of the cosine-weighted sky. indirect: light that met another surface. variance: standard error of the pixels'
luminance, in colours from LEAST_SHOWN_ERROR to 1 (white). surfels: the Gaussians themselves.
certainty: how far the photographs decide what a place is, red for its shape, green for its albedo, blue for roughness and metallic."""
LEAST_SHOWN_ERROR = 1e-3
NO_CERTAINTY = "this asset does not say what is certain: it was imported, or built by an older version or with materials on surfels"
Phase = Literal["loading", "moving", "still", "converged", "paused"]
Finite = Annotated[float, Field(allow_inf_nan=False)]
Row = tuple[Finite, Finite, Finite, Finite]
Vector = tuple[Finite, Finite, Finite]
Number = Annotated[int, Field(ge=0, le=2**32 - 1)]
ClientKey = Annotated[str, Field(min_length=1, max_length=64), PlainText]


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class _Answer(_Message):
    model_config = ConfigDict(json_schema_serialization_defaults_required=True)


# ---- client to server ------------------------------------------------------------------------------------------------


class ClientHello(_Message):
    """First message of a client; nothing else is answered before it."""

    type: Literal["hello"]
    v: int
    """PROTOCOL_VERSION of the client."""
    codecs: list[Literal["jpeg", "png"]] = ["jpeg", "png"]
    """What the client can decode. With png, the converged frame is lossless (and keeps alpha)."""
    changes: bool = False
    """Be told of changes of the edit log (`change`), not of the whole log each time (`state`): a long log is then sent once."""
    client: Annotated[str, Field(max_length=100)] = ""
    """Name of the program, for logs."""


class CameraMessage(_Message):
    """Where this viewer looks from. Latest wins: a newer one replaces one that was not rendered yet."""

    type: Literal["camera"]
    number: Number = 0
    """Chosen by the client; a frame carries the low 8 bits of the number of the camera that it shows. A new number is answered by a frame
    even where nothing else is new: sent behind `settings`, it marks the frames that show them."""
    world_from_camera: Matrix
    """OpenGL camera-to-world, rows: the camera looks down -z, y up. World is right-handed, z up."""
    fov_y_degrees: Annotated[float, Field(gt=0.1, lt=175)]
    width: Annotated[int, Field(ge=16, le=MAX_SIDE)]
    """Pixels of the picture at rest; while moving the server may send fewer."""
    height: Annotated[int, Field(ge=16, le=MAX_SIDE)]

    @model_validator(mode="after")
    def _is_a_rigid_camera(self) -> "CameraMessage":
        if self.width * self.height > MAX_PIXELS:
            raise ValueError(f"a picture has at most {MAX_PIXELS} pixels; found {self.width} x {self.height}")
        check_rigid(self.world_from_camera)
        return self

    def sees_as(self, other: "CameraMessage") -> bool:
        """Whether both see the same, whatever their numbers."""
        return self == other.model_copy(update={"number": self.number})


class EditMessage(_Message):
    """Append an edit to the session's log. Applied in order, never dropped, answered by `accepted` or `rejected`."""

    type: Literal["edit"]
    id: Number
    """Chosen by the client; the answer repeats it."""
    edit: Edit
    coalesce: Annotated[str, Field(max_length=100)] | None = None
    """Edits of one gesture, like the drag of a slider, share a key that no other has: an edit whose key is that of the newest change replaces
    it. When a gesture ends is the client's to say: it sees the hand, and how late messages arrive tells nothing."""
    key: ClientKey | None = None
    """Unique in the session, and the same when the client sends this edit again because it lost the connection before the answer: it is
    then answered as before and not applied twice."""


class UndoMessage(_Message):
    type: Literal["undo"]
    id: Number
    key: ClientKey | None = None
    """As of an edit."""


class RedoMessage(_Message):
    type: Literal["redo"]
    id: Number
    key: ClientKey | None = None
    """As of an edit."""


class SpliceMessage(_Message):
    """Put edits in the place of some of those in force, as one step of undo."""

    type: Literal["splice"]
    id: Number
    revision: Number
    """Of the log that `start` and `remove` count in; once there is a newer one the answer is `rejected` with `overtaken`."""
    start: Number
    """How many edits stay in front."""
    remove: Number
    """How many behind them go."""
    edits: list[Edit]
    """What comes in their place."""
    coalesce: Annotated[str, Field(max_length=100)] | None = None
    """As of an edit: a splice with the key of the one just before it is the same step of undo."""
    key: ClientKey | None = None
    """As of an edit."""


class AckMessage(_Message):
    """This frame, and every one before it, has been shown or dropped."""

    type: Literal["ack"]
    frame_id: Number


class Settings(_Message):
    """How this viewer sees the session; each viewer has its own."""

    exposure_stops: Annotated[float, Field(ge=-10, le=10)] = 0.0
    tone_curve: ToneCurve = "standard"
    """From exposed light to the screen: standard clips, filmic and agx roll highlights off, neutral keeps base colours."""
    background: Literal["environment", "blurred", "transparent"] | Vector = "environment"
    """blurred: the environment out of focus, its light as sharp as ever. A triple is a colour, sRGB 0..1. Transparent arrives as PNG with alpha once converged and over grey while JPEG."""
    spp_target: Annotated[int, Field(ge=1, le=MAX_SPP_TARGET)] = 256
    """Rays a pixel at which the picture counts as converged."""
    bounces: Annotated[int, Field(ge=0, le=8)] = 1
    """Indirect bounces; 0 is direct light with shadows only."""
    channel: Channel = "final"
    denoise: bool = True
    """Filter what is left of the noise; the filter follows the measured variance, so it fades as samples add up."""
    turn_light: bool = False
    """The asset's own light turns with this viewer's camera, where it stood still with the camera of the photographs (light_camera of hello). Any other
    light stands still with the object."""


class SettingsMessage(_Message):
    type: Literal["settings"]
    settings: Settings


class VisibilityMessage(_Message):
    """A hidden page gets no frames."""

    type: Literal["visibility"]
    visible: bool


class PickMessage(_Message):
    """What lies under a pixel of the newest frame."""

    type: Literal["pick"]
    id: Number
    x: Annotated[float, Field(ge=0, le=1)]
    """Share of the width from the left."""
    y: Annotated[float, Field(ge=0, le=1)]
    """Share of the height from the top."""


class ExplainMessage(_Message):
    """What the newest picture cost, and what was left out of it, and why."""

    type: Literal["explain"]
    id: Number


class LogMessage(_Message):
    """Send the whole edit log: this client has noticed that its own is not the one that a change was made to. Answered by `state`."""

    type: Literal["log"]


class CancelMessage(_Message):
    """Give up the change of this session that is being computed, such as a long simulation: it is answered by `rejected`. Nothing is done where
    there is none."""

    type: Literal["cancel"]


ClientMessage = Annotated[
    ClientHello
    | CameraMessage
    | EditMessage
    | SpliceMessage
    | UndoMessage
    | RedoMessage
    | AckMessage
    | SettingsMessage
    | VisibilityMessage
    | PickMessage
    | ExplainMessage
    | LogMessage
    | CancelMessage,
    Field(discriminator="type"),
]
client_message = TypeAdapter(ClientMessage)


# ---- server to client ------------------------------------------------------------------------------------------------


class StartView(_Answer):
    """A camera that shows the whole object, for the first picture."""

    world_from_camera: tuple[Row, Row, Row, Row]
    fov_y_degrees: float


class BrokenEdit(_Answer):
    """An edit that applies no longer, for example since its file is gone: it is skipped, and taken out like any other."""

    index: Number
    """Its place in `edits`, from 0."""
    reason: str
    """A sentence."""


class EditLog(_Answer):
    """The session's edits. The same document answers REST calls."""

    revision: Number
    """Rises by one with every change; never falls."""
    edits: list[Edit]
    """Those in force, in order."""
    can_undo: bool
    can_redo: bool
    appended: Number
    """How many of the edits, counted from the last, undo takes away one by one; what lies behind them goes in one step."""
    undone: list[Edit]
    """Those that redo brings back one by one, the next one first; empty when the next redo does more than append one."""
    digest: Annotated[str, Field(json_schema_extra={"x-optional": True})] = ""
    """Of all that led to this log: two logs with the same digest are the same."""
    broken: Annotated[list[BrokenEdit], Field(json_schema_extra={"x-optional": True})] = []
    """Those of `edits` that were skipped when the object was last posed; none before its asset was first loaded."""


class ServerHello(_Answer):
    """Answer to `hello`, sent once the asset is loaded."""

    type: Literal["hello"] = "hello"
    v: int = PROTOCOL_VERSION
    server: str
    """Version of drgs."""
    session: str
    asset: str
    minimum: Vector
    """Bounds of the object at rest [world units]."""
    maximum: Vector
    start_view: StartView
    light_camera: Annotated[tuple[Vector, Vector, Vector] | None, Field(json_schema_extra={"x-optional": True})] = None
    """Rows of the rotation of the first photograph's camera (world from camera, OpenGL), where the asset's own light stood still with the
    camera of the photographs, as on a turntable: its table is as that camera saw it. null: it stands still with the object."""
    log: EditLog
    settings: Settings
    """Those in force until the client sends its own."""
    max_in_flight: int = MAX_FRAMES_IN_FLIGHT


class StateMessage(_Answer):
    """The whole edit log: sent to viewers that did not ask for `changes`, after a change of it, and to others when they ask, or where
    they were too slow for changes. One that is overtaken before it was sent is left out."""

    type: Literal["state"] = "state"
    log: EditLog


class ListChange(_Answer):
    """Of a list of edits: behind the first `start`, `edits` take the place of `remove`."""

    start: Number
    remove: Number
    edits: list[Edit]


class LogChangeMessage(_Answer):
    """Sent to every viewer that asked for `changes`, after each change of the session's edit log."""

    type: Literal["change"] = "change"
    before: str
    """Digest of the log that is changed; who holds another one has missed something, and asks for the whole (`log`)."""
    digest: str
    """Of the log that it makes; the rest as in EditLog."""
    revision: Number
    edits: ListChange
    undone: ListChange
    can_undo: bool
    can_redo: bool
    appended: Number
    broken: Annotated[list[BrokenEdit], Field(json_schema_extra={"x-optional": True})] = []
    """All of the log that it makes."""


class AcceptedMessage(_Answer):
    type: Literal["accepted"] = "accepted"
    id: Number
    revision: Number
    """Of the log with this edit in it; the edit is on disk."""


class RejectedMessage(_Answer):
    type: Literal["rejected"] = "rejected"
    id: Number
    reason: str
    overtaken: bool = False
    """The log was changed by somebody else meanwhile: count anew and send again."""


class StatusMessage(_Answer):
    """For the corner of the picture; sent when the phase changes and with each frame, at most 5 a second."""

    type: Literal["status"] = "status"
    phase: Phase
    width: int
    """Of the pictures sent now."""
    height: int
    scale: float
    """Share of the asked-for width; 1 unless moving."""
    spp: int
    spp_target: int
    frames_per_second: float
    render_ms: float
    notes: list[str] = []
    """What was skipped or reduced, and why."""


class PickedMessage(_Answer):
    type: Literal["picked"] = "picked"
    id: Number
    hit: bool
    position: Vector | None = None
    """World units."""
    normal: Vector | None = None
    albedo: Vector | None = None
    roughness: float | None = None
    metallic: float | None = None
    region: Annotated[int | None, Field(json_schema_extra={"x-optional": True})] = None
    """What a selection's `region` says for the patch of material here."""
    rest: Annotated[Vector | None, Field(json_schema_extra={"x-optional": True})] = None
    """The mesh's nearest vertex, where it is on the object at rest [world units]: what selections and grips refer to."""


class SkippedWork(_Answer):
    what: str
    why: str
    bound: str
    """Of the difference it makes."""


class ExplainedMessage(_Answer):
    type: Literal["explained"] = "explained"
    id: Number
    revision: Number | None
    """Of the log that the picture shows; None while there is no picture, and then nothing else says anything."""
    samples: int
    samples_target: int
    seconds: dict[str, float]
    """Spent on each step of the picture."""
    skipped: list[SkippedWork]
    frames_sent: int
    frames_in_flight: int
    round_trip_ms: float | None
    """From a frame's sending to its acknowledgement, mean of the last ones."""


class ErrorMessage(_Answer):
    """Something the client did, or the server could not do. The connection lives on unless `fatal`."""

    type: Literal["error"] = "error"
    message: str
    fatal: bool = False


ServerMessage = Annotated[
    ServerHello
    | StateMessage
    | LogChangeMessage
    | AcceptedMessage
    | RejectedMessage
    | StatusMessage
    | PickedMessage
    | ExplainedMessage
    | ErrorMessage,
    Field(discriminator="type"),
]
server_message = TypeAdapter(ServerMessage)
