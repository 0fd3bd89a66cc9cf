"""What the service needs to know of an asset folder without loading it (no torch here): its counts and its size."""

import json
from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class AssetCounts:
    surfels: int
    vertices: int
    faces: int


def count_asset_folder(folder: Path) -> AssetCounts:
    """From `counts` of asset.json.

    Raises:
        ValueError: the folder is no asset.
    """
    path = folder / "asset.json"
    try:
        document = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{folder.name}: expected an asset folder with a readable asset.json; {error}") from error
    counts = document.get("counts") if isinstance(document, dict) else None
    if not isinstance(counts, dict):
        raise ValueError(f"{folder.name}/asset.json: expected an object `counts`")

    def number(*names: str) -> int:
        return next((int(counts[name]) for name in names if name in counts), 0)

    return AssetCounts(number("surfels", "gaussians"), number("vertices"), number("faces"))


def folder_bytes(folder: Path) -> int:
    """Of all files in it."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
