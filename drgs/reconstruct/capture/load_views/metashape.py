"""Agisoft Metashape: the XML that "Export Cameras" writes, pictures in images/ or beside it.

Cameras' transforms lead from the camera (OpenCV axes) to their component, the component's (in older files the chunk's) on to the world;
principal points count from the picture's middle, and the top-left pixel's centre is (0.5, 0.5), as here. Of several components the one
with most cameras is read: the others have no place in its world. A georeferenced world has its origin in the middle of the Earth, where
float32 has no digits left for an object: then the component's own axes and origin stay, in metres.
Source: Metashape Professional user manual, appendix "Camera models".
"""

import xml.etree.ElementTree as ET
from collections import Counter
from pathlib import Path

import numpy as np
from jaxtyping import Float64
from numpy import ndarray

from drgs.reconstruct.capture.load_views.capture import Capture, Photograph, Pinhole
from drgs.reconstruct.capture.load_views.checks import find_image, find_masks, finite_number, is_file, rigid_camera_from_world, shown
from drgs.reconstruct.capture.load_views.undistort import optics_of
from drgs.scene.lens import Lens

EARTH = 1e5
"""A world whose origin is farther than this from a component's [world units] is taken for a georeferenced one."""
MOST_BYTES = 64 << 20
HEAD_BYTES = 1024
"""Within which a file says that it is a document."""


def find_cameras_file(folder: Path) -> Path | None:
    """The first XML file of the folder that looks like Metashape's, or None."""
    for path in filter(is_file, sorted(folder.glob("*.xml"))):
        with path.open("rb") as file:
            if b"<document" in file.read(HEAD_BYTES):
                return path
    return None


def read_metashape(folder: Path) -> Capture:
    """Poses, picture files and masks of a folder with such a file; cameras without a pose are left out."""
    path = find_cameras_file(folder)
    if path is None:
        raise ValueError(f"{folder}: no Metashape cameras, expected an XML file with a document of chunks.")
    chunk = _parsed(path).find("chunk")
    cameras = [] if chunk is None else [camera for camera in chunk.iter("camera") if camera.find("transform") is not None]
    if chunk is None or not cameras:
        raise ValueError(f"{path}: no camera with a transform, expected a chunk with aligned cameras.")
    component = Counter(camera.get("component_id") for camera in cameras).most_common(1)[0][0]
    cameras = sorted((c for c in cameras if c.get("component_id") == component), key=lambda camera: camera.get("label", ""))
    scale, world_from_component = _world_from_component(chunk, component, path)
    optics = {sensor.get("id"): _optics(sensor, path) for sensor in _used_sensors(chunk, cameras)}

    images_root = folder / "images" if (folder / "images").is_dir() else folder
    images = [find_image(images_root, camera.get("label", ""), path) for camera in cameras]
    photographs = []
    for camera, image, mask in zip(cameras, images, find_masks(images, images_root, folder / "masks"), strict=True):
        where = f"{path}: camera {camera.get('label')}"
        if camera.get("sensor_id") not in optics:
            raise ValueError(f"{where}: sensor {shown(camera.get('sensor_id'))}, which the chunk does not hold.")
        component_from_camera = _numbers(camera, "transform", 16, where).reshape(4, 4)
        component_from_camera[:3, 3] *= scale
        # Checked before the inverse, so that the sentence speaks of the numbers in the file.
        camera_from_world = np.linalg.inv(world_from_component @ rigid_camera_from_world(component_from_camera, where))
        name = str(image.relative_to(images_root).with_suffix("")).replace("/", "_")
        photographs.append(Photograph(name, image, mask, False, camera_from_world, *optics[camera.get("sensor_id")]))
    return Capture("metashape", tuple(photographs), None, None)


def _parsed(path: Path) -> ET.Element:
    if path.stat().st_size > MOST_BYTES:
        raise ValueError(f"{path}: {path.stat().st_size} bytes, expected at most {MOST_BYTES}.")
    text = path.read_bytes()
    if b"<!" in text.replace(b"<!--", b""):  # entities can grow without bound
        raise ValueError(f"{path}: declares a document type, which no camera file of Metashape does.")
    try:
        return ET.fromstring(text)
    except (ET.ParseError, ValueError, LookupError) as error:  # also an encoding that there is not
        raise ValueError(f"{path}: not valid XML ({error}).") from error


