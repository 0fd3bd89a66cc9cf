"""Cameras as Metashape exports them, written here by the formulas of its manual and read back."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from drgs.reconstruct.capture.load_views import load_views, read_capture
from drgs.scene.lens import pixels_from_plane
from tests.reconstruct import tiny_capture as tiny

F, CX, CY = 90.0, 2.5, -2.0
"""Focal length, and the principal point from the picture's middle [pixels]."""
ROTATION = np.array([[0.0, -0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, 0.6]])
TRANSLATION, SCALE = np.array([1.0, -2.0, 0.5]), 2.5


def words(numbers: np.ndarray) -> str:
    return " ".join(f"{number:.17g}" for number in np.ravel(numbers))


def write_metashape(
    folder: Path, kind: str = "frame", in_component: bool = True, translation: np.ndarray = TRANSLATION, **coefficients: float
) -> Path:
    """cameras.xml with the sphere's cameras in a frame of their own, which a transform leads to the world, and black pictures."""
    (folder / "images").mkdir(parents=True)
    cameras = ['<camera id="90" sensor_id="3" component_id="0" label="not aligned"/>']
    for index, view in enumerate(tiny.sphere_views()):
        Image.new("RGB", (tiny.WIDTH, tiny.HEIGHT)).save(folder / "images" / f"{view.name}.png")
        own = np.linalg.inv(view.camera_from_world)
        own[:3, :3], own[:3, 3] = ROTATION.T @ own[:3, :3], ROTATION.T @ (own[:3, 3] - TRANSLATION) / SCALE
        label = view.name if index % 2 else f"{view.name}.png"  # either is met
        cameras.append(f'<camera id="{index}" sensor_id="3" component_id="0" label="{label}"><transform>{words(own)}</transform></camera>')
    # One of another component, which has no place in this world.
    cameras.append(f'<camera id="91" sensor_id="4" component_id="1" label="elsewhere"><transform>{words(np.eye(4))}</transform></camera>')
    transform = (
        f'<transform><rotation locked="false">{words(ROTATION)}</rotation><translation locked="false">{words(translation)}</translation>'
        f'<scale locked="false">{SCALE}</scale></transform>'
    )
    numbers = {"f": F, "cx": CX, "cy": CY, **coefficients}
    adjusted = "".join(f"<{name}>{number!r}</{name}>" for name, number in numbers.items())
    (folder / "cameras.xml").write_text(
        f'<?xml version="1.0" encoding="UTF-8"?>\n<document version="1.5.0"><chunk label="Chunk 1" enabled="true">'
        f'<sensors next_id="5"><sensor id="3" label="unknown" type="{kind}"><resolution width="{tiny.WIDTH}" height="{tiny.HEIGHT}"/>'
        f'<calibration type="{kind}" class="initial"><f>50</f></calibration>'
        f'<calibration type="{kind}" class="adjusted">{adjusted}</calibration></sensor></sensors>'
        f'<components next_id="1">{f"""<component id="0">{transform}</component>""" if in_component else ""}</components>'
        f"<cameras>{cameras[0]}<group>{''.join(cameras[1:5])}</group>{''.join(cameras[5:])}</cameras>"
        f"{'' if in_component else transform}</chunk></document>"
    )
    return folder


@pytest.mark.parametrize("in_component", [True, False])
def test_cameras_come_back_as_they_were_written(in_component: bool, tmp_path: Path) -> None:
    capture = read_capture(write_metashape(tmp_path, in_component=in_component))
    views = {view.name: view for view in tiny.sphere_views()}
    assert capture.source == "metashape" and {photograph.name for photograph in capture.photographs} == set(views)
    for photograph in capture.photographs:
        np.testing.assert_allclose(photograph.camera_from_world, views[photograph.name].camera_from_world, atol=1e-9)
        assert photograph.lens is None
        pinhole = photograph.pinhole
        assert (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy) == (F, F, 0.5 * tiny.WIDTH + CX, 0.5 * tiny.HEIGHT + CY)


def pixels_by_the_manual(kind: str, plane: np.ndarray, c: dict[str, float]) -> np.ndarray:
    """Metashape's frame and fisheye cameras."""
    x, y = plane[..., 0], plane[..., 1]
    if kind == "fisheye":
        r0 = np.sqrt(x**2 + y**2)
        x, y = x * np.arctan(r0) / r0, y * np.arctan(r0) / r0
    r2 = x**2 + y**2
    radial = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3 + c.get("k4", 0.0) * r2**4
    bent_x = x * radial + (c["p1"] * (r2 + 2 * x**2) + 2 * c["p2"] * x * y)
    bent_y = y * radial + (c["p2"] * (r2 + 2 * y**2) + 2 * c["p1"] * x * y)
    return np.stack([0.5 * tiny.WIDTH + CX + bent_x * F + bent_x * c["b1"], 0.5 * tiny.HEIGHT + CY + bent_y * F], -1)


