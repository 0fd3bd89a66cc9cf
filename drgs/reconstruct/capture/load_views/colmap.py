"""COLMAP: sparse/0 or sparse with cameras, images and points3D as .bin or .txt, pictures in images/.

Poses in the files are world-to-camera with OpenCV axes, as inside. Principal points count the top-left pixel's centre as
(0.5, 0.5), as here. COLMAP's world has no up: it is kept as it is, so that other files in the same world stay valid.
Source: COLMAP documentation, "Output Format".
"""

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float
from numpy import ndarray

from drgs.reconstruct.capture.load_views.capture import Capture, Photograph, Pinhole
from drgs.reconstruct.capture.load_views.checks import NO_PANORAMA, find_masks, is_file, rigid_camera_from_world, shown
from drgs.reconstruct.capture.load_views.undistort import optics_of
from drgs.scene.lens import PARAMETER_NAMES, Lens

PARAMETER_COUNTS = {**{model: len(names) for model, names in PARAMETER_NAMES.items()}, "EQUIRECTANGULAR": 2}
"""COLMAP's camera models in the order of their numbers in cameras.bin, with the length of their parameter lists (as of COLMAP 4.2)."""
MODEL_NAMES = tuple(PARAMETER_COUNTS)


@dataclass(frozen=True)
class _ColmapCamera:
    camera_id: int
    model: str
    width: int
    height: int
    parameters: tuple[float, ...]


@dataclass(frozen=True)
class _ColmapImage:
    name: str
    camera_id: int
    quat_wxyz: tuple[float, ...]
    translation: tuple[float, ...]


