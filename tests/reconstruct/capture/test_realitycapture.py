"""Cameras as RealityCapture exports them, written here from poses and read back."""

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from drgs.reconstruct.capture.load_views import has_cameras, load_views, read_capture
from drgs.scene.lens import pixels_from_plane
from tests.reconstruct import tiny_capture as tiny

F, PX, PY = 45.0, 0.03, -0.02
"""Focal length [mm of 36], and the principal point from the middle, in shares of the longer side."""
HEADER = "#name,x,y,alt,heading,pitch,roll,f,px,py,k1,k2,k3,k4,t1,t2"

REALITYSCAN_2 = "#name,x,y,alt,yaw,pitch,roll,f_35mm,px_norm,py_norm,k1,k2,k3,k4,t1,t2"


def angles_of(world_from_camera: np.ndarray) -> tuple[float, float, float]:
    """Heading, pitch and roll [degrees]: roll leaves the picture's vertical where it is, so its compass direction and its rise are the first two."""
    right, down, ahead = world_from_camera.T
    up, back = -down, -ahead
    pitch = np.arcsin(np.clip(up[2], -1, 1))
    heading = np.arctan2(up[0], up[1])
    roll = np.arctan2(-right[2], back[2])
    return tuple(np.degrees([heading, pitch, roll]))


def write_table(folder: Path, header: str = HEADER, shift: tuple[float, ...] = (0.0, 0.0, 0.0), **coefficients: float) -> Path:
    (folder / "images").mkdir(parents=True)
    lines = [f"#cameras {len(tiny.sphere_views())}", header]
    for view in tiny.sphere_views():
        Image.new("RGB", (tiny.WIDTH, tiny.HEIGHT)).save(folder / "images" / f"{view.name}.png")
        own = np.linalg.inv(view.camera_from_world)
        values = dict(zip(("x", "y", "alt"), own[:3, 3] + shift, strict=True)) | dict(
            zip(("heading", "pitch", "roll"), angles_of(own[:3, :3]), strict=True)
        )
        values |= {"f": F, "px": PX, "py": PY} | coefficients
        names = ["heading" if name == "yaw" else name.split("_")[0] for name in header.lstrip("#").split(",")]
        lines.append(",".join(f"{view.name}.png" if name == "name" else f"{values.get(name, 0):.17g}" for name in names))
    (folder / "cameras.csv").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("header", [HEADER, REALITYSCAN_2, "#name,f,heading,pitch,roll,alt,x,y"])
def test_cameras_come_back_as_they_were_written(header: str, tmp_path: Path) -> None:
    folder = write_table(tmp_path, header)
    capture = read_capture(folder)
    views = {view.name: view for view in tiny.sphere_views()}
    assert has_cameras(folder) and capture.source == "realitycapture"
    assert [photograph.name for photograph in capture.photographs] == sorted(views)
    longer = max(tiny.WIDTH, tiny.HEIGHT)
    px, py = (PX, PY) if "px" in header else (0.0, 0.0)
    for photograph in capture.photographs:
        np.testing.assert_allclose(photograph.camera_from_world, views[photograph.name].camera_from_world, atol=1e-9)
        assert photograph.lens is None
        pinhole, expected = (
            photograph.pinhole,
            (F * longer / 36, F * longer / 36, tiny.WIDTH / 2 + px * longer, tiny.HEIGHT / 2 + py * longer),
        )
        np.testing.assert_allclose((pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy), expected)


@pytest.mark.parametrize(
    ("angles", "ahead", "up"),
    [
        ((0, 0, 0), (0, 0, -1), (0, 1, 0)),  # straight down, north is up
        ((0, 90, 0), (0, 1, 0), (0, 0, 1)),  # to the north, level
        ((90, 90, 0), (1, 0, 0), (0, 0, 1)),  # to the east
        ((90, 60, 0), (np.sin(np.pi / 3), 0, -0.5), (0.5, 0, np.sin(np.pi / 3))),  # a third down
    ],
)
def test_angles_are_those_of_a_compass_and_of_a_camera_that_looks_down_at_zero(
    angles: tuple, ahead: tuple, up: tuple, tmp_path: Path
) -> None:
    heading, pitch, roll = angles
    lines = ["#name,x,y,alt,heading,pitch,roll,f"]
    for name in ("a.png", "b.png", "c.png"):
        Image.new("RGB", (64, 64)).save(tmp_path / name)
        lines.append(f"{name},1,2,3,{heading},{pitch},{roll},50")
    (tmp_path / "a.csv").write_text("\n".join(lines))
    camera = read_capture(tmp_path).photographs[0].camera_from_world
    np.testing.assert_allclose(camera[2, :3], ahead, atol=1e-12)
    np.testing.assert_allclose(-camera[1, :3], up, atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(camera)[:3, 3], (1, 2, 3))


