"""What can be asked of a worker, as plain data with bounds: the bodies of POST /api/jobs, and what a job keeps of them.

Scenes of simulations are checked by the deform package where a job is made (`check_simulation`), since that imports torch.
"""

import math
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from drgs.exchange.export_formats import FEWEST_FACES, FILE_KINDS, MOST_FACES, VARIANT_FORMATS, DownloadFormat, refuse_faces
from drgs.maths.constants import STILL_BOUNCES
from drgs.scene.edits import Coordinate, Edit, MaterialVariant, Triple
from drgs.scene.strokes import StrokeList
from drgs.scene.tone_curve import ToneCurve
from drgs.scene.variants import MOST_VARIANTS
from drgs_worker.store.user_names import PlainText, UserName

JobKind = Literal["build", "pose", "redecouple", "simulate", "render", "export"]
PresetName = Literal["draft", "fast", "full"]
BindingName = Literal["particles", "mesh"]
LightName = Literal["auto", "object", "camera"]
MaskName = Literal["auto", "given"]
CameraName = Literal["auto", "given"]

NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.]{0,59}$"
"""Of pictures and variants: they become parts of file names, joined by `-`."""
MAX_PICTURES = 20_000
FILM_FPS = 24
"""Of moving pictures, where a request does not say."""
MAX_PICTURE_SAMPLES = 4096 * 4096 * 64
"""Pixels times samples of one picture."""
SHORTEST_UP = 1e-6
"""Of a direction that says something."""
OWN_LIGHT = "own"
"""Names the environment that was recovered with the asset."""

Name = Annotated[str, Field(pattern=NAME_PATTERN)]
Row = tuple[Coordinate, Coordinate, Coordinate, Coordinate]
Matrix = tuple[Row, Row, Row, Row]
EnvironmentName = Annotated[str, Field(pattern=r"^(own|[A-Za-z0-9][A-Za-z0-9_-]{0,79}\.exr)$")]


def check_rigid(world_from_camera: Matrix) -> None:
    """
    Raises:
        ValueError: the matrix is no rotation and translation: it scales, shears, mirrors or projects.
    """
    rows = [row[:3] for row in world_from_camera[:3]]
    for i in range(3):
        for j in range(3):
            if not abs(sum(rows[i][k] * rows[j][k] for k in range(3)) - (i == j)) <= 1e-2:
                raise ValueError("world_from_camera must be a rotation and a translation; its upper left 3x3 is not orthonormal")
    (a, b, c), (d, e, f), (g, h, k) = rows
    if a * (e * k - f * h) - b * (d * k - f * g) + c * (d * h - e * g) < 0:
        raise ValueError("world_from_camera must be a rotation and a translation; it mirrors")
    if any(abs(found - wanted) > 1e-4 for found, wanted in zip(world_from_camera[3], (0, 0, 0, 1), strict=True)):
        raise ValueError(f"the last row of world_from_camera must be 0 0 0 1; found {world_from_camera[3]}")