def find_model(folder: Path) -> Path | None:
    """The folder with the camera file, or None."""
    for candidate in (folder / "sparse" / "0", folder / "sparse", folder / "colmap" / "sparse" / "0"):
        if any((candidate / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return candidate
    return None


def read_colmap(folder: Path) -> Capture:
    """Poses, picture files, masks and points of a folder with a COLMAP model."""
    model = find_model(folder)
    if model is None:
        raise ValueError(f"{folder}: no cameras.bin or cameras.txt in sparse/0 or sparse.")
    suffix = ".bin" if (model / "cameras.bin").is_file() else ".txt"
    for part in ("images", "points3D"):
        if part == "images" and not (model / f"{part}{suffix}").is_file():
            raise ValueError(f"{model / part}{suffix}: no such file beside cameras{suffix}.")
    images_root = folder / "images" if (folder / "images").is_dir() else folder
    read_cameras, read_images, read_points = (
        (_cameras_bin, _images_bin, _points_bin) if suffix == ".bin" else (_cameras_txt, _images_txt, _points_txt)
    )
    try:
        cameras = {camera.camera_id: camera for camera in read_cameras(model / "cameras")}
        images = sorted(read_images(model / "images"), key=lambda image: image.name)
        points = read_points(model / "points3D") if (model / f"points3D{suffix}").is_file() else np.zeros((0, 6))
    except (struct.error, IndexError, UnicodeDecodeError) as error:
        raise ValueError(f"{model}: a COLMAP {suffix} file is cut short or damaged ({error}).") from error
    except ValueError as error:
        raise (
            error if str(error).startswith(str(model)) else ValueError(f"{model}: a COLMAP {suffix} file is damaged ({error}).")
        ) from error

    paths = [images_root / image.name for image in images]
    for path, image in zip(paths, images, strict=True):
        if Path(image.name).is_absolute() or ".." in Path(image.name).parts:
            raise ValueError(f"{model}/images{suffix}: image name {image.name!r} leads outside {images_root}.")
        if not is_file(path):
            raise ValueError(f"{path}: no such image, but {model.name}/images{suffix} names it.")
    masks = find_masks(paths, images_root, folder / "masks")
    photographs = []
    for image, path, mask in zip(images, paths, masks, strict=True):
        if image.camera_id not in cameras:
            raise ValueError(
                f"{model}/images{suffix}: image {image.name} has camera {image.camera_id}, which cameras{suffix} does not hold."
            )
        where = f"{model}/images{suffix}: image {image.name}"
        camera_from_world = np.eye(4)
        camera_from_world[:3, :3] = _rotation_from_quat(np.array(image.quat_wxyz), where)
        camera_from_world[:3, 3] = image.translation
        name = str(Path(image.name).with_suffix("")).replace("/", "_")
        pinhole, lens = _optics(cameras[image.camera_id], model / f"cameras{suffix}")
        photographs.append(Photograph(name, path, mask, False, rigid_camera_from_world(camera_from_world, where), pinhole, lens))
    has_points = len(points) > 0
    return Capture(
        "colmap",
        tuple(photographs),
        points[:, :3].astype(np.float32) if has_points else None,
        (points[:, 3:] / 255).astype(np.float32) if has_points else None,
    )


def _optics(camera: _ColmapCamera, path: Path) -> tuple[Pinhole, Lens | None]:
    if camera.model == "EQUIRECTANGULAR":
        raise ValueError(f"{path}: camera model {camera.model}, expected that of a lens; {NO_PANORAMA}.")
    if camera.model not in PARAMETER_NAMES:
        raise ValueError(f"{path}: camera model {shown(camera.model)}, expected one of {', '.join(PARAMETER_NAMES)}.")
    lens = Lens(camera.model, camera.parameters, camera.width, camera.height)
    return optics_of(lens, f"{path}: camera {camera.camera_id}")


def _rotation_from_quat(quat_wxyz: Float[ndarray, "4"], where: str) -> Float[ndarray, "3 3"]:
    norm = float(np.linalg.norm(quat_wxyz))
    if not np.isfinite(norm) or not 0.5 < norm < 2:
        raise ValueError(f"{where}: its quaternion {quat_wxyz.tolist()} has length {norm:.4g}, expected 1.")
    w, x, y, z = quat_wxyz / norm
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def _cameras_bin(stem: Path) -> Iterator[_ColmapCamera]:
    data, at = stem.with_suffix(".bin").read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        camera_id, model, width, height = struct.unpack_from("<iiQQ", data, at)
        if not 0 <= model < len(MODEL_NAMES):
            raise ValueError(
                f"{stem}.bin: camera model number {model}, expected 0 to {len(MODEL_NAMES) - 1}, which are those of COLMAP 4; the file is "
                "damaged, or of a newer COLMAP, which turns the pictures into pinhole ones by its command image_undistorter"
            )
        name = MODEL_NAMES[model]
        parameters = struct.unpack_from(f"<{PARAMETER_COUNTS[name]}d", data, at + 24)
        at += 24 + 8 * PARAMETER_COUNTS[name]
        yield _ColmapCamera(camera_id, name, width, height, parameters)


def _images_bin(stem: Path) -> Iterator[_ColmapImage]:
    data, at = stem.with_suffix(".bin").read_bytes(), 8
    for _ in range(struct.unpack_from("<Q", data)[0]):
        numbers = struct.unpack_from("<i7di", data, at)
        end = data.find(b"\0", at + 64)
        if end < 0:
            raise IndexError("an image name has no end")
        name = data[at + 64 : end].decode("utf-8")
        at = end + 1 + 8 + 24 * struct.unpack_from("<Q", data, end + 1)[0]
        _check_end(at, data)
        yield _ColmapImage(name, numbers[8], numbers[1:5], numbers[5:8])


def _check_end(at: int, data: bytes) -> None:
    if at > len(data):
        raise IndexError(f"an entry ends at byte {at} of {len(data)}")


def _points_bin(stem: Path) -> Float[ndarray, "point 6"]:
    """(n, 6): position, colour 0..255."""
    data, at = stem.with_suffix(".bin").read_bytes(), 8
    rows = []
    row = struct.Struct("<Q3d3BdQ")
    for _ in range(struct.unpack_from("<Q", data)[0]):
        numbers = row.unpack_from(data, at)
        rows.append(numbers[1:7])
        at += row.size + 8 * numbers[8]
        _check_end(at, data)
    return np.array(rows, dtype=np.float64).reshape(-1, 6)


def _lines(stem: Path) -> list[str]:
    """Lines without comments. Empty ones stay: an image without features has an empty second line."""
    text = stem.with_suffix(".txt").read_text(encoding="utf-8")
    return [line.strip() for line in text.splitlines() if not line.startswith("#")]


def _cameras_txt(stem: Path) -> Iterator[_ColmapCamera]:
    for line in filter(None, _lines(stem)):
        words = line.split()
        parameters = tuple(float(word) for word in words[4:])
        expected = PARAMETER_COUNTS.get(words[1], len(parameters))
        if len(parameters) != expected:
            raise ValueError(f"{stem}.txt: {words[1]} with {len(parameters)} parameters, expected {expected}.")
        yield _ColmapCamera(int(words[0]), words[1], int(words[2]), int(words[3]), parameters)


def _images_txt(stem: Path) -> Iterator[_ColmapImage]:
    lines = _lines(stem)
    while lines and not lines[0]:
        lines.pop(0)
    for line in lines[::2]:
        if line:
            words = line.split(maxsplit=9)
            numbers = [float(word) for word in words[1:8]]
            yield _ColmapImage(words[9], int(words[8]), tuple(numbers[:4]), tuple(numbers[4:]))


def _points_txt(stem: Path) -> Float[ndarray, "point 6"]:
    """(n, 6): position, colour 0..255."""
    rows = [[float(word) for word in line.split()[1:7]] for line in _lines(stem) if line]
    return np.array(rows, dtype=np.float64).reshape(-1, 6)
