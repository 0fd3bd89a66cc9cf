"""The kinds of file that an asset goes out as: names, suffixes, and what each holds.

The one table for `drgs export`, export jobs, downloads of the service and the viewer (which reads it from web/src/session/constants.gen.ts).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

ExportFormat = Literal["ply", "ply3", "spz", "glb", "mesh", "usdz", "usd", "env", "html"]
"""What `drgs.export_asset` writes."""
DownloadFormat = Literal[ExportFormat, "zip"]
"""What the service gives out: these, and the asset itself."""


@dataclass(frozen=True)
class FileKind:
    """One format."""

    suffix: str
    """Of files whose name the user does not choose."""
    title: str
    """For a button."""
    description: str
    """What is in it and who reads it, in one line."""
    other_suffixes: tuple[str, ...] = ()
    """Suffixes of the user's choice that mean the same format."""


FILE_KINDS: dict[DownloadFormat, FileKind] = {
    "glb": FileKind(
        ".glb",
        "Mesh and Gaussians (GLB)",
        "Mesh with textures, occlusion and normals among them: Blender, three.js, Unreal, Unity; in a second scene the Gaussians (KHR_gaussian_splatting)",
    ),
    "mesh": FileKind(".glb", "Mesh (GLB)", "The same mesh alone, in a smaller file"),
    "html": FileKind(
        ".html", "Page (HTML)", "One file that any browser opens, without a server: the object to turn, relight and recolour", (".htm",)
    ),
    "ply": FileKind(".ply", "Gaussians (2DGS PLY)", "2D Gaussians with the field names of 2DGS: SuperSplat"),
    "ply3": FileKind(".ply", "Gaussians (3DGS PLY)", "The same as flat ellipsoids, for viewers that want three scales"),
    "spz": FileKind(
        ".spz",
        "Gaussians (SPZ)",
        "The same in a seventh of the bytes, without materials: Scaniverse, Spark, Babylon.js and other viewers of compressed splats",
    ),
    "usdz": FileKind(
        ".usdz",
        "Object for AR (USDZ)",
        "Mesh with textures, upright and in metres: AR Quick Look on iPhone and iPad, and what else reads USD",
    ),
    "usd": FileKind(
        ".usdz",
        "Scene (USD)",
        "Mesh with textures, Gaussians as splats of OpenUSD 26 and the light as a dome, in one package; a .usda has its pictures beside it",
        (".usda", ".usd", ".usdc"),
    ),
    "env": FileKind(
        ".exr", "Light (EXR)", "The environment: with edits the chosen one, turned and dimmed; else the one recovered with the object"
    ),
    "zip": FileKind(".zip", "Asset (ZIP)", "Everything, to open here or with `drgs render`"),
}
"""In the order in which they are offered. Of two formats with one suffix the first is what the suffix stands for."""
EXPORT_FORMATS: tuple[ExportFormat, ...] = tuple(name for name in FILE_KINDS if name != "zip")


def export_format_of(path: Path) -> ExportFormat:
    """The format that a file's suffix stands for.

    Raises:
        ValueError: it stands for none.
    """
    suffix = path.suffix.lower()
    for name in EXPORT_FORMATS:
        if suffix in (FILE_KINDS[name].suffix, *FILE_KINDS[name].other_suffixes):
            return name
    known = dict.fromkeys(FILE_KINDS[name].suffix for name in EXPORT_FORMATS)
    raise ValueError(f"{path}: the suffix {path.suffix!r} names no format; expected {', '.join(known)}, or give --format")
