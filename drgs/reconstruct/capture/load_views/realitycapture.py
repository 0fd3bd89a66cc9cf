"""RealityCapture (RealityScan): the CSV of "Internal/External camera parameters", pictures in images/ or beside it.

    #name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2
    #name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2      (RealityScan 2)

A line a picture; columns may stand in any order, for users may write the template, and what bends or shifts may be missing. The world is local: z up, x east
and y north; at heading, pitch and roll of 0 a camera looks straight down with the picture's top to the north, heading turns clockwise as on a compass, pitch lifts the view
and roll turns about the picture's own vertical. The focal length is that of a picture whose longer side is 36 mm, the principal point counts from the middle in
shares of the longer side, k1 to k3 are Brown's, and t1 belongs to x, which is OpenCV's p2. A georeferenced world is moved to the middle of its cameras: float32 has no
digits left for an object there.
Sources: the templates that the program ships, by what others report of them; brown1966 (docs/sources.md).
"""

import csv
import io
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from drgs.reconstruct.capture.load_views.capture import Capture, Photograph
from drgs.reconstruct.capture.load_views.checks import find_image, find_masks, finite_number, image_size, is_file, rigid_camera_from_world
from drgs.reconstruct.capture.load_views.undistort import optics_of
from drgs.scene.lens import Lens

NEEDED = ("name", "x", "y", "alt", "heading", "pitch", "roll", "f")
BENDING = ("px", "py", "k1", "k2", "k3", "k4", "t1", "t2")
SINCE_REALITYSCAN_2 = {"yaw": "heading", "f_35mm": "f", "px_norm": "px", "py_norm": "py"}
"""Columns that were called otherwise before."""
FILM = 36.0
"""Longer side of the picture by which focal lengths are told [mm]."""
EARTH = 1e5
"""A camera that is farther than this from the origin [world units] is one of a georeferenced world."""
MOST_BYTES = 64 << 20
HEAD_BYTES = 1024
"""Within which a file names its columns."""
OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0])


def find_cameras_table(folder: Path) -> Path | None:
    """The first CSV file of the folder that has these columns, or None."""
    for path in filter(is_file, sorted(folder.glob("*.csv"))):
        with path.open("rb") as file:
            head = file.read(HEAD_BYTES).decode("utf-8", "replace")
        if any(set(NEEDED) <= set(_columns(line)) for line in head.splitlines()):
            return path
    return None


def read_realitycapture(folder: Path) -> Capture:
    """Poses, picture files and masks of a folder with such a file."""
    path = find_cameras_table(folder)
    if path is None:
        raise ValueError(f"{folder}: no cameras of RealityCapture, expected a CSV file with the columns {', '.join(NEEDED)}.")
    rows = _rows(path)
    images_root = folder / "images" if (folder / "images").is_dir() else folder
    images = [find_image(images_root, row["name"], path) for row in rows]
    numbers = [{name: _number(row.get(name), f"{path}: {row['name']}: {name}") for name in (*NEEDED[1:], *BENDING)} for row in rows]
    centers = np.array([[own["x"], own["y"], own["alt"]] for own in numbers])
    middle = np.rint(centers.mean(0)) if np.abs(centers).max() > EARTH else np.zeros(3)
    photographs = []
    for image, mask, own, center in zip(images, find_masks(images, images_root, folder / "masks"), numbers, centers, strict=True):
        where = f"{path}: {image.name}"
        world_from_camera = np.eye(4)
        world_from_camera[:3, :3], world_from_camera[:3, 3] = _world_from_camera(own), center - middle
        camera_from_world = rigid_camera_from_world(np.linalg.inv(world_from_camera), where)
        name = str(image.relative_to(images_root).with_suffix("")).replace("/", "_")
        photographs.append(Photograph(name, image, mask, False, camera_from_world, *optics_of(_lens(own, image_size(image), where), where)))
    photographs.sort(key=lambda photograph: photograph.name)
    return Capture("realitycapture", tuple(photographs), None, None)


def _columns(line: str) -> list[str]:
    words = [word.strip().lstrip("#\ufeff").lower() for word in line.split(",")]
    return [SINCE_REALITYSCAN_2.get(word, word) for word in words]


def _rows(path: Path) -> list[dict[str, str]]:
    """Of each picture, its words by column."""
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path}: {path.stat().st_size} bytes, expected at most {MOST_BYTES}.")
    lines = path.read_text("utf-8", "replace").splitlines()
    first = next(number for number, line in enumerate(lines) if set(NEEDED) <= set(_columns(line)))
    columns, rows, names = _columns(lines[first]), [], set()
    for words in csv.reader(io.StringIO("\n".join(lines[first + 1 :]))):
        if not words or words[0].startswith("#"):
            continue
        if len(words) != len(columns):
            raise ValueError(f"{path}: the line of {words[0]!r} has {len(words)} columns, expected {len(columns)}.")
        row = dict(zip(columns, (word.strip() for word in words), strict=True))
        if row["name"] in names:
            raise ValueError(f"{path}: the line of {row['name']!r} is there twice, expected one a picture.")
        names.add(row["name"])
        rows.append(row)
    if not rows:
        raise ValueError(f"{path}: no picture, expected a line for each.")
    return rows


def _number(word: str | None, what: str) -> float:
    """0 where there is no such column."""
    try:
        number = float(word or 0)
    except ValueError as error:
        raise ValueError(f"{what} = {word!r}, expected a number.") from error
    return finite_number(number, what)


def _world_from_camera(own: dict[str, float]) -> Float64[ndarray, "3 3"]:
    """Of OpenCV's axes."""
    (h, p, r), (ch, cp, cr) = (turn([np.radians(own[name]) for name in ("heading", "pitch", "roll")]) for turn in (np.sin, np.cos))
    about_up = np.array([[ch, h, 0.0], [-h, ch, 0.0], [0.0, 0.0, 1.0]])
    about_right = np.array([[1.0, 0.0, 0.0], [0.0, cp, -p], [0.0, p, cp]])
    about_top = np.array([[cr, 0.0, r], [0.0, 1.0, 0.0], [-r, 0.0, cr]])
    return about_up @ about_right @ about_top @ OPENCV_FROM_OPENGL


def _lens(own: dict[str, float], size: tuple[int, int], where: str) -> Lens:
    if own["k4"]:  # COLMAP's models have no eighth power of the radius
        raise ValueError(f"{where}: k4 = {own['k4']:g}, expected 0: align with the distortion model Brown3 and export again.")
    width, height = size
    longer = max(size)
    focal = own["f"] * longer / FILM
    center = 0.5 * width + own["px"] * longer, 0.5 * height + own["py"] * longer
    coefficients = own["k1"], own["k2"], own["t2"], own["t1"], own["k3"], 0.0, 0.0, 0.0
    return Lens("FULL_OPENCV", (focal, focal, *center, *coefficients), width, height)
