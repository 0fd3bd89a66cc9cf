"""Curves of costs have the exponents of what they are made of, and each is measured once at tiny sizes."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

import benchmarks.scale.builds as builds_module
from benchmarks.builds.build_process import BuildRun
from benchmarks.scale.assets import assets_on_server
from benchmarks.scale.builds import write_shrunk, write_views
from benchmarks.scale.command import CURVES, main, measure
from benchmarks.scale.cost_curve import CostCurve, Point, log_log_slope, table_lines, write_plot
from benchmarks.scale.edits import edits_on_server
from benchmarks.scale.made_objects import bumpy_ball
from benchmarks.scale.own_server import own_server
from benchmarks.scale.scale_run import ScaleRun, ScaleSizes

TINY = ScaleSizes(
    pixels=(8, 12, 16),
    faces=(12, 48, 108),
    surfels=(20, 40, 80),
    samples=(4, 8, 16),
    edits=(1, 2, 4),
    assets=(1, 2, 3),
    object_faces=108,
    faces_side=16,
    samples_side=8,
    asset_faces=108,
    moving_frames=1,
    edits_measured=1,
)


def curve_of(costs: list[float | None]) -> CostCurve:
    points: list[Point] = [{"x": 10.0**k, "seconds": cost} for k, cost in enumerate(costs)]
    return CostCurve("made", "made-up size", points)


def test_exponents_of_a_power_are_that_power():
    document = curve_of([3 * 10 ** (1.5 * k) for k in range(4)]).document()
    assert (document["exponent"], document["last_exponent"]) == (1.5, 1.5)
    assert set(document) == {"x", "points", "exponent", "last_exponent", "exponents"} and len(document["points"]) == 4


def test_a_constant_share_flattens_the_whole_more_than_its_end():
    over_all, last = curve_of([1 + 0.1 * 10**k for k in range(4)]).exponents("seconds")
    assert over_all is not None and last is not None and 0 < over_all < last < 1


def test_least_squares_of_three_points_is_the_textbook_slope():
    assert log_log_slope([(1, 1), (math.e, math.e), (math.e**2, 1)]) == 0
    assert log_log_slope([(1, 1), (math.e, 1), (math.e**2, math.exp(3))]) == 1.5


@pytest.mark.parametrize("points", [[], [(1, 1)], [(2, 1), (2, 3)], [(1, 1), (2, None)], [(1, 1), (2, -1)]])
def test_what_has_no_slope_has_none(points: list[tuple[float, float | None]]):
    assert log_log_slope(points) is None


def test_a_table_says_whether_costs_grow_faster_than_their_size():
    assert table_lines(curve_of([1, 10, 100]))[-1].endswith("(no faster than linearly)")
    assert table_lines(curve_of([1, 10, 200]))[-1].endswith("(faster than linearly)")
    assert "–" in table_lines(curve_of([1, None, 100]))[-1]


def test_a_plot_leaves_out_what_a_logarithm_cannot_show(tmp_path: Path):
    write_plot(curve_of([1, None, 100]), tmp_path / "plots")
    assert (tmp_path / "plots" / "scale_made.svg").read_text().count("<circle") == 2
    write_plot(CostCurve("none", "size", [{"x": 1, "seconds": 0.0}]), tmp_path)
    assert not (tmp_path / "scale_none.svg").exists()


@pytest.mark.parametrize("asked", [12, 100, 1000])
def test_the_made_object_is_closed_and_faces_outwards(asked: int):
    mesh = bumpy_ball(asked, torch.device("cpu")).mesh
    assert abs(math.sqrt(len(mesh.faces) / 12) - math.sqrt(asked / 12)) <= 0.5 and len(mesh.vertices) == len(mesh.faces) // 2 + 2
    corners = mesh.vertices[mesh.faces.long()].double()
    volume = torch.linalg.det(corners).sum() / 6
    assert 0.2 * volume.sign() < volume < 1.8 * 4 / 3 * math.pi
    edges = {tuple(edge) for face in mesh.faces.tolist() for edge in zip(face, face[1:] + face[:1], strict=True)}
    assert all((b, a) in edges for a, b in edges)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pixels", "faces", "surfels", "samples"])
def test_pictures_are_measured_at_each_size(name: str, tmp_path: Path):
    (curve,) = measure(ScaleRun(tmp_path, TINY, repeats=1), [name])
    assert curve.name == name and [point["x"] for point in curve.points] == sorted({point["x"] for point in curve.points})
    assert len(curve.points) == 3 and all(point[cost] > 0 for point in curve.points for cost in curve.costs)
    assert curve.document()["exponent"] is not None and all(point["cpu_seconds"] is not None for point in curve.points)


@pytest.mark.slow
def test_a_server_is_measured_with_more_and_more_edits_and_assets(tmp_path: Path):
    run = ScaleRun(tmp_path, TINY, repeats=1)
    with own_server(tmp_path / "served") as served:  # one for both: to start one takes longer than to ask it
        changes, memory = edits_on_server(run, *served), assets_on_server(run, *served)
    assert [point["x"] for point in changes.points] == [1, 2, 4] and [point["x"] for point in memory.points] == [1, 2, 3]
    assert all(0 < point["accepted_seconds"] <= point["seconds"] and point["message_bytes"] > 0 for point in changes.points)
    assert all({"asset_mib", "memory_mib", "grown_mib", "mib_per_mib"} <= set(point) for point in memory.points)
    assert memory.points[0]["asset_mib"] < memory.points[2]["asset_mib"] < memory.points[0]["memory_mib"]
    assert not served[0].is_running()


@pytest.mark.slow
def test_one_document_is_printed_and_one_plot_a_curve_written(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    main(["--only", "surfels", "--sizes", "10", "20", "--repeats", "1", "--device", "cpu", "--plots", str(tmp_path), "--json"])
    document = json.loads(capsys.readouterr().out)
    assert [point["x"] for point in document["curves"]["surfels"]["points"]] == [10, 20]
    assert [path.name for path in tmp_path.iterdir()] == ["scale_surfels.svg"]


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Four photographs of 8 x 4 pixels, half covered."""
    folder = tmp_path / "scene"
    (folder / "train").mkdir(parents=True)
    for number in range(4):
        pixels = np.zeros((4, 8, 4), np.uint8)
        pixels[:, :4] = (50 * number, 100, 200, 255)
        Image.fromarray(pixels).save(folder / "train" / f"r_{number}.png")
    frames = [{"file_path": f"./train/r_{number}", "transform_matrix": np.eye(4).tolist()} for number in range(4)]
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": 0.6, "w": 8, "h": 4, "frames": frames}))
    return folder


