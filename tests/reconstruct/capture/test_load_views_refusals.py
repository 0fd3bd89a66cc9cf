"""Captures that are not fine: one sentence that names the file, what was found and what was expected."""

import json
import math
import pickle
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import pytest
from PIL import Image

from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.capture.load_views.checks import CaptureFault
from drgs.scene.lens import Lens
from tests.reconstruct import tiny_capture as tiny


def _edit(change: Callable[[dict], None], name: str = "transforms_train.json") -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        path = folder / name
        document = json.loads(path.read_text())
        change(document)
        path.write_text(json.dumps(document))

    return apply


def _resize(name: str, size: tuple[int, int]) -> Callable[[Path], None]:
    return lambda folder: Image.open(folder / "train" / name).resize(size).save(folder / "train" / name)


def _frame(index: int, **values: object) -> Callable[[Path], None]:
    return _edit(lambda document: document["frames"][index].update(values))


def _matrix(change: Callable[[list], None]) -> Callable[[Path], None]:
    return _edit(lambda document: change(document["frames"][2]["transform_matrix"]))


def _scale_rotation(matrix: list) -> None:
    for row in range(3):
        for column in range(3):
            matrix[row][column] *= 1.5


def _mirror(matrix: list) -> None:
    for row in range(3):
        matrix[row][0] *= -1


def _unpacking_text(folder: Path) -> None:
    """A chunk of text behind the header that unpacks to two megabytes."""
    path = folder / "train" / "r_001.png"
    whole, chunk = path.read_bytes(), b"zTXtk\0\0" + zlib.compress(bytes(2_000_000))
    at = whole.index(b"IDAT") - 4
    path.write_bytes(whole[:at] + struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) + whole[at:])