def test_lenses_bend_by_brown(tmp_path: Path) -> None:
    c = {"k1": -0.1, "k2": 0.05, "k3": 0.02, "t1": 0.01, "t2": -0.02}
    lens = read_capture(write_table(tmp_path, **c)).photographs[0].lens
    x, y = np.random.default_rng(0).uniform(-0.3, 0.3, (2, 50))
    r2 = x**2 + y**2
    radial = 1 + c["k1"] * r2 + c["k2"] * r2**2 + c["k3"] * r2**3
    bent = x * radial + c["t1"] * (r2 + 2 * x**2) + 2 * c["t2"] * x * y, y * radial + c["t2"] * (r2 + 2 * y**2) + 2 * c["t1"] * x * y
    longer = max(tiny.WIDTH, tiny.HEIGHT)
    middle = np.array([tiny.WIDTH / 2 + PX * longer, tiny.HEIGHT / 2 + PY * longer])
    assert lens is not None
    np.testing.assert_allclose(pixels_from_plane(lens, np.stack([x, y], -1)), np.stack(bent, -1) * F * longer / 36 + middle, atol=1e-9)


def test_a_georeferenced_world_is_moved_to_the_middle_of_its_cameras(tmp_path: Path) -> None:
    plain, far = read_capture(write_table(tmp_path / "a")), read_capture(write_table(tmp_path / "b", shift=(4.5e5, 5.2e6, 230.0)))
    places = [np.array([np.linalg.inv(p.camera_from_world)[:3, 3] for p in capture.photographs]) for capture in (plain, far)]
    apart = places[1] - places[0]
    assert np.abs(places[1]).max() < 20
    np.testing.assert_allclose(apart, np.broadcast_to(apart[0], apart.shape), atol=1e-6)


def test_masks_are_found(tmp_path: Path) -> None:
    folder = write_table(tmp_path, k1=-0.2)
    (folder / "masks").mkdir()
    for path in (folder / "images").glob("*.png"):
        Image.new("L", (tiny.WIDTH, tiny.HEIGHT), 70).save(folder / "masks" / path.name)
    views = load_views(folder)
    assert views.has_masks and all(bool((mask == 70).all()) for mask in views.coverage) and views.lenses[0] is not None


FAULTS = {
    "a word": (",45,", ",long,", "r_000.png: f = 'long', expected a number"),
    "an infinite number": (",45,", ",inf,", "r_000.png: f = inf, expected a finite number"),
    "no focal length": (",45,", ",0,", "focal length"),
    "a column less": (",45,", ",", "the line of 'r_000.png' has 15 columns, expected 16"),
    "a picture twice": ("r_003.png", "r_004.png", "the line of 'r_004.png' is there twice, expected one a picture"),
    "another picture": ("r_003.png", "r_903.png", "r_903.png.*: no such image, but cameras.csv names it"),
    "a way out": ("r_003.png", "../r_003.png", "leads outside the capture folder"),
    "an eighth power": (",0,0,0,0,0,0", ",0,0,0,0.1,0,0", "k4 = 0.1, expected 0: align with the distortion model Brown3"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_faulty_file_is_refused_in_one_sentence(fault: str, tmp_path: Path) -> None:
    found, wrong, sentence = FAULTS[fault]
    folder = write_table(tmp_path)
    text = (folder / "cameras.csv").read_text()
    assert found in text
    (folder / "cameras.csv").write_text(text.replace(found, wrong, 1))
    with pytest.raises(ValueError, match=sentence):
        read_capture(folder)


def test_other_tables_beside_pictures_are_no_cameras(tmp_path: Path) -> None:
    (tmp_path / "notes.csv").write_text("name,x,y\na,1,2\n")
    for suffix in ("csv", "xml"):
        (tmp_path / f"folder.{suffix}").mkdir()
    assert not has_cameras(tmp_path)