def test_builds_are_measured_against_photographs_and_their_pixels(scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    built: list[tuple[int, tuple[int, int]]] = []

    def look_at_capture(command: list[str]) -> BuildRun:
        capture = Path(command[3])
        frames = json.loads((capture / "transforms_train.json").read_text())["frames"]
        sizes = {Image.open(capture / f"{frame['file_path']}.png").size for frame in frames}
        built.append((len(frames), *sizes))
        return BuildRun(2.0 * len(frames), 3.0, {}, 100)

    monkeypatch.setattr(builds_module, "run_build", look_at_capture)
    run = ScaleRun(tmp_path, replace(TINY, builds=(1, 2, 4), builds_pixels=(2, 4, 8)), scene=scene)
    views, pixels = measure(run, ["builds", "builds_pixels"])
    assert built == [(1, (8, 4)), (2, (8, 4)), (4, (8, 4)), (4, (2, 1)), (4, (4, 2)), (4, (8, 4))]
    assert views.document()["exponent"] == 1 and pixels.document()["exponent"] == 0
    assert [point["x"] for point in pixels.points] == [4, 16, 64] and views.points[0]["memory_mib"] == 100
    assert sorted(path.name for path in tmp_path.iterdir()) == ["scene"]


def test_a_scene_with_too_few_or_too_small_photographs_is_refused(scene: Path, tmp_path: Path):
    with pytest.raises(ValueError, match="has 4 photographs"):
        write_views(scene, tmp_path / "more", 5)
    with pytest.raises(ValueError, match="photograph of 8 pixels"):
        write_shrunk(scene, tmp_path / "larger", 16)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--sizes", "1", "2"], "one curve"),
        (["--only", "samples", "--sizes", "8", "4"], "each larger"),
        (["--repeats", "0"], "at least 1"),
        (["--only", "builds"], "need --scene"),
    ],
)
def test_wrong_arguments_are_refused_with_what_was_expected(arguments: list[str], words: str):
    with pytest.raises(ValueError, match=words):
        main(arguments)


def test_each_curve_has_sizes_of_its_name():
    assert set(CURVES) <= set(vars(ScaleSizes()))