@pytest.mark.parametrize("kind", ["frame", "fisheye"])
def test_lenses_bend_as_the_manual_says(kind: str, tmp_path: Path) -> None:
    coefficients = {"k1": -0.1, "k2": 0.05, "k3": 0.02, "p1": 0.01, "p2": -0.02, "b1": 1.5} | ({"k4": 0.03} if kind == "fisheye" else {})
    photograph = read_capture(write_metashape(tmp_path, kind, **coefficients)).photographs[0]
    plane = np.random.default_rng(0).uniform(-0.4, 0.4, (50, 2))
    assert photograph.lens is not None
    np.testing.assert_allclose(pixels_from_plane(photograph.lens, plane), pixels_by_the_manual(kind, plane, coefficients), atol=1e-9)


def test_a_georeferenced_chunk_keeps_its_own_frame_in_metres(tmp_path: Path) -> None:
    in_chunk = read_capture(write_metashape(tmp_path, translation=np.array([4.0e6, 6e5, 4.9e6]))).photographs[5].camera_from_world
    view = tiny.sphere_views()[5]
    center, expected = -in_chunk[:3, :3].T @ in_chunk[:3, 3], ROTATION.T @ (np.linalg.inv(view.camera_from_world)[:3, 3] - TRANSLATION)
    np.testing.assert_allclose(center, expected, atol=1e-9)


def test_pictures_are_undistorted_and_masks_found(tmp_path: Path) -> None:
    folder = write_metashape(tmp_path, k1=-0.2)
    (folder / "masks").mkdir()
    for path in (folder / "images").glob("*.png"):
        Image.new("L", (tiny.WIDTH, tiny.HEIGHT), 70).save(folder / "masks" / path.name)
    views = load_views(folder)
    assert views.has_masks and all(bool((mask == 70).all()) for mask in views.coverage) and views.lenses[0] is not None
    assert views.cameras[0].width == views.images_srgb[0].shape[1]


FAULTS = {
    "no cameras": ("<camera ", "<kamera ", "no camera with a transform"),
    "cut short": ("</document>", "", "not valid XML"),
    "an entity": ("<document", '<!DOCTYPE d [<!ENTITY a "aaaa">]><document', "declares a document type"),
    "a word": ("<f>90.0</f>", "<f>long</f>", "sensor unknown: f is not a list of numbers"),
    "no number at all": ("<f>90.0</f>", "<f/>", "sensor unknown: f has 0 numbers, expected 1"),
    "an infinite number": ("<f>90.0</f>", "<f>inf</f>", "sensor unknown: f = inf, expected a finite number"),
    "no focal length": ("<f>90.0</f>", "", "focal length fx = 0"),
    "no resolution": ("<resolution ", "<size ", "no calibration or no resolution"),
    "half a pixel": ('width="72"', 'width="72.5"', "resolution '72.5' x '56'"),
    "another type": ('type="frame"', 'type="spherical"', "camera type 'spherical', expected frame or fisheye"),
    "a skew": ("<f>90.0</f>", "<f>90.0</f><b2>0.5</b2>", "b2 = 0.5, expected 0"),
    "an eighth power": ("<f>90.0</f>", "<f>90.0</f><k4>0.1</k4>", "k4 = 0.1, expected 0"),
    "another sensor": ('sensor_id="3"', 'sensor_id="8"', "sensor '8', which the chunk does not hold"),
    "another picture": ('label="r_003"', 'label="r_903"', "r_903.png .*: no such image, but cameras.xml names it"),
    "a way out": ('label="r_003"', 'label="../r_003"', "leads outside the capture folder"),
    "no scale": ("<scale ", '<scale locked="false">0</scale><scale ', "scale = 0, expected more than 0"),
    "a short rotation": ('<rotation locked="false">', '<rotation locked="false">1 0 0</rotation><rotation>', "rotation has 3 numbers"),
    "a mirror": ('<rotation locked="false">', '<rotation locked="false">-1 0 0 0 1 0 0 0 1</rotation><rotation>', "not rigid"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_file_is_refused_in_one_sentence(fault: str, tmp_path: Path) -> None:
    found, wrong, sentence = FAULTS[fault]
    folder = write_metashape(tmp_path)
    path = folder / "cameras.xml"
    text = path.read_text()
    assert found in text
    text = text.replace(found, wrong)
    text = text.replace("</resolution>", "</size>") if fault == "no resolution" else text
    text = text.replace("</camera>", "</kamera>") if fault == "no cameras" else text
    path.write_text(text)
    with pytest.raises(ValueError, match=sentence) as refusal:
        read_capture(folder)
    assert "\n" not in str(refusal.value)
