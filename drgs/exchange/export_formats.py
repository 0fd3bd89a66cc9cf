"""The kinds of file that an asset goes out as: names, suffixes, and what each holds.

The one table for `drgs export`, export jobs, downloads of the service and the viewer (which reads it from web/src/session/constants.gen.ts).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

ExportFormat = Literal["ply", "ply3", "spz", "glb", "mesh", "usdz", "usd", "env", "html"]
"""What `drgs.export_asset` writes."""
DownloadFormat = Literal[ExportFormat, "zip"]
"""What the service gives out: these, and the asset itself."""
SplatFormat = Literal["sog", "compressed"]
"""What splat-transform writes: for the command where Node is (drgs/convert/transform_splats.py), for the viewer in the browser."""
CommandFormat = Literal[ExportFormat, SplatFormat]
"""What `drgs export` writes."""
DEFAULT_FACES = 30_000
"""The most that a textured mesh has where nobody says. Charts of so many take some ten seconds of a core, of twice as many a minute."""
FEWEST_FACES = 4
"""Of a tetrahedron."""
MOST_FACES = 2**31 - 1
"""That a service takes: as good as all of them."""


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
    textured: bool = False
    """Holds a mesh with textures, whose number of faces can be chosen."""


FILE_KINDS: dict[DownloadFormat, FileKind] = {
    "glb": FileKind(
        ".glb",
        "Mesh and Gaussians (GLB)",
        "Mesh with textures, occlusion and normals among them: Blender, three.js, Unreal, Unity; in a second scene the Gaussians (KHR_gaussian_splatting)",
        textured=True,
    ),
    "mesh": FileKind(".glb", "Mesh (GLB)", "The same mesh alone, in a smaller file", textured=True),
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
        textured=True,
    ),
    "usd": FileKind(
        ".usdz",
        "Scene (USD)",
        "Mesh with textures, Gaussians as splats of OpenUSD 26 and the light as a dome, in one package; a .usda has its pictures beside it",
        (".usda", ".usd", ".usdc"),
        textured=True,
    ),
    "env": FileKind(
        ".exr", "Light (EXR)", "The environment: with edits the chosen one, turned and dimmed; else the one recovered with the object"
    ),
    "zip": FileKind(".zip", "Asset (ZIP)", "Everything, to open here or with `drgs render`"),
}
"""In the order in which they are offered. Of two formats with one suffix the first is what the suffix stands for."""
EXPORT_FORMATS: tuple[ExportFormat, ...] = tuple(name for name in FILE_KINDS if name != "zip")
SPLAT_KINDS: dict[SplatFormat, FileKind] = {
    "sog": FileKind(
        ".sog", "Gaussians (SOG)", "The Gaussians in a ninth of the bytes, for SuperSplat and PlayCanvas; takes minutes without a GPU"
    ),
    "compressed": FileKind(
        ".compressed.ply", "Gaussians (compressed PLY)", "The Gaussians in a quarter of the bytes, for SuperSplat and PlayCanvas"
    ),
}
"""By splat-transform: the service has none of these."""
VARIANT_FORMATS: tuple[ExportFormat, ...] = ("glb", "mesh", "html")
"""They hold other materials of the same mesh."""
TEXTURED_FORMATS: tuple[ExportFormat, ...] = tuple(name for name in EXPORT_FORMATS if FILE_KINDS[name].textured)


def command_format_of(path: Path) -> CommandFormat:
    """As export_format_of, with the endings of SPLAT_KINDS.

    Raises:
        ValueError: it stands for none.
    """
    for name, kind in SPLAT_KINDS.items():
        if path.name.lower().endswith(kind.suffix):
            return name
    return export_format_of(path)


def refuse_faces(faces: int | None, formats: Sequence[str]) -> None:
    """
    Args:
        faces: the most that textured meshes are asked to have; None where nobody says.

    Raises:
        ValueError: it is no such number, or none of the formats has a use for it.
    """
    if faces is None:
        return
    if not set(formats) & set(TEXTURED_FORMATS):
        found = ", ".join(map(repr, formats))
        raise ValueError(f"{faces} faces were asked for of format {found}, which has no textures; expected {', '.join(TEXTURED_FORMATS)}")
    if faces < FEWEST_FACES:
        raise ValueError(f"{faces} faces were asked for; expected at least {FEWEST_FACES}")


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
