"""A drawn capture: what the build reads is there, and the maps are of the matter that was asked for."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from benchmarks.reconstruct import draw_scene
from benchmarks.scenes.embossed_urn import BEAD, embossed_urn
from benchmarks.scenes.hollow_things import MUG_HEIGHT, WALL, mug, plant
from benchmarks.scenes.made_things import bricks, chair
from benchmarks.scenes.thin_panels import FIRST, PITCH, THICKNESSES, panels
from drgs.evaluate.metrics import score_renders
from drgs.exchange.exr import encode_environment
from drgs.reconstruct.capture.load_views import load_cameras, load_views
from drgs.render.intersect.trace_rays import build_tracer, trace_rays
from drgs.scene.mesh import TriangleMesh
from tests.render.closed_form_scenes import sphere_mesh


def small_scene(folder: Path) -> Path:
    """A ball, seen by three cameras at one place."""
    folder.mkdir()
    ball = sphere_mesh(subdivisions=2)
    trimesh.Trimesh(ball.vertices.numpy(), ball.faces.numpy(), process=False).export(folder / "gt_mesh.ply")
    pose = np.eye(4)
    pose[2, 3] = 4
    frames = [{"file_path": f"./SET/r_00{k}", "transform_matrix": pose.tolist()} for k in range(3)]
    for name in ("train", "test"):
        text = json.dumps({"camera_angle_x": 0.55, "w": 16, "h": 16, "frames": frames})
        (folder / f"transforms_{name}.json").write_text(text.replace("SET", name))
    for name, radiance in (("lamp", 0.5), ("sky", 1.0)):
        (folder / f"{name}.exr").write_bytes(encode_environment(np.full((8, 16, 3), radiance, np.float32)))
    return folder


def test_the_capture_is_one_that_builds_read_and_scores_are_made_of(tmp_path: Path):
    scene = small_scene(tmp_path / "scene")
    chosen = ["--matter", "chrome", "--light", str(scene / "lamp.exr"), "--new-light", str(scene / "sky.exr"), "--spp", "8"]
    draw_scene.main([str(scene), str(tmp_path / "out"), *chosen])
    views = load_views(tmp_path / "out", 64)
    assert len(views.cameras) == 3 and views.has_masks
    with np.load(tmp_path / "out" / "test" / "r_000_aov.npz") as stored:
        inside = stored["aov"][..., 9] > 0.5
        assert inside.any() and not inside.all()
        assert stored["aov"][inside][:, 8].min() == 1.0 and stored["aov"][inside][:, 7] == pytest.approx(0.12, abs=1e-3)
    # Chrome under even light is as bright as its albedo says.
    seen = np.asarray(Image.open(tmp_path / "out" / "relight" / "sky" / "r_000.png").convert("RGB"), np.float64)[inside] / 255
    assert seen[:, 0].mean() == pytest.approx(0.93, abs=0.03)
    figures = score_renders(tmp_path / "out", tmp_path / "out")
    assert figures["views"]["psnr"] > 90
    with pytest.raises(ValueError, match="is there already"):
        draw_scene.main([str(scene), str(tmp_path / "out"), *chosen])


def seen_from_two_sides(folder: Path) -> Path:
    """A fine ball under a lamp, photographed from the side and from behind."""
    scene = small_scene(folder)
    ball = sphere_mesh(subdivisions=4)
    trimesh.Trimesh(ball.vertices.numpy(), ball.faces.numpy(), process=False).export(scene / "gt_mesh.ply")
    side, behind = np.eye(4), np.eye(4)
    side[:3, :3], side[:3, 3] = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]]), (4, 0, 0)
    behind[:3, :3], behind[:3, 3] = np.diag([-1, 1, -1]), (0, 0, -4)
    frames = [{"file_path": f"./SET/r_00{k}", "transform_matrix": pose.tolist()} for k, pose in enumerate((side, behind))]
    for name in ("train", "test"):
        text = json.dumps({"camera_angle_x": 0.55, "frames": frames})
        (scene / f"transforms_{name}.json").write_text(text.replace("SET", name))
    radiance = np.full((8, 16, 3), 0.1, np.float32)
    radiance[2:4, 3:6] = 4
    (scene / "lamp.exr").write_bytes(encode_environment(radiance))
    return scene


def test_light_that_turns_shows_a_ball_the_same_from_all_sides_and_light_that_stands_still_does_not(tmp_path: Path):
    scene = seen_from_two_sides(tmp_path / "scene")
    chosen = ["--matter", "gold", "--light", str(scene / "lamp.exr"), "--new-light", str(scene / "sky.exr"), "--spp", "64", "--side", "24"]
    differences = []
    for name, more in (("turned", ["--turned"]), ("still", [])):
        draw_scene.main([str(scene), str(tmp_path / name), *chosen, *more])
        shown = [np.asarray(Image.open(tmp_path / name / "train" / f"r_00{k}.png"), np.float64) for k in range(2)]
        solid = (shown[0][..., 3] == 255) & (shown[1][..., 3] == 255)
        differences.append(np.abs(shown[0][solid][:, :3] - shown[1][solid][:, :3]).mean() / 255)
    assert differences[0] < 0.02 and differences[1] > 0.1, differences
    # Upright before the first photograph's camera: that one shows the same either way.
    first = [np.asarray(Image.open(tmp_path / name / "train" / "r_000.png"), np.float64)[..., :3] for name in ("turned", "still")]
    assert np.abs(first[0] - first[1])[solid].mean() / 255 < 0.02
    cameras = load_cameras(tmp_path / "turned" / "transforms_train.json")
    assert {(camera.width, camera.height) for camera in cameras} == {(24, 24)}


def test_one_view_in_so_many_is_drawn(tmp_path: Path):
    scene = small_scene(tmp_path / "scene")
    chosen = ["--light", str(scene / "lamp.exr"), "--new-light", str(scene / "sky.exr"), "--spp", "2", "--every", "2"]
    draw_scene.main([str(scene), str(tmp_path / "out"), *chosen])
    assert sorted(path.name for path in (tmp_path / "out" / "train").iterdir()) == ["r_000.png", "r_002.png"]
    assert [camera.name for camera in load_cameras(tmp_path / "out" / "transforms_train.json")] == ["r_000", "r_002"]
    given, drawn = (json.loads((folder / "transforms_train.json").read_text())["frames"] for folder in (scene, tmp_path / "out"))
    assert drawn == given[::2], "poses are those of the scene, digit by digit"


def test_cameras_above_stand_in_a_ring_look_at_the_middle_and_show_it_there(tmp_path: Path):
    scene = small_scene(tmp_path / "scene")
    chosen = ["--light", str(scene / "lamp.exr"), "--new-light", str(scene / "sky.exr"), "--spp", "2", "--above"]
    draw_scene.main([str(scene), str(tmp_path / "out"), *chosen])
    heights = []
    for name in ("train", "test"):
        for camera in load_cameras(tmp_path / "out" / f"transforms_{name}.json"):
            eye = camera.center_world.double().numpy()
            assert np.linalg.norm(eye) == pytest.approx(4, abs=1e-4)
            np.testing.assert_allclose(camera.camera_from_world[:3, 3].numpy(), [0, 0, 4], atol=1e-4)  # the middle, before it
            heights.append(float(np.degrees(np.arcsin(eye[2] / 4))))
            with Image.open(tmp_path / "out" / name / f"{Path(camera.name).name}.png") as picture:
                row, column = np.nonzero(np.asarray(picture)[..., 3] > 127)
            assert (row.mean(), column.mean()) == (pytest.approx(7.5, abs=0.5), pytest.approx(7.5, abs=0.5))
    steps = np.linspace(draw_scene.ABOVE_FROM, draw_scene.ABOVE_TO, 7)[:6]
    np.testing.assert_allclose(np.sort(heights), steps, atol=0.01)  # test views from between the photographs


def test_the_urn_is_closed_looks_outward_and_carries_its_relief():
    urn = embossed_urn(around=144, up=121)
    assert urn.is_watertight and urn.volume > 0.8
    assert np.linalg.norm(urn.vertices, axis=1).max() < 1
    middle = urn.vertices[np.abs(urn.vertices[:, 2] + 0.15) < 0.005]  # a row of beads
    radii = np.linalg.norm(middle[:, :2], axis=1)
    assert 0.5 * BEAD < radii.max() - radii.min() < 1.5 * BEAD


@pytest.mark.parametrize(("shape", "most"), [(mug, 0.4), (plant, 0.4), (chair, 0.15), (bricks, 0.7), (panels, 0.4)])
def test_drawn_things_are_closed_look_outward_and_are_partly_empty(shape: Callable[[int], TriangleMesh], most: float):
    mesh = shape(130)
    solid = trimesh.Trimesh(mesh.vertices.numpy(), mesh.faces.numpy())
    assert solid.is_watertight and np.linalg.norm(solid.vertices, axis=1).max() < 1.2
    assert 0.01 < solid.volume < most * solid.convex_hull.volume
    assert float(mesh.albedo.min()) > 0 and float(mesh.albedo.max()) < 1


def test_one_looks_down_to_the_floor_of_the_mug():
    mesh = mug(90)
    tracer = build_tracer(mesh)
    below = trace_rays(torch.tensor([[0.1, 0.05, 1.0]]), torch.tensor([[0.0, 0.0, -1.0]]), tracer)
    assert 1 - float(below.distance) == pytest.approx(WALL - MUG_HEIGHT / 2, abs=0.01)
    assert float(mesh.metallic[mesh.vertices[:, 2] > 0.51].min()) == 1 and float(mesh.metallic[mesh.vertices[:, 2] < 0.49].max()) == 0


def test_panels_are_as_thin_as_they_are_called():
    tracer = build_tracer(panels())
    beside = torch.tensor([[FIRST + k * PITCH - 0.1, -0.3, -0.3] for k in range(len(THICKNESSES))])
    along = torch.tensor([[1.0, 0.0, 0.0]]).expand(len(beside), 3)
    near, far = trace_rays(beside, along, tracer), trace_rays(beside + 0.2 * along, -along, tracer)
    np.testing.assert_allclose(0.2 - near.distance - far.distance, THICKNESSES, atol=0.001)


def test_a_shape_takes_the_place_of_the_scenes_mesh(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    scene = small_scene(tmp_path / "scene")
    (scene / "gt_mesh.ply").unlink()
    monkeypatch.setattr(draw_scene, "embossed_urn", lambda: embossed_urn(around=48, up=40))
    chosen = ["--matter", "gold", "--shape", "urn", "--light", str(scene / "lamp.exr"), "--new-light", str(scene / "sky.exr"), "--spp", "2"]
    draw_scene.main([str(scene), str(tmp_path / "out"), *chosen])
    assert trimesh.load(tmp_path / "out" / "gt_mesh.ply").bounds[:, 2] == pytest.approx([-0.75, 0.75], abs=0.01)
    with np.load(tmp_path / "out" / "test" / "r_000_aov.npz") as stored:
        assert stored["aov"][..., :3].max(axis=(0, 1)) == pytest.approx([0.9, 0.64, 0.28], abs=1e-3)
