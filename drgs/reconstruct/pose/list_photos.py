"""What a folder of photographs holds: its pictures, in folders or not, and the mask of each. No pixel is decoded here.

Pictures are png, jpg, jpeg or webp, and where the extras are installed heic and RAW (capture/camera_files.py). Masks lie in masks/ inside the folder, or, where the folder
is called images, in masks/ beside it; load_views/checks.py says how they are named.
"""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path

from drgs.reconstruct.capture.camera_files import check_readers, is_photograph, without_developed
from drgs.reconstruct.capture.load_views import find_cameras
from drgs.reconstruct.capture.load_views.checks import find_masks, is_folder, refuse_asset

FEWEST_PHOTOS = 8
"""With fewer, hardly anything is seen from enough sides, whatever their poses."""
OTHER_SUFFIXES = (".tif", ".tiff", ".mp4", ".mov", ".avi", ".mkv")
"""What people have in place of pictures, named in the sentence when nothing else is there."""


@dataclass(frozen=True)
class Photo:
    """One picture on disc."""

    name: str
    """Unique in the folder, without suffix: left_000 is left/000.jpg."""
    path: Path
    mask: Path | None
    """Picture whose black means background; None when there is none."""


def list_photos(folder: Path) -> list[Photo]:
    """The photographs of a folder, sorted by path.

    Raises:
        ValueError: one sentence: no folder, an asset, posed already, too few pictures, or masks that do not fit them.
    """
    if not is_folder(folder):
        raise ValueError(f"{folder}: no such folder, expected one with photographs.")
    _refuse_posed(folder)
    files = [path for path in sorted(folder.rglob("*")) if path.is_file() and not _is_aside(path.relative_to(folder))]
    images = without_developed([path for path in files if is_photograph(path)])
    check_readers(images)
    if len(images) < FEWEST_PHOTOS:
        refuse_asset(folder)
        others = Counter(path.suffix.lower() for path in files if path.suffix.lower() in OTHER_SUFFIXES)
        beside = f" (and {', '.join(f'{count} {suffix} files' for suffix, count in others.most_common())})" if others else ""
        raise ValueError(
            f"{folder}: {len(images)} pictures{beside}, expected at least {FEWEST_PHOTOS} PNG, JPEG or WebP photographs, better 40 to 100 from all around."
        )
    images_root = folder / "images" if is_folder(folder / "images") else folder
    masks = find_masks(images, images_root, _masks_folder(folder))
    names = _unique_names([path.relative_to(folder) for path in images])
    return [Photo(name, path, mask) for name, path, mask in zip(names, images, masks, strict=True)]


def any_photo(folder: Path) -> bool:
    """Whether pictures are there at all."""
    return any(is_photograph(path) and not _is_aside(path.relative_to(folder)) for path in folder.rglob("*"))


def _refuse_posed(folder: Path) -> None:
    """A folder that has cameras already is a capture, and so is the one around its images/."""
    for place in (folder, folder.resolve().parent) if folder.name == "images" else (folder,):
        found = find_cameras(place)
        if found is not None:
            raise ValueError(
                f"{found}: the pictures are part of a posed capture; build from {place} as it is, or copy the pictures alone to another folder."
            )


def _masks_folder(folder: Path) -> Path:
    inside, beside = folder / "masks", folder.resolve().parent / "masks"
    return beside if folder.name == "images" and not is_folder(inside) else inside


def _is_aside(relative: Path) -> bool:
    """Masks, hidden files and what macOS leaves in archives."""
    return relative.parts[0] == "masks" or any(part.startswith(".") or part == "__MACOSX" for part in relative.parts)


def _unique_names(relatives: list[Path]) -> list[str]:
    """One name a picture: its path with _ for /, with the suffix too where only that tells two apart, and a number where not even that does."""
    names = ["_".join(relative.with_suffix("").parts) for relative in relatives]
    repeated = {name for name, count in Counter(names).items() if count > 1}
    taken: Counter[str] = Counter()
    unique = []
    for name, relative in zip(names, relatives, strict=True):
        chosen = f"{name}_{relative.suffix[1:]}" if name in repeated else name
        taken[chosen] += 1
        unique.append(chosen if taken[chosen] == 1 else f"{chosen}_{taken[chosen]}")
    return unique
