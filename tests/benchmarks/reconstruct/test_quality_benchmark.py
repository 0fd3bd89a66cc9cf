"""`quality` on a scene small enough to know: a painted sphere, its mesh and maps, and an asset that is the same sphere a little too small."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from benchmarks.measures.measure_asset import PARTS, QualitySettings, evenly, measure_asset
from benchmarks.reconstruct.quality import main, spread
from benchmarks.scenes.bench_scene import open_scene
from benchmarks.scenes.split_capture import EVERY, split_capture
from drgs.reconstruct.capture.load_views import load_cameras, load_views
from drgs.scene.asset import Asset, load_asset, save_asset
from tests.reconstruct.tiny_capture import SPHERE_CENTER, SPHERE_RADIUS, TinyView, sphere_views, write_nerf_synthetic, write_nerfstudio
from tests.render.closed_form_scenes import constant_sky, mesh_of

TEST_VIEWS = 3


def sphere_shape(radius: float) -> trimesh.Trimesh:
    shape = trimesh.creation.icosphere(4, radius)
    shape.apply_translation(SPHERE_CENTER)
    return shape


def write_aov(path: Path, view: TinyView) -> None:
    """Albedo and normal from the paint, the depth of the sphere's middle: enough to tell regions."""
    inside = view.rgba[..., 3] > 0
    normal = np.where(inside[..., None], (view.rgba[..., :3] / 255 - 0.5) / 0.4, 0)
    depth = float((view.camera_from_world @ [*SPHERE_CENTER, 1])[2]) - SPHERE_RADIUS
    channels = [np.full((*inside.shape, 3), 0.5), normal, np.full((*inside.shape, 1), depth), np.full((*inside.shape, 1), 0.5)]
    aov = np.concatenate([*channels, np.zeros((*inside.shape, 1)), inside[..., None]], -1).astype(np.float16)
    np.savez_compressed(path, aov=aov)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Training views, three test views with maps, and the true mesh; no lights, no materials."""
    folder = write_nerf_synthetic(tmp_path_factory.mktemp("scene"), sphere_views(12, square=True))
    train = json.loads((folder / "transforms_train.json").read_text())
    (folder / "test").mkdir()
    frames = []
    for view in sphere_views(TEST_VIEWS, square=True):
        Image.fromarray(view.rgba).save(folder / "test" / f"{view.name}.png")
        write_aov(folder / "test" / f"{view.name}_aov.npz", view)
        frames.append({"file_path": f"./test/{view.name}", "transform_matrix": view.world_from_opengl.tolist()})
    (folder / "transforms_test.json").write_text(json.dumps(train | {"frames": frames}))
    sphere_shape(SPHERE_RADIUS).export(folder / "gt_mesh.ply")
    return folder


@pytest.fixture(scope="module")
def asset_path(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("asset") / "sphere"
    save_asset(Asset(None, mesh_of(sphere_shape(0.98 * SPHERE_RADIUS), 0.5, 0.6, 0.0), None, constant_sky(0.5)), path)
    return path


@pytest.mark.slow
def test_the_document_holds_each_part_or_why_it_is_left_out(
    scene: Path, asset_path: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    main([str(scene), "--asset", str(asset_path), "--spp", "4", "--views", "2", "--mesh-samples", "4000", "--out", str(tmp_path), "--json"])
    told = capsys.readouterr()
    document = json.loads(told.out)
    assert set(document["left_out"]) == {"primary", "light", "swaps"} and "true light" in document["left_out"]["light"]
    assert set(document["seconds"]) == set(PARTS)
    assert document["mesh"]["offset_median"] == pytest.approx(-2, abs=0.2) and document["mesh"]["components"] == 1
    pixels = 90 / 3 * 0.02 * SPHERE_RADIUS  # some 0.3: two percent of the radius seen at distance 3
    assert document["outlines"]["mesh"]["signed_pixels"] == pytest.approx(-pixels, abs=0.15) and "gaussians" not in document["outlines"]
    assert sum(row["error_share"] for row in document["regions"].values()) == pytest.approx(1)
    assert document["figures"]["views"]["images"] == TEST_VIEWS and document["figures"]["seconds"]["test"] > 0
    assert "mesh.offset_median" in told.err


def test_pictures_are_used_again_for_the_same_asset_only(scene: Path, asset_path: Path, tmp_path: Path) -> None:
    settings = QualitySettings(("figures",), samples_per_pixel=2)
    asset = load_asset(asset_path)
    first = measure_asset(open_scene(scene), asset, tmp_path, settings)
    picture = tmp_path / "renders" / "test" / "r_000.png"
    made = picture.stat().st_mtime_ns
    assert measure_asset(open_scene(scene), asset, tmp_path, settings)["figures"] == first["figures"]
    assert picture.stat().st_mtime_ns == made
    darker = Asset(None, mesh_of(sphere_shape(SPHERE_RADIUS), 0.1, 0.6, 0.0), None, constant_sky(0.5))
    second = measure_asset(open_scene(scene), darker, tmp_path, settings)
    assert second["figures"]["views"]["psnr"] != first["figures"]["views"]["psnr"]
    assert picture.stat().st_mtime_ns > made


def test_a_folder_without_test_views_or_one_camera_file_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="0 transforms"):
        main([str(tmp_path), "--preset", "draft"])
    with pytest.raises(ValueError, match="expected one of them"):
        main([str(tmp_path), "--asset", "a", "--seeds", "2"])


def test_every_eighth_photograph_is_held_out(tmp_path: Path) -> None:
    source = write_nerfstudio(tmp_path / "mug")
    (source / "transforms.json").rename(source / "transforms_masked.json")
    folder = split_capture(source, tmp_path / "split", side=36)
    train, test = load_views(folder), load_cameras(folder / "transforms_test.json")
    assert (len(train.cameras), len(test)) == (21, 3) and train.has_masks
    assert not {camera.name for camera in test} & {camera.name for camera in train.cameras}
    assert [camera.name for camera in test] == [f"r_{index:03d}" for index in range(0, 24, EVERY)]
    scene = open_scene(folder)
    assert (scene.name, scene.training_light, scene.new_lights) == ("mug", None, ())
    (first, *_) = scene.cameras
    assert (first.width, first.height) == (36, 28) and float(first.intrinsics[0, 0]) == pytest.approx(45)
    whole = sphere_views()[0]
    assert torch.allclose(first.camera_from_world.double(), torch.tensor(whole.camera_from_world), atol=1e-5)
    with Image.open(folder / "test" / "r_000.png") as picture:
        alpha = np.asarray(picture)[..., 3] / 255
    assert alpha.sum() == pytest.approx(whole.rgba[..., 3].sum() / 255 / 4, rel=0.02)
    stamp = (folder / "scene.json").stat().st_mtime_ns
    assert split_capture(source, folder, side=36) == folder and (folder / "scene.json").stat().st_mtime_ns == stamp
    assert split_capture(source, folder, side=72) == folder and open_scene(folder).cameras[0].width == 72


def test_a_split_needs_masks(tmp_path: Path) -> None:
    source = write_nerfstudio(tmp_path / "mug")
    document = json.loads((source / "transforms.json").read_text())
    for frame in document["frames"]:
        del frame["mask_path"]
    (source / "transforms.json").write_text(json.dumps(document))
    with pytest.raises(ValueError, match="no masks"):
        split_capture(source, tmp_path / "split", side=36)


def test_spread_is_of_what_all_runs_have() -> None:
    runs = [{"views": {"psnr": 30.0, "images": 3}, "scene": "a"}, {"views": {"psnr": 31.0, "images": 3}, "light": {"psnr": 9.0}}]
    assert spread(runs) == {"views.psnr": {"mean": 30.5, "least": 30.0, "most": 31.0}}


def test_few_views_are_spread_over_all() -> None:
    assert evenly(tuple(range(12)), 4) == (0, 4, 7, 11) and evenly((1, 2), 4) == (1, 2)