SYNTHETIC_FAULTS: dict[str, tuple[Callable[[Path], None], list[str]]] = {
    "missing image": (lambda folder: (folder / "train" / "r_004.png").unlink(), ["r_004.png", "no such image", "transforms_train.json"]),
    "wrong size": (_edit(lambda d: d.update(w=100, h=80, fl_x=90.0)), ["r_000.png", "72x56", "100x80"]),
    "unreadable image": (lambda folder: (folder / "train" / "r_001.png").write_bytes(b"not a picture"), ["r_001.png", "not a readable"]),
    "text that unpacks": (_unpacking_text, ["r_001.png", "not a readable", "too large"]),
    "half an image": (
        lambda folder: (folder / "train" / "r_001.png").write_bytes((folder / "train" / "r_001.png").read_bytes()[:200]),
        ["r_001.png", "cannot be decoded"],
    ),
    "NaN pose": (_matrix(lambda m: m[1].__setitem__(3, math.nan)), ["r_002", "NaN"]),
    "scaled pose": (_matrix(_scale_rotation), ["r_002", "not rigid"]),
    "mirrored pose": (_matrix(_mirror), ["r_002", "not rigid", "-1"]),
    "pose of another shape": (_frame(2, transform_matrix=[[1, 0], [0, 1]]), ["r_002", "(2, 2)", "4x4"]),
    "projective pose": (_matrix(lambda m: m[3].__setitem__(0, 0.5)), ["r_002", "last row"]),
    "two views": (_edit(lambda d: d.update(frames=d["frames"][:2])), ["2 views", "at least 3"]),
    "no frames": (_edit(lambda d: d.update(frames=[])), ["transforms_train.json", "non-empty"]),
    "not JSON": (lambda folder: (folder / "transforms_train.json").write_text("{"), ["transforms_train.json", "not valid JSON"]),
    "degrees": (_edit(lambda d: d.update(camera_angle_x=40.0)), ["camera_angle_x = 40.0", "degrees", "radians"]),
    "no intrinsics": (_edit(lambda d: d.pop("camera_angle_x")), ["no intrinsics", "camera_angle_x"]),
    "absurd focal length": (_edit(lambda d: d.update(fl_x=2.0)), ["fx = 2", "72x56", "expected 7 to 7200"]),
    "absurd principal point": (_edit(lambda d: d.update(fl_x=90.0, cx=5000.0)), ["principal point (5000", "72x56"]),
    "text as focal length": (_edit(lambda d: d.update(fl_x="90")), ["fl_x = '90'", "number"]),
    "a lens that folds": (_edit(lambda d: d.update(k1=-2.5)), ["r_000", "lens OPENCV (k1 = -2.5", "folds the 72x56 image"]),
    "no number as distortion": (_edit(lambda d: d.update(k1="0.1")), ["lens distortion k1 = '0.1'", "a number"]),
    "infinite distortion": (_edit(lambda d: d.update(p2=math.inf)), ["lens distortion p2 = inf", "finite"]),
    "a coefficient of two meanings": (
        _edit(lambda d: d.update(k4=0.1)),
        ["lens distortion k4 = 0.1", "expected 0 with camera_model OPENCV"],
    ),
    "a fisheye with tangential distortion": (
        _edit(lambda d: d.update(camera_model="OPENCV_FISHEYE", p1=0.1)),
        ["lens distortion p1 = 0.1", "expected 0 with camera_model OPENCV_FISHEYE"],
    ),
    "a panorama": (_edit(lambda d: d.update(camera_model="EQUIRECTANGULAR")), ["EQUIRECTANGULAR", "cut pinhole pictures out of it"]),
    "an unknown camera model": (_edit(lambda d: d.update(camera_model="VR180_L")), ["camera_model 'VR180_L'", "expected one of PINHOLE"]),
    "a camera model that is no name": (_edit(lambda d: d.update(camera_model=[5])), ["camera_model [5]", "expected one of PINHOLE"]),
    "path out of the folder": (_frame(1, file_path="../../etc/passwd"), ["leads outside"]),
    "absolute path": (_frame(1, file_path="/etc/passwd"), ["leads outside"]),
    "no file_path": (_edit(lambda d: d["frames"][3].pop("file_path")), ["frame 3", "file_path"]),
    "infinite width": (_edit(lambda d: d.update(w=math.inf, h=56)), ["w = inf", "finite"]),
    "no number as width": (_edit(lambda d: d.update(w=math.nan, h=56)), ["w = nan"]),
    "half a pixel": (_edit(lambda d: d.update(w=72.5, h=56)), ["w = 72.5", "whole number"]),
    "a focal length of 400 digits": (_edit(lambda d: d.update(fl_x=10**400)), ["fl_x = 1000", "..."]),
    "a width of 400 digits": (_edit(lambda d: d.update(w=10**400, h=56)), ["w = 1000", "..."]),
    "a pose of 400 digits": (_matrix(lambda m: m[0].__setitem__(3, 10**400)), ["r_002", "not a table of numbers"]),
    "a pose of the largest numbers": (_matrix(lambda m: m[0].__setitem__(0, 1e300)), ["r_002", "not rigid"]),
    "a camera far away": (_matrix(lambda m: m[0].__setitem__(3, 1e30)), ["r_002", "1e+30 units", "1e+09"]),
    "a number of 10 000 digits": (
        lambda folder: (folder / "transforms_train.json").write_text('{"frames": [' + "9" * 10_000 + "]}"),
        ["transforms_train.json", "not valid JSON"],
    ),
    "brackets without end": (
        lambda folder: (folder / "transforms_train.json").write_text("[" * 100_000 + "]" * 100_000),
        ["transforms_train.json", "brackets within brackets"],
    ),
    "a path of 5000 characters": (_frame(1, file_path="x" * 5000), ["frame 1", "5000 characters", "1000"]),
    "a name of 500 characters": (_frame(1, file_path="x" * 500), ["no such image"]),
    "half a character in a path": (_frame(1, file_path="./train/\ud800"), ["frame 1", "half a character"]),
    "a path with a NUL": (_frame(1, file_path="./train/a\0b"), ["frame 1", "file name"]),
    "a mask that is no name": (_frame(1, mask_path=5), ["mask_path = 5", "file name"]),
    "masks of other names": (
        lambda folder: (folder / "masks").mkdir() or Image.new("L", (72, 56)).save(folder / "masks" / "mask_7.png"),
        ["masks: none of its 1 pictures", "mask_7.png", "masks/train/r_000.png"],
    ),
    "one image without alpha": (
        lambda folder: Image.open(folder / "train" / "r_003.png").convert("RGB").save(folder / "train" / "r_003.png"),
        ["r_003.png", "neither alpha nor a mask", "1 of 24"],
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("fault", SYNTHETIC_FAULTS)
def test_a_faulty_synthetic_capture_is_refused_in_one_sentence(fault: str, tmp_path: Path) -> None:
    spoil, words = SYNTHETIC_FAULTS[fault]
    folder = tiny.write_nerf_synthetic(tmp_path)
    spoil(folder)
    with pytest.raises(ValueError) as refusal:
        load_views(folder)
    sentence = str(refusal.value)
    assert "\n" not in sentence
    for word in words:
        assert word in sentence, sentence


def test_a_refusal_keeps_its_advice_on_the_way_between_processes(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    (folder / "train" / "r_004.png").write_bytes(b"")
    with pytest.raises(CaptureFault, match="the file is empty") as refusal:
        load_views(folder)
    sent = pickle.loads(pickle.dumps(refusal.value))
    assert (str(sent), sent.advice, sent.pictures) == (str(refusal.value), refusal.value.advice, ("r_004",)) and "Copy it" in sent.advice


def test_folders_that_are_no_capture_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no such folder"):
        load_views(tmp_path / "nowhere")
    with pytest.raises(ValueError, match=r"not a capture, expected transforms_train\.json"):
        load_views(tmp_path)
    with pytest.raises(ValueError, match="no test views"):
        load_views(tiny.write_colmap(tmp_path / "colmap", binary=True), split="test")


COLMAP_4_MODELS = (
    ("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("SIMPLE_DIVISION", 4), ("DIVISION", 5), ("SIMPLE_FISHEYE", 3), ("FISHEYE", 4), ("EUCM", 6),
    ("EQUIRECTANGULAR", 2),
)  # fmt: skip
"""Numbers 11 to 17, with their parameter counts, as pycolmap 4.2.1 lists them."""


def _camera_file(folder: Path, *cameras: tuple[int, int]) -> None:
    """cameras.bin with cameras 6, 7, ... of these model numbers and parameter counts; the images are of camera 7."""
    rows = [struct.pack(f"<iiQQ{count}d", 6 + k, number, 64, 48, *[10.0] * count) for k, (number, count) in enumerate(cameras)]
    (folder / "sparse" / "0" / "cameras.bin").write_bytes(struct.pack("<Q", len(cameras)) + b"".join(rows))


@pytest.mark.parametrize(("number", "model"), list(enumerate(COLMAP_4_MODELS, start=11)))
def test_every_camera_model_of_colmap_4_is_called_by_its_name(number: int, model: tuple[str, int], tmp_path: Path) -> None:
    folder = tiny.write_colmap(tmp_path, binary=True)
    # A pinhole before and behind it: the parameters of each are skipped by their right count.
    _camera_file(folder, (1, 4), (number, model[1]), (1, 4))
    expected = (
        f"camera model {model[0]}, .*cut pinhole pictures out of it" if model[0] == "EQUIRECTANGULAR" else f"camera 7: lens {model[0]}"
    )
    if model[0] in ("SIMPLE_FISHEYE", "FISHEYE"):  # for which those numbers are a lens
        expected = "the image is 72x56, but its camera is for 64x48 pixels"
    with pytest.raises(ValueError, match=expected):
        load_views(folder)


def test_a_camera_that_no_image_has_may_be_a_panorama(tmp_path: Path) -> None:
    folder = tiny.write_colmap(tmp_path, binary=False)
    cameras = folder / "sparse" / "0" / "cameras.txt"
    cameras.write_text(cameras.read_text() + "8 EQUIRECTANGULAR 64 32 64 32\n")
    assert len(load_views(folder).cameras) == tiny.VIEWS


def test_a_colmap_camera_of_an_unknown_model_is_refused(tmp_path: Path) -> None:
    folder = tiny.write_colmap(tmp_path, binary=False)
    cameras = folder / "sparse" / "0" / "cameras.txt"
    cameras.write_text(cameras.read_text().replace("PINHOLE", "PIN"))
    with pytest.raises(ValueError, match=r"cameras\.txt: camera model 'PIN', expected one of SIMPLE_PINHOLE, "):
        load_views(folder)


def test_a_distorted_picture_must_have_the_size_of_its_lens(tmp_path: Path) -> None:
    folder = tiny.write_colmap(
        tmp_path, binary=True, lens=Lens("SIMPLE_RADIAL", (tiny.FX, tiny.CX, tiny.CY, -0.2), tiny.WIDTH, tiny.HEIGHT)
    )
    path = folder / "images" / "r_004.png"
    Image.open(path).resize((74, 57)).save(path)
    with pytest.raises(ValueError, match=r"r_004\.png: the image is 74x57, but its camera is for 72x56 pixels"):
        load_views(folder)


def test_a_camera_model_beyond_those_of_colmap_4_is_refused_with_what_to_do(tmp_path: Path) -> None:
    folder = tiny.write_colmap(tmp_path, binary=True)
    _camera_file(folder, (18, 4))
    with pytest.raises(ValueError, match=r"camera model number 18, expected 0 to 17, .* image_undistorter"):
        load_views(folder)


@pytest.mark.parametrize("file", ["cameras", "images", "points3D"])
def test_a_colmap_file_cut_short_is_refused(file: str, tmp_path: Path) -> None:
    folder = tiny.write_colmap(tmp_path, binary=True)
    path = folder / "sparse" / "0" / f"{file}.bin"
    path.write_bytes(path.read_bytes()[:-5])
    with pytest.raises(ValueError, match="cut short"):
        load_views(folder)


def test_a_colmap_image_that_is_missing_is_named(tmp_path: Path) -> None:
    folder = tiny.write_colmap(tmp_path, binary=False)
    (folder / "images" / "r_007.png").unlink()
    with pytest.raises(ValueError, match=r"images/r_007\.png: no such image"):
        load_views(folder)


def test_a_colmap_image_name_that_leads_out_of_the_folder_is_refused(tmp_path: Path) -> None:
    folder = tiny.write_colmap(tmp_path / "capture", binary=False)
    text = folder / "sparse" / "0" / "images.txt"
    text.write_text(text.read_text().replace("r_007.png", "../../outside.png"))
    Image.open(folder / "images" / "r_007.png").save(tmp_path / "outside.png")
    with pytest.raises(ValueError, match="leads outside"):
        load_views(folder)


def test_a_colmap_point_count_beyond_the_file_is_refused(tmp_path: Path) -> None:
    folder = tiny.write_colmap(tmp_path, binary=True)
    (folder / "sparse" / "0" / "points3D.bin").write_bytes(struct.pack("<Q", 2**60))
    with pytest.raises(ValueError, match="cut short"):
        load_views(folder)


def test_one_missing_mask_is_named_and_a_mask_of_another_size_too(tmp_path: Path) -> None:
    folder = tiny.write_colmap(tmp_path, binary=True)
    mask = folder / "masks" / "r_006.png.png"
    Image.open(mask).resize((20, 20)).save(mask)
    with pytest.raises(ValueError, match=r"r_006\.png\.png: the mask is 20x20, but its image r_006\.png is 72x56"):
        load_views(folder)
    mask.unlink()
    with pytest.raises(ValueError, match=r"r_006\.png: no such mask \(1 of 24"):
        load_views(folder)


def test_a_named_point_file_must_exist_inside_the_capture(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"sparse_pc\.ply: no such point file"):
        load_views(tiny.write_nerfstudio(tmp_path / "a", ply_file_path="sparse_pc.ply"))
    with pytest.raises(ValueError, match="leads outside"):
        load_views(tiny.write_nerfstudio(tmp_path / "b", ply_file_path="../sparse_pc.ply"))


class _Hostile:
    """Unpickling it would create a file."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple:
        return Path.touch, (self.target,)


def test_a_hostile_camera_pickle_is_refused_and_not_run(tmp_path: Path) -> None:
    folder = tiny.write_nero(tmp_path / "capture")
    target = tmp_path / "owned"
    (folder / "5-camera.pkl").write_bytes(pickle.dumps([_Hostile(target), None]))
    with pytest.raises(ValueError, match=r"5-camera\.pkl: not a NeRO camera.*refused to load pathlib"):
        load_views(folder)
    assert not target.exists()


def test_a_camera_pickle_of_another_shape_is_refused(tmp_path: Path) -> None:
    folder = tiny.write_nero(tmp_path)
    (folder / "3-camera.pkl").write_bytes(pickle.dumps([[[1.0, 2.0]], [[1.0]]]))
    with pytest.raises(ValueError, match=r"3-camera\.pkl: tables of shape"):
        load_views(folder)


def test_a_depth_picture_of_eight_bits_is_refused(tmp_path: Path) -> None:
    folder = tiny.write_nero(tmp_path)
    Image.new("L", (tiny.WIDTH, tiny.HEIGHT), 200).save(folder / "3-depth.png")
    with pytest.raises(ValueError, match=r"3-depth\.png: a depth picture of mode L, expected 16-bit grey"):
        load_views(folder)


def test_a_word_in_place_of_a_number_of_colmap_is_refused_by_file(tmp_path: Path) -> None:
    folder = tiny.write_colmap(tmp_path, binary=False)
    cameras = folder / "sparse" / "0" / "cameras.txt"
    cameras.write_text(cameras.read_text().replace(str(tiny.WIDTH), "wide"))
    with pytest.raises(ValueError, match=r"sparse/0: a COLMAP \.txt file is damaged .*'wide'"):
        load_views(folder)