def _numbers(element: ET.Element, tag: str, count: int, where: str) -> Float64[ndarray, "number"]:
    words = (element.findtext(tag) or "").split()
    try:
        numbers = np.array([finite_number(float(word), f"{where}: {tag}") for word in words])
    except ValueError as error:
        raise error if str(error).startswith(where) else ValueError(f"{where}: {tag} is not a list of numbers ({error}).") from error
    if len(numbers) != count:
        raise ValueError(f"{where}: {tag} has {len(numbers)} numbers, expected {count}.")
    return numbers


def _world_from_component(chunk: ET.Element, component: str | None, path: Path) -> tuple[float, Float64[ndarray, "4 4"]]:
    """The factor of lengths, and the rigid transform that follows it."""
    own = next((found for found in chunk.iter("component") if component is not None and found.get("id") == component), None)
    found = None if own is None else own.find("transform")
    found = chunk.find("transform") if found is None else found
    scale, rigid, where = 1.0, np.eye(4), f"{path}: the chunk's transform"
    if found is None:
        return scale, rigid
    if found.find("scale") is not None:
        scale = float(_numbers(found, "scale", 1, where)[0])
    if scale <= 0:
        raise ValueError(f"{where}: scale = {scale:g}, expected more than 0.")
    if found.find("rotation") is not None:
        rigid[:3, :3] = _numbers(found, "rotation", 9, where).reshape(3, 3)
    if found.find("translation") is not None:
        rigid[:3, 3] = _numbers(found, "translation", 3, where)
    if np.abs(rigid[:3, 3]).max() > EARTH:
        return scale, np.eye(4)
    return scale, rigid_camera_from_world(rigid, where)


def _used_sensors(chunk: ET.Element, cameras: list[ET.Element]) -> list[ET.Element]:
    used = {camera.get("sensor_id") for camera in cameras}
    return [sensor for sensor in chunk.iter("sensor") if sensor.get("id") in used]


def _optics(sensor: ET.Element, path: Path) -> tuple[Pinhole, Lens | None]:
    where = f"{path}: sensor {sensor.get('label', sensor.get('id'))}"
    found = sensor.findall("calibration")
    # "initial" is what the alignment began with.
    calibration = next((one for one in found if one.get("class") == "adjusted"), found[0] if found else None)
    resolution = sensor.find("resolution")
    if calibration is None or resolution is None:
        raise ValueError(f"{where}: no calibration or no resolution, expected both.")
    width, height = (resolution.get(side, "") for side in ("width", "height"))
    if not (width.isdecimal() and height.isdecimal()):
        raise ValueError(f"{where}: resolution {width!r} x {height!r}, expected whole numbers of pixels.")
    kind = calibration.get("type", sensor.get("type", "frame"))

    def number(tag: str) -> float:
        return 0.0 if calibration.find(tag) is None else float(_numbers(calibration, tag, 1, where)[0])

    # Of a frame camera COLMAP's models have no eighth power of the radius; of none a skew or tangential terms of higher order.
    for tag in ("b2", "p3", "p4", *(("k4",) if kind == "frame" else ())):
        if number(tag):
            raise ValueError(f"{where}: {tag} = {number(tag):g}, expected 0: optimize the cameras without it and export again.")
    focal, cx, cy = number("f"), 0.5 * int(width) + number("cx"), 0.5 * int(height) + number("cy")
    # Metashape's p1 belongs to x, OpenCV's to y.
    k1, k2, k3, k4, p1, p2 = number("k1"), number("k2"), number("k3"), number("k4"), number("p2"), number("p1")
    if kind == "frame":
        model, coefficients = "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    elif kind == "fisheye":
        model, coefficients = "THIN_PRISM_FISHEYE", (k1, k2, p1, p2, k3, k4, 0.0, 0.0)
    else:
        raise ValueError(f"{where}: camera type {shown(kind)}, expected frame or fisheye.")
    return optics_of(Lens(model, (focal + number("b1"), focal, cx, cy, *coefficients), int(width), int(height)), where)
