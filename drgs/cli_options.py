"""What several commands take: their choices and annotated arguments. Typer reads them when a command is defined, so nothing heavy is imported here."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from drgs.exchange.export_formats import EXPORT_FORMATS, FILE_KINDS, SPLAT_KINDS


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
    Path, typer.Argument(metavar="DATASET", help="NeRF-synthetic, nerfstudio, COLMAP, Metashape or NeRO folder; pictures or a film.")
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