class _Request(BaseModel):
    model_config = ConfigDict(extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class JobLimits(_Request):
    """A job that goes beyond ends as failed, its checkpoint kept."""

    seconds: Annotated[float, Field(gt=0, le=30 * 86400)] | None = None
    """Of work since it was last started; waiting does not count."""
    memory_bytes: Annotated[int, Field(ge=1 << 28)] | None = None
    """Resident, of the worker's process."""


class _Job(_Request):
    name: UserName | None = None
    """Shown in lists."""
    priority: Annotated[int, Field(ge=1, le=1000)] = 100
    """Lower runs first; jobs of one priority run in the order in which they came."""
    limits: JobLimits = JobLimits()


class BoxCorners(_Request):
    """A box with sides along the axes, by two opposite corners [world units]."""

    low: Triple
    high: Triple

    @model_validator(mode="after")
    def _spans_a_box(self) -> "BoxCorners":
        if not all(low < high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError(f"box: expected each number of low below that of high; found {self.low} and {self.high}")
        return self


class BuildRequest(_Job):
    """A build of a capture that the server can already see. A zip may be uploaded as multipart instead, with the same fields."""

    kind: Literal["build"] = "build"
    dataset: Annotated[str, Field(max_length=1000), PlainText]
    """`capture:ID` for an uploaded one (POST /api/captures), `sample` for the bundled one, or a folder below a root that was allowed when the
    server started."""
    preset: PresetName = "fast"
    binding: BindingName = "particles"
    """particles: surfels lie where they were fitted. mesh: they are rebuilt on the faces of the mesh, one a face."""
    light: LightName = "auto"
    """What the lamps stood still with: the object, or (on a turntable) the camera; auto: asked of the pictures."""
    masks: MaskName = "auto"
    """Where masks end: where the photographs show the object to end, if that is elsewhere (auto), or as given."""
    cameras: CameraName = "auto"
    """Where photographs were taken from: where they fit the surface best, if that is elsewhere (auto), or as given."""
    up: Triple = (0.0, 0.0, 1.0)
    """Direction of the capture's world that points up; the asset's world is turned so that it is z. Not of multipart bodies."""
    box: BoxCorners | None = None
    """Of the asset's world, which is the capture's turned by `up`: what lies outside is not built. Absent: all of the object is. Not of multipart
    bodies."""
    strokes: StrokeList | None = None
    """Over some of the capture's pictures: what is the object, and what is not. The masks of all pictures follow from them, whatever masks the capture has.
    Not of multipart bodies."""
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0

    @model_validator(mode="after")
    def _up_is_a_direction(self) -> "BuildRequest":
        if math.hypot(*self.up) < SHORTEST_UP:
            raise ValueError(f"up: expected a direction, three numbers that are not all 0; found {self.up}")
        return self


class PoseRequest(_Job):
    """Find where plain photographs, or the frames of a film, were taken from: a new capture, with the job's id, of those that found their place."""

    kind: Literal["pose"]
    dataset: Annotated[str, Field(max_length=1000), PlainText]
    """As of a build."""
    seed: Annotated[int, Field(ge=0, le=2**31 - 1)] = 0


class RedecoupleRequest(_Job):
    """Separate material and light of a built asset again, on its geometry, with the effort of another preset: a new asset."""

    kind: Literal["redecouple"]
    asset: Annotated[str, Field(max_length=64), PlainText]
    preset: PresetName = "full"


class SimulateRequest(_Job):
    """Move an asset's matter; the clip is played by `pose` edits that name it, and by batch renders."""

    kind: Literal["simulate"]
    asset: Annotated[str, Field(max_length=64), PlainText]
    scene: dict = Field(default_factory=dict)
    """As in `drgs simulate --scene`; empty: a jelly under its own weight."""


class Turntable(_Request):
    """Cameras round the object, all of it in sight."""

    frames: Annotated[int, Field(ge=1, le=1000)] = 72
    elevation_degrees: Annotated[float, Field(ge=-85, le=85)] = 20.0
    turns: Annotated[float, Field(ge=-10, le=10)] = 1.0


class RenderCamera(_Request):
    name: Name
    """Of the picture."""
    world_from_camera: Matrix
    """OpenGL camera-to-world, rows."""
    fov_y_degrees: Annotated[float, Field(gt=0.1, lt=175)] = 40.0

    @model_validator(mode="after")
    def _is_a_rigid_camera(self) -> "RenderCamera":
        check_rigid(self.world_from_camera)
        return self


class CameraKeyframe(_Request):
    """A view that a film passes through, with z up."""

    eye: Triple
    target: Triple
    """Straight ahead: what the camera goes round on its way to the next view [world units]."""
    fov_y_degrees: Annotated[float, Field(gt=0.1, lt=175)] = 40.0
    seconds: Annotated[float, Field(ge=0.05, le=600)] = 2.0
    """From the view before to this one; that of the first counts on a closed path alone, from the last."""

    @model_validator(mode="after")
    def _looks_somewhere(self) -> "CameraKeyframe":
        if math.dist(self.eye, self.target) < 1e-9:
            raise ValueError("eye and target of a keyframe are the same point")
        return self


class CameraPath(_Request):
    """A film: the camera passes these views, smoothly in time and around what it looks at."""

    keyframes: Annotated[list[CameraKeyframe], Field(min_length=2, max_length=200)]
    closed: bool = False
    """Go on from the last view to the first without resting there, so that the film can be shown over and over."""


def path_frames(path: CameraPath, fps: float) -> int:
    """Pictures of a film, both ends among them; on a closed path the first view is not shown again."""
    seconds = sum(keyframe.seconds for keyframe in path.keyframes[0 if path.closed else 1 :])
    return math.ceil(seconds * fps - 1e-6) if path.closed else math.floor(seconds * fps + 1e-6) + 1


class RenderVariant(_Request):
    """The asset under some edits; environment edits in it are kept where the request's environments do not replace them."""

    name: Name
    edits: list[Edit] = Field(default_factory=list, max_length=1000)


class RenderRequest(_Job):
    """Pictures of every variant under every environment from every camera, named variant-environment-camera.png."""

    kind: Literal["render"]
    asset: Annotated[str, Field(max_length=64), PlainText]
    cameras: list[RenderCamera] = Field(default_factory=list, max_length=1000)
    turntable: Turntable | None = None
    """Instead of cameras; with neither, one picture from the start view."""
    path: CameraPath | None = None
    """Instead of cameras: a picture every 1 / video_fps (or 1 / 24) seconds."""
    environments: list[EnvironmentName] = Field(default_factory=list, max_length=200)
    """Stored environments, `own` for the asset's; none: the light that the variants' edits say."""
    variants: list[RenderVariant] = Field(default_factory=list, max_length=200)
    """None: the asset as it is."""
    clip: Annotated[str, Field(pattern=r"^clips/[0-9a-f]{32}$")] | None = None
    """Of a simulate job: camera k shows its moment k / video_fps (or / 24)."""
    width: Annotated[int, Field(ge=16, le=4096)] = 800
    height: Annotated[int, Field(ge=16, le=4096)] = 600
    spp: Annotated[int, Field(ge=1, le=65535)] = 256
    bounces: Annotated[int, Field(ge=0, le=8)] = STILL_BOUNCES
    exposure_stops: Annotated[float, Field(ge=-10, le=10)] = 0.0
    denoise: bool = True
    tone_curve: ToneCurve = "standard"
    background: Literal["environment", "blurred", "transparent"] = "environment"
    video_fps: Annotated[int, Field(ge=1, le=120)] | None = None
    """Also join the pictures of each variant and environment, in the order of the cameras, to an MP4 (H.264)."""

    @model_validator(mode="after")
    def _is_bounded_and_clear(self) -> "RenderRequest":
        found = [what for what in ("cameras", "turntable", "path") if getattr(self, what)]
        if len(found) > 1:
            raise ValueError(f"a render has cameras, a turntable or a path; found {' and '.join(found)}")
        for what, names in (
            ("cameras", [camera.name for camera in self.cameras]),
            ("variants", [variant.name for variant in self.variants]),
            ("environments", self.environments),
        ):
            # Case is folded: on some disks two such names are one file.
            if len({name.casefold() for name in names}) < len(names):
                raise ValueError(f"two {what} of this render have the same name")
        cameras = self.turntable.frames if self.turntable else max(len(self.cameras), 1)
        if self.path:
            cameras = path_frames(self.path, self.video_fps or FILM_FPS)
        pictures = cameras * max(len(self.environments), 1) * max(len(self.variants), 1)
        if pictures > MAX_PICTURES:
            raise ValueError(f"a render makes at most {MAX_PICTURES} pictures; this one {pictures}")
        if self.width * self.height * self.spp > MAX_PICTURE_SAMPLES:
            raise ValueError(f"a picture costs at most {MAX_PICTURE_SAMPLES} samples in all; ask for fewer pixels or a smaller spp")
        return self


class ExportRequest(_Job):
    """Files for other programs, kept with the job until it is deleted."""

    kind: Literal["export"]
    asset: Annotated[str, Field(max_length=64), PlainText]
    formats: Annotated[list[DownloadFormat], Field(min_length=1, max_length=len(FILE_KINDS))]
    faces: Annotated[int, Field(ge=FEWEST_FACES, le=MOST_FACES)] | None = None
    """The most that textured meshes (glb, mesh, usdz, usd) have; 30 000 where nothing is said."""
    variants: list[MaterialVariant] = Field(default_factory=list, max_length=MOST_VARIANTS)
    """Other materials, for the formats that hold some (glb, mesh, html)."""

    @model_validator(mode="after")
    def _names_each_once(self) -> "ExportRequest":
        if len(set(self.formats)) < len(self.formats):
            raise ValueError(f"each format is written once; found {self.formats}")
        return self

    @model_validator(mode="after")
    def _has_a_use_for_variants(self) -> "ExportRequest":
        if self.variants and not set(self.formats) & set(VARIANT_FORMATS):
            raise ValueError(f"none of the formats {self.formats} holds material variants; expected {', '.join(VARIANT_FORMATS)}")
        if len({variant.name for variant in self.variants}) < len(self.variants):
            raise ValueError("two variants of this export have the same name")
        return self

    @model_validator(mode="after")
    def _has_a_use_for_faces(self) -> "ExportRequest":
        refuse_faces(self.faces, self.formats)
        return self


JobRequest = BuildRequest | PoseRequest | RedecoupleRequest | SimulateRequest | RenderRequest | ExportRequest
JOB_REQUESTS: dict[str, type[JobRequest]] = {
    "build": BuildRequest,
    "pose": PoseRequest,
    "redecouple": RedecoupleRequest,
    "simulate": SimulateRequest,
    "render": RenderRequest,
    "export": ExportRequest,
}
