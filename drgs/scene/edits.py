"""Edits as plain data: one schema for file, REST and WebSocket, applied in order, each undoable (design: Edits)."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

LARGEST = 1e9
"""Of coordinates, lengths and factors: float32 holds their squares and products."""
SMALLEST = 1e-12
"""Of what is divided by."""
MAX_INTENSITY = 1e6
MAX_SECONDS = 1e6
LONGEST_VARIANT_NAME = 100
AS_CAPTURED, AS_SHOWN = "As captured", "As shown"
"""What files call the asset without any of its variants: as it is, or with material edits."""

Unit = Annotated[float, Field(ge=0.0, le=1.0)]
Coordinate = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]
Length = Annotated[float, Field(ge=SMALLEST, le=LARGEST)]
Distance = Annotated[float, Field(ge=0.0, le=LARGEST)]
"""A length that may be zero."""
Seconds = Annotated[float, Field(ge=0.0, le=MAX_SECONDS)]
Index = Annotated[int, Field(ge=0, le=2**31 - 1)]
Triple = tuple[Coordinate, Coordinate, Coordinate]


class _Plain(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, frozen=True)


class Sphere(_Plain):
    center: Triple
    """World units."""
    radius: Length
    falloff: Distance = 0.0
    """Width of the smooth rim outside the radius [world units]."""


class Box(_Plain):
    minimum: Triple
    maximum: Triple
    falloff: Distance = 0.0


class Similar(_Plain):
    point: Triple
    """World position picked on the surface; the flood starts at its nearest vertex."""
    tolerance: Annotated[float, Field(ge=SMALLEST, le=1)] = 0.1
    """Largest material difference (Euclidean over albedo, roughness, metallic) that the flood crosses."""


class Selection(_Plain):
    """Exactly one field is set."""

    all: bool | None = None
    sphere: Sphere | None = None
    box: Box | None = None
    region: Index | None = None
    similar: Similar | None = None
    vertex_weights: list[Unit] | None = None
    """Painted weight of each mesh vertex."""
    weights_file: Annotated[str, Field(max_length=400)] | None = None
    """The same as a file: a little-endian float32 for each vertex."""

    @model_validator(mode="after")
    def _exactly_one(self) -> "Selection":
        given = [name for name in type(self).model_fields if (value := getattr(self, name)) is not None and value is not False]
        if len(given) != 1:
            raise ValueError(
                f"a selection names exactly one of all, sphere, box, region, similar, vertex_weights, weights_file; found {given or 'none'}"
            )
        return self


class MaterialValues(_Plain):
    """Absolute: the new values, 0..1. Multiply: factors."""

    albedo: tuple[float, float, float] | None = None
    """Linear."""
    roughness: float | None = None
    metallic: float | None = None


class MaterialEdit(_Plain):
    op: Literal["material"]
    select: Selection
    set: MaterialValues
    mode: Literal["absolute", "multiply"] = "absolute"

    @model_validator(mode="after")
    def _in_range(self) -> "MaterialEdit":
        values = [*(self.set.albedo or ()), *(v for v in (self.set.roughness, self.set.metallic) if v is not None)]
        if not values:
            raise ValueError("a material edit sets at least one of albedo, roughness, metallic; found none")
        upper = 1.0 if self.mode == "absolute" else 100.0
        if any(not 0.0 <= v <= upper for v in values):
            raise ValueError(f"material values in mode {self.mode!r} lie in 0..{upper:g}; found {values}")
        return self


class EnvironmentEdit(_Plain):
    op: Literal["environment"]
    file: str | None = None
    """EXR or HDR file (or the name of a stored environment); None keeps the present one."""
    rotation: Coordinate = 0.0
    """Degrees, counter-clockwise seen from above."""
    intensity: Annotated[float, Field(ge=0, le=MAX_INTENSITY)] = 1.0


class TwistMap(_Plain):
    type: Literal["twist"]
    rate: Coordinate
    """Radians per world unit of z."""


class BendMap(_Plain):
    type: Literal["bend"]
    curvature: Coordinate
    """1 / world unit."""


class StretchMap(_Plain):
    type: Literal["stretch"]
    factor: Annotated[float, Field(gt=0)]


class LatticeMap(_Plain):
    type: Literal["lattice"]
    minimum: Triple
    maximum: Triple
    control_points: list[list[list[Triple]]]
    """`control_points[i][j][k]`: where the point is moved to; i counts along x, j along y, k along z."""


AnalyticMap = Annotated[TwistMap | BendMap | StretchMap | LatticeMap, Field(discriminator="type")]


class Grip(_Plain):
    """A part of the surface that is held: some vertices by number, or those around a picked point."""

    vertices: Annotated[list[Index], Field(min_length=1, max_length=200_000)] | None = None
    point: Triple | None = None
    """World position on the object at rest."""
    radius: Distance = 0.0
    """Around the point [world units]; its nearest vertex is held in any case."""

    @model_validator(mode="after")
    def _exactly_one(self) -> "Grip":
        if (self.vertices is None) == (self.point is None):
            raise ValueError("a grip has either vertices or point; found both or neither")
        return self


class Handle(Grip):
    """A grip that is dragged: it moves as a rigid piece."""

    target: Triple
    """Where the picked point goes, or the middle of the vertices [world units]."""
    turn: Triple = (0.0, 0.0, 0.0)
    """Rotation vector of the piece about that point [degrees]."""


class Handles(_Plain):
    """What is dragged and what is held in place; the rest follows as rigidly as it can. Parts without a grip stay."""

    drag: Annotated[list[Handle], Field(max_length=64)] = []
    pin: Annotated[list[Grip], Field(max_length=64)] = []
    """Alone, without anything dragged, they change nothing."""

    @model_validator(mode="after")
    def _holds_something(self) -> "Handles":
        if not self.drag and not self.pin:
            raise ValueError("handles drag or pin at least one part; found neither")
        return self


class DeformEdit(_Plain):
    """Exactly one of map, vertices, handles."""

    op: Literal["deform"]
    map: AnalyticMap | None = None
    vertices: str | None = None
    """The mesh's new vertex positions: NPZ with `vertices` (vertex, 3) or (frame, vertex, 3), an OBJ or PLY, or a folder of those."""
    time: Seconds = 0.0
    """Seconds into a sequence of `vertices`; frames are blended linearly, the last one holds."""
    frames_per_second: Annotated[float, Field(ge=1e-3, le=1e4)] = 24.0

    handles: Handles | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> "DeformEdit":
        given = [name for name in ("map", "vertices", "handles") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a deform edit has exactly one of map, vertices, handles; found {given or 'none'}")
        return self


class RigBinding(_Plain):
    """How a glTF rig, turned to z up and world units, is laid over the object at rest, and how the object follows it."""

    turn: Triple = (0.0, 0.0, 0.0)
    """Rotation vector about the origin [degrees]; first of all."""
    fit: bool = False
    """Then scale and move the rig until its box has the diagonal and the centre of the object's."""
    scale: Length = 1.0
    """Then scale, about the fitted centre, or the origin without `fit`."""
    translation: Triple = (0.0, 0.0, 0.0)
    """Then move [world units]."""
    method: Literal["auto", "closest", "mls"] = "auto"
    """closest: with the closest triangle that faces alike. mls: moving least squares over patches as wide as the rig is away; smoother, blind
    to narrow gaps. auto: closest where the rig hugs the object, mls where it stands off."""
    rest: Seconds | None = None
    """Seconds into the animation where the rig stands as the object does at rest; None: where the file's nodes stand."""
    loop: bool = False
    """Start again after the animation's end; else its last pose holds."""


class PoseEdit(_Plain):
    op: Literal["pose"]
    clip: str
    """A clip folder, or a glTF or FBX file and one of its animations: robot.glb#Walk."""
    time: Seconds

    rig: RigBinding | None = None
    """For glTF and FBX files only."""

    @model_validator(mode="after")
    def _rig_has_a_file(self) -> "PoseEdit":
        if self.rig is not None and split_rig_clip(self.clip) is None:
            raise ValueError(f"a pose edit has rig for a .glb, .gltf or .fbx file only; its clip is {self.clip!r}")
        return self


def split_rig_clip(clip: str) -> tuple[str, str] | None:
    """File and animation ("" if none is named) of a glTF or FBX clip; None for a clip folder."""
    found = re.fullmatch(r"(.+?\.(?:glb|gltf|fbx))(?:#(.*))?", clip, re.IGNORECASE | re.DOTALL)
    return None if found is None else (found[1], found[2] or "")


class SimulateEdit(_Plain):
    op: Literal["simulate"]
    scene: dict
    time: Seconds


class MatterEdit(_Plain):
    """What simulations of the object begin with, for the viewers of a session. It moves nothing by itself."""

    op: Literal["matter"]
    scene: dict
    """As of a simulate edit."""


class MaterialVariant(_Plain):
    """What the object may be made of, by a name."""

    name: Annotated[str, Field(min_length=1, max_length=LONGEST_VARIANT_NAME)]
    edits: Annotated[list[MaterialEdit], Field(max_length=1000)]
    """They apply to the asset as it is, in the place of other material edits."""

    @model_validator(mode="after")
    def _has_a_name(self) -> "MaterialVariant":
        if self.name != self.name.strip() or not self.name.isprintable() or "/" in self.name or self.name in (AS_CAPTURED, AS_SHOWN):
            raise ValueError(
                f"a variant is called {self.name!r}; expected one line without slashes or blanks at its ends, other than {AS_CAPTURED!r} and {AS_SHOWN!r}"
            )
        return self


class VariantEdit(MaterialVariant):
    """Keeps a variant with the session. It changes nothing by itself; of two with one name the later counts."""

    op: Literal["variant"]


class UnreadableEdit(_Plain):
    """Stands where an edit was kept that this version does not read, so that those around it keep their places. It never applies."""

    op: Literal["unreadable"]
    found: str
    """What was kept, as JSON."""


Edit = Annotated[
    MaterialEdit | EnvironmentEdit | DeformEdit | PoseEdit | SimulateEdit | MatterEdit | VariantEdit | UnreadableEdit,
    Field(discriminator="op"),
]
_edits = TypeAdapter(list[Edit])


def parse_edits(data: list | str | bytes) -> list[Edit]:
    """Validate JSON text or plain data.

    Raises:
        ValueError: one sentence naming the first wrong field.
    """
    try:
        return _edits.validate_json(data) if isinstance(data, str | bytes) else _edits.validate_python(data)
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"edits: {'.'.join(map(str, first['loc'])) or 'document'}: {first['msg']}") from error


