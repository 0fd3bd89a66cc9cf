"""Films with truth: the camera's path, the fit of similarities, and figures of builds that are right and wrong by known amounts; all without Mitsuba."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from benchmarks.measures.score_film import (
    Similarity,
    camera_figures,
    fit_similarity,
    frame_number,
    mask_figures,
    seen_by,
    surface_figures,
)
from benchmarks.reconstruct import film
from benchmarks.scenes.bench_scene import open_scene
from benchmarks.scenes.draw_film import (
    TABLES,
    FilmDrawing,
    Table,
    check_filmable,
    film_cameras,
    read_film_cameras,
    table_texture,
    write_cameras,
    write_film,
)
from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reconstruct.pose.video_frames import video_frames
from drgs.scene.camera import Camera, scaled_camera
from drgs.scene.lens import Lens
from drgs.scene.mesh import TriangleMesh
from tests.benchmarks.reconstruct.test_draw_scene_benchmark import small_scene
from tests.render.closed_form_scenes import sphere_mesh

ROTATION = rotation_from_quat_wxyz(torch.nn.functional.normalize(torch.tensor([0.3, 0.5, -0.2, 0.7], dtype=torch.float64), dim=0)).numpy()
FOUND_FROM_TRUE = Similarity(0.4, ROTATION, np.array([3.0, -1.0, 0.5]))
DRAWING = FilmDrawing("print", frames=24, samples=1, width=64, height=48)


@pytest.fixture(scope="module")
def ball() -> TriangleMesh:
    return sphere_mesh(subdivisions=4)


@pytest.fixture(scope="module")
def cameras(ball: TriangleMesh) -> list[Camera]:
    return film_cameras(ball, DRAWING)


def inverse(similarity: Similarity) -> Similarity:
    rotation = similarity.rotation.T
    return Similarity(1 / similarity.scale, rotation, -rotation @ similarity.translation / similarity.scale)


def moved_camera(camera: Camera, similarity: Similarity) -> Camera:
    """In the other world, with what it sees there in the same pixels."""
    turn = camera.camera_from_world[:3, :3].double() @ torch.from_numpy(similarity.rotation).T
    center = torch.from_numpy(similarity.points(camera.center_world.double().numpy()[None])[0])
    pose = torch.eye(4, dtype=torch.float64)
    pose[:3, :3], pose[:3, 3] = turn, -turn @ center
    return Camera(pose.float(), camera.intrinsics, camera.width, camera.height, camera.name)


def moved_mesh(mesh: TriangleMesh, similarity: Similarity) -> TriangleMesh:
    vertices = torch.from_numpy(similarity.points(mesh.vertices.double().numpy())).float()
    normals = mesh.normals @ torch.from_numpy(similarity.rotation).float().T
    return TriangleMesh(vertices, mesh.faces, normals, mesh.albedo, mesh.roughness, mesh.metallic)


def test_the_camera_goes_around_the_object_above_the_table_upright_and_sees_it_in_the_middle(cameras: list[Camera]):
    centers = np.array([camera.center_world.numpy() for camera in cameras])
    around = np.unwrap(np.arctan2(centers[:, 1], centers[:, 0]))
    assert around[-1] - around[0] > 2 * np.pi and (np.diff(around) > 0).all()
    assert np.linalg.norm(centers, axis=1).min() > 3.5 and centers[:, 2].min() > 0.5
    for camera in cameras:
        matrix = camera.camera_from_world
        assert matrix[1, 2] < -0.4 and abs(matrix[0, 2]) < 1e-6, "the picture's down is the world's, and its horizon is level"
        assert torch.linalg.det(matrix[:3, :3]) == pytest.approx(1, abs=1e-5)
        middle = camera.intrinsics @ matrix[:3, 3]
        assert (middle[:2] / middle[2] - torch.tensor([32.0, 24.0])).abs().max() < 4


def test_true_cameras_are_read_as_they_were_written(cameras: list[Camera], tmp_path: Path):
    (tmp_path / "truth").mkdir()
    write_cameras(cameras, tmp_path / "truth" / "transforms.json")
    read = read_film_cameras(tmp_path)
    assert [frame_number(camera) for camera in read] == list(range(24))
    for one, other in zip(read, cameras, strict=True):
        assert (one.camera_from_world - other.camera_from_world).abs().max() < 1e-5
        assert (one.intrinsics - other.intrinsics).abs().max() < 1e-4 and (one.width, one.height) == (64, 48)


@pytest.mark.parametrize("table", TABLES)
def test_tables_differ_and_are_the_same_each_time(table: Table):
    texture = table_texture(table, 64)
    assert texture.shape == (64, 64, 3) and 0 < texture.min() <= texture.max() < 1
    assert (texture == table_texture(table, 64)).all()
    assert (np.ptp(texture, (0, 1)).max() == 0) == (table == "plain")


def test_a_known_similarity_is_recovered():
    points = np.random.default_rng(0).standard_normal((20, 3))
    found = fit_similarity(points, FOUND_FROM_TRUE.points(points))
    assert found.scale == pytest.approx(0.4)
    assert np.allclose(found.rotation, ROTATION) and np.allclose(found.translation, FOUND_FROM_TRUE.translation)


def test_a_mirrored_set_is_not_matched_by_a_mirror():
    points = np.random.default_rng(0).standard_normal((20, 3))
    mirrored = points * [1, 1, -1]
    found = fit_similarity(points, mirrored)
    assert np.linalg.det(found.rotation) == pytest.approx(1)
    assert np.abs(found.points(points) - mirrored).max() > 0.5


def test_cameras_that_are_right_but_for_a_similarity_are_off_by_nothing_and_turned_ones_by_their_turn(cameras: list[Camera]):
    found = [moved_camera(camera, FOUND_FROM_TRUE) for camera in cameras]
    similarity, figures = camera_figures(found, cameras, np.zeros(3))
    assert similarity.scale == pytest.approx(2.5, rel=1e-4)
    assert figures["degrees_median"] < 1e-3 and figures["distance_percent_median"] < 1e-3
    angle = np.radians(0.7)
    roll = torch.eye(4)
    roll[:2, :2] = torch.tensor([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rolled = [Camera(roll @ camera.camera_from_world, camera.intrinsics, 64, 48, camera.name) for camera in found]
    assert camera_figures(rolled, cameras, np.zeros(3))[1]["degrees_median"] == pytest.approx(0.7, abs=1e-3)


def test_silhouettes_are_told_what_they_miss_and_have_too_much():
    true, found = np.zeros((10, 10), bool), np.zeros((10, 10), bool)
    true[2:6, :] = True
    found[3:8, :] = True
    figures = mask_figures([(found, true), (true, true)])
    assert figures["iou"] == pytest.approx((0.5 + 1) / 2) and figures["iou_least"] == 0.5
    assert figures["missed_percent"] == pytest.approx(12.5) and figures["extra_percent"] == pytest.approx(25)


def test_a_true_mesh_is_off_by_samples_spacing_and_a_grown_one_by_its_growth_until_icp_finds_it(ball: TriangleMesh, cameras: list[Camera]):
    back = inverse(FOUND_FROM_TRUE)
    exact = surface_figures(ball, moved_mesh(ball, FOUND_FROM_TRUE), back, cameras[::6], 10_000)
    assert max(exact["by_cameras"].values()) < 1.0
    grown = Similarity(FOUND_FROM_TRUE.scale * 1.05, ROTATION, FOUND_FROM_TRUE.translation)
    figures = surface_figures(ball, moved_mesh(ball, grown), back, cameras[::6], 10_000)
    assert figures["by_cameras"]["true_to_built"] == pytest.approx(5, abs=0.4)
    assert figures["refined"]["true_to_built"] < 1.5 and figures["refined_scale"] == pytest.approx(1 / 1.05, abs=0.01)


def test_what_lies_at_the_table_does_not_count_and_what_floats_does(ball: TriangleMesh, cameras: list[Camera]):
    def beside(height: float) -> TriangleMesh:
        corners = torch.tensor([[2.0, 0, height], [3.0, 0, height], [2.0, 1, height]])
        faces = torch.cat([ball.faces, torch.tensor([[0, 1, 2]], dtype=ball.faces.dtype) + len(ball.vertices)])
        more = [torch.cat([values, values[:3]]) for values in (ball.normals, ball.albedo, ball.roughness, ball.metallic)]
        return TriangleMesh(torch.cat([ball.vertices, corners]), faces, *more)

    still = Similarity(1.0, np.eye(3), np.zeros(3))
    floor = float(ball.vertices[:, 2].min())
    on_table, floating = (surface_figures(ball, beside(floor + lift), still, cameras[::6], 10_000)["by_cameras"] for lift in (0.01, 0.5))
    assert on_table["built_to_true"] < 1.0 < 3.0 < floating["built_to_true"]


def test_truth_is_looked_up_through_the_lens_that_the_build_found(cameras: list[Camera]):
    rows, columns = np.mgrid[:48, :64] + 0.5
    ramps = np.stack([columns, rows], -1)
    camera = scaled_camera(cameras[0], 0.5)
    focal = float(cameras[0].intrinsics[0, 0])
    straight = seen_by(camera, Lens("SIMPLE_RADIAL", (focal, 32.0, 24.0, 0.0), 64, 48), ramps)
    middles = np.stack(np.meshgrid(2 * np.arange(32) + 1.0, 2 * np.arange(24) + 1.0), -1)
    assert straight.shape == (24, 32, 2) and np.abs(straight - middles)[1:-1, 1:-1].max() < 1e-5
    bent = seen_by(camera, Lens("SIMPLE_RADIAL", (focal, 32.0, 24.0, -0.1), 64, 48), ramps)
    off = middles - [32, 24]
    expected = [32, 24] + off * (1 - 0.1 * np.square(off / focal).sum(-1, keepdims=True))
    assert np.abs(bent - expected)[1:-1, 1:-1].max() < 0.05


def test_a_films_frames_are_found_again(tmp_path: Path):
    paths = []
    for k in range(10):
        paths.append(tmp_path / f"{k}.png")
        Image.fromarray(np.full((48, 64, 3), 40 + 15 * k, np.uint8)).save(paths[-1])
    write_film(paths, DRAWING, tmp_path / "film.mp4")
    taken = video_frames(tmp_path / "film.mp4", tmp_path / "frames")
    assert taken is not None and [path.stem for path in taken.pictures] == [f"frame_{k:06d}" for k in range(10)]
    for k, path in enumerate(taken.pictures):
        assert np.asarray(Image.open(path)).mean() == pytest.approx(40 + 15 * k, abs=4)


def made_row(scene: str) -> dict:
    both = {"built_to_true": 1.25, "true_to_built": 1.5}
    figures = {
        "poses": {"given": 24, "placed": 23, "degrees_median": 0.25, "distance_percent_median": 0.5},
        "masks": {"iou": 0.9, "missed_percent": 4.0, "extra_percent": 6.0},
        "mesh": {"by_cameras": both, "refined": both},
        "views": {"psnr": 25.0},
    }
    asked = {"preset": "draft", "drawing": asdict(DRAWING)}
    return {"scene": scene, "table": "print", **asked, "build": {"seconds": 60.4, "cpu_seconds": 100.0}, "figures": figures}


def test_finished_rows_are_kept_and_others_of_the_same_name_refused(tmp_path: Path):
    scene = open_scene(small_scene(tmp_path / "ball"))
    (tmp_path / "rows.jsonl").write_text(json.dumps(made_row("ball")) + "\n")
    assert film.row(scene, DRAWING, tmp_path, "draft") == made_row("ball")
    with pytest.raises(ValueError, match="made otherwise"):
        film.row(scene, DRAWING, tmp_path, "fast")


def test_a_drawn_film_is_not_drawn_again_nor_taken_for_another(tmp_path: Path):
    scene, folder = open_scene(small_scene(tmp_path / "ball")), tmp_path / "film"
    folder.mkdir()
    (folder / "drawing.json").write_text(json.dumps({"scene": "ball"} | asdict(DRAWING)))
    assert film.drawn_film(scene, DRAWING, folder) == folder
    with pytest.raises(ValueError, match="was drawn by"):
        film.drawn_film(scene, FilmDrawing("wood"), folder)


def test_a_scene_without_known_matter_and_light_is_refused(tmp_path: Path):
    with pytest.raises(ValueError, match="no true materials or no known light"):
        check_filmable(open_scene(small_scene(tmp_path / "ball")))


def test_the_table_has_a_line_a_film_and_says_which_came_to_no_asset():
    lines = film.main_table([made_row("ball")], [{"scene": "urn", "table": "wood", "failed": "no poses"}]).splitlines()
    assert "| ball | print | draft | 23 of 24 |" in lines[2] and "1.25 / 1.50" in lines[2] and "| 60 | 100 |" in lines[2]
    assert lines[3].startswith("| urn | wood | – | no poses |")
