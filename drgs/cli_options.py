"""What commands take: their choices and annotated arguments, and what is made of them. Typer reads them when a command is defined, so nothing heavy is
imported here."""

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from drgs.cli_endings import UsageError
from drgs.exchange.export_formats import DEFAULT_FACES, EXPORT_FORMATS, FEWEST_FACES, FILE_KINDS, SPLAT_KINDS

if TYPE_CHECKING:
    from drgs.scene.asset import Asset


class Preset(StrEnum):
    draft = "draft"
    fast = "fast"
    full = "full"


class BindingKind(StrEnum):
    particles = "particles"
    mesh = "mesh"


class LightKind(StrEnum):
    auto = "auto"
    object = "object"
    camera = "camera"


class MaskKind(StrEnum):
    auto = "auto"
    given = "given"


class DeviceName(StrEnum):
    auto = "auto"
    cpu = "cpu"
    cuda = "cuda"


class Primary(StrEnum):
    gaussians = "gaussians"
    mesh = "mesh"


class Matching(StrEnum):
    auto = "auto"
    exhaustive = "exhaustive"
    sequential = "sequential"


class Denoiser(StrEnum):
    none = "none"
    svgf = "svgf"
    oidn = "oidn"


EXPORT_HELP = "; ".join(
    f"{name}: {kind.title}" for name, kind in (*((name, FILE_KINDS[name]) for name in EXPORT_FORMATS), *SPLAT_KINDS.items())
)
AssetPath = Annotated[Path, typer.Argument(metavar="ASSET", help="Asset folder, or the same zipped.")]
DatasetPath = Annotated[
    Path,
    typer.Argument(
        metavar="DATASET", help="NeRF-synthetic, nerfstudio, COLMAP, Metashape, RealityCapture or NeRO folder; pictures or a film."
    ),
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON document on stdout and nothing else there.")]
StrokesPath = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="Strokes (JSON) over some pictures that say what is the object and what is not: masks of all follow from them.",
        show_default="the capture's own masks, else what is found",
    ),
]
DataFolder = Annotated[
    Path | None,
    typer.Option(
        "--data", help="Folder of assets, jobs and the token.", show_default="data in a checkout, else a folder of the user's own"
    ),
]
LightFrame = Annotated[
    LightKind,
    typer.Option(help="What the lamps stood still with: the object, or (on a turntable) the camera; auto: asked of the pictures."),
]


class CameraKind(StrEnum):
    auto = "auto"
    given = "given"


Masks = Annotated[
    MaskKind,
    typer.Option(help="Where masks end: where the photographs show the object to end, if that is elsewhere (auto), or as given."),
]
Cameras = Annotated[
    CameraKind,
    typer.Option(help="Where photographs were taken from: where they fit the surface best, if that is elsewhere (auto), or as given."),
]
UpDirection = Annotated[
    tuple[float, float, float],
    typer.Option(metavar="X Y Z", help="Direction of the capture's world that points up; the asset's world is turned so that it is z."),
]
BoxCorners = Annotated[
    tuple[float, float, float, float, float, float] | None,
    typer.Option(
        metavar="X0 Y0 Z0 X1 Y1 Z1",
        help="Two corners in the asset's world, which is the capture's after --up: what lies outside is not built.",
        show_default="all of the object",
    ),
]
FaceLimit = Annotated[
    int | None,
    typer.Option(help="The most that a textured mesh (glb, mesh, usdz, usd) has.", show_default=str(DEFAULT_FACES), min=FEWEST_FACES),
]
VariantsPath = Annotated[
    Path | None, typer.Option(help="Other materials of a GLB or a page: JSON, lists of material edits by name (docs/formats.md).")
]
SheetPath = Annotated[
    Path | None,
    typer.Option(metavar="FILE", help="Draw all pictures small, with masks and what is wrong with them, into this PNG or JPEG."),
]


def picture_size(text: str | None) -> tuple[int, int] | None:
    """(width, height) of '400x300'.

    Raises:
        UsageError: it is no such text.
    """
    if text is None:
        return None
    width, _, height = text.partition("x")
    if not (width.isdecimal() and height.isdecimal() and int(width) > 0 and int(height) > 0):
        raise UsageError(f"--size is {text!r}; expected WIDTHxHEIGHT in pixels, like 400x300")
    return int(width), int(height)


def open_asset(path: Path, device: DeviceName) -> "Asset":
    """The asset that ASSET names, on the device that --device names.

    Raises:
        ValueError: it is none, or there is no such device.
    """
    from drgs.scene.asset import load_asset
    from drgs.warp_torch import device_from_name

    return load_asset(path, device_from_name(device.value))