def parse_kept_edits(kept: object) -> list[Edit]:
    """Edits of a log that was written before, perhaps by another version: each that cannot be read is an UnreadableEdit, and none is lost."""
    return [_kept_edit(value) for value in kept] if isinstance(kept, list) else [_unreadable(kept)]


def _kept_edit(value: object) -> Edit:
    try:
        return _edits.validate_python([value])[0]
    except ValidationError:
        return _unreadable(value)


def _unreadable(value: object) -> UnreadableEdit:
    return UnreadableEdit(op="unreadable", found=json.dumps(value))


def plain_edit(edit: Edit) -> dict:
    """An edit as parse_edits reads it, without what it leaves out."""
    return edit.model_dump(mode="json", exclude_none=True)


def shared_beginning(one: Sequence[Edit], other: Sequence[Edit]) -> int:
    """How many of the first edits are the same. Comparing the same objects takes microseconds for thousands, so it looks from the end, where lists
    of one session mostly part."""
    one, other = tuple(one), tuple(other)
    most = min(len(one), len(other))
    if _begin_alike(one, other, most):
        return most
    step = 1
    while step < most and not _begin_alike(one, other, most - step):
        step *= 2
    alike, parted = max(most - step, 0), most - step // 2
    while parted - alike > 1:
        middle = (alike + parted) // 2
        alike, parted = (middle, parted) if _begin_alike(one, other, middle) else (alike, middle)
    return alike


def _begin_alike(one: tuple[Edit, ...], other: tuple[Edit, ...], count: int) -> bool:
    return one[:count] == other[:count]


def load_edits(path: Path) -> list[Edit]:
    """Read an edits file: a JSON list, or one edit alone.

    Raises:
        ValueError: one sentence naming the file and the first wrong field.
    """
    text = path.read_text().strip()
    try:
        return parse_edits(text if text.startswith("[") else f"[{text}]")
    except ValueError as error:
        raise ValueError(f"{path}: {error} (edits are counted from 0; docs/protocol.md says what each of them holds)") from error
