"""Captures that are fine: every layout yields the same cameras, pictures and masks."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image

from drgs.reconstruct.capture.load_views import load_cameras, load_views
from drgs.reconstruct.capture.load_views.read_pictures import shrink
from drgs.scene.camera import pixel_rays_world
from drgs.scene.lens import PARAMETER_NAMES, Lens
from tests.reconstruct import tiny_capture as tiny

LAYOUTS = {
    "nerf-synthetic": tiny.write_nerf_synthetic,
    "nerfstudio": tiny.write_nerfstudio,
    "colmap-bin": lambda folder: tiny.write_colmap(folder, binary=True),
    "colmap-txt": lambda folder: tiny.write_colmap(folder, binary=False),
    "nero": tiny.write_nero,
}


@pytest.mark.slow
@pytest.mark.parametrize("layout", LAYOUTS)
def test_rays_of_every_layout_hit_the_sphere_exactly_where_its_mask_is(layout: str, tmp_path: Path) -> None:
    views = load_views(LAYOUTS[layout](tmp_path / "capture"))
    assert views.source == layout.removesuffix("-bin").removesuffix("-txt")
    assert views.has_masks
    assert len(views.cameras) == (tiny.VIEWS - tiny.VIEWS // 8 if layout == "nero" else tiny.VIEWS)
    wrong = 0
    for camera, coverage in zip(views.cameras, views.coverage, strict=True):
        origin, directions = pixel_rays_world(camera)
        hit = ~np.isnan(tiny.hits_sphere(origin.double().numpy(), directions.double().numpy()))
        wrong += int((hit != (coverage.numpy() == 255)).sum())
    # float32 poses may turn a pixel at the rim.
    assert wrong <= 2


INTRINSICS = (tiny.FX, tiny.FY, tiny.CX, tiny.CY)
BENT: dict[str, tuple[Lens, Callable[[Path, Lens], Path]]] = {
    "colmap, barrel": (
        Lens("OPENCV", (*INTRINSICS, -0.3, 0.05, 0.01, -0.02), tiny.WIDTH, tiny.HEIGHT),
        lambda folder, lens: tiny.write_colmap(folder, binary=True, lens=lens),
    ),
    "colmap, pincushion": (
        Lens("SIMPLE_DIVISION", (tiny.FX, tiny.CX, tiny.CY, 0.3), tiny.WIDTH, tiny.HEIGHT),
        lambda folder, lens: tiny.write_colmap(folder, binary=False, lens=lens),
    ),
    "nerfstudio, three radial coefficients": (
        Lens("FULL_OPENCV", (*INTRINSICS, -0.2, 0.1, 0.01, 0.02, 0.3, 0.0, 0.0, 0.0), tiny.WIDTH, tiny.HEIGHT),
        lambda folder, lens: tiny.write_nerfstudio(folder, tiny.sphere_views(lens=lens), k1=-0.2, k2=0.1, p1=0.01, p2=0.02, k3=0.3),
    ),
    "nerfstudio, fisheye": (
        Lens("OPENCV_FISHEYE", (*INTRINSICS, 0.1, -0.2, 0.3, 0.1), tiny.WIDTH, tiny.HEIGHT),
        lambda folder, lens: tiny.write_nerfstudio(
            folder, tiny.sphere_views(lens=lens), k1=0.1, k2=-0.2, k3=0.3, k4=0.1, camera_model="OPENCV_FISHEYE"
        ),
    ),
    "instant-ngp": (
        Lens("OPENCV", (*INTRINSICS, -0.2, 0.0, 0.0, 0.0), tiny.WIDTH, tiny.HEIGHT),
        lambda folder, lens: tiny.write_nerf_synthetic(
            folder, tiny.sphere_views(lens=lens), k1=-0.2, **dict(zip(("fl_x", "fl_y", "cx", "cy"), INTRINSICS, strict=True))
        ),
    ),
    "instant-ngp, fisheye": (
        Lens("OPENCV_FISHEYE", (*INTRINSICS, 0.1, 0.0, 0.0, 0.0), tiny.WIDTH, tiny.HEIGHT),
        lambda folder, lens: tiny.write_nerf_synthetic(
            folder,
            tiny.sphere_views(lens=lens),
            k1=0.1,
            is_fisheye=True,
            **dict(zip(("fl_x", "fl_y", "cx", "cy"), INTRINSICS, strict=True)),
        ),
    ),
}
"""Captures taken through a lens, and that lens."""


@pytest.mark.parametrize("name", BENT)
def test_rays_of_undistorted_views_hit_the_sphere_where_its_mask_is(name: str, tmp_path: Path) -> None:
    lens, write = BENT[name]
    views = load_views(write(tmp_path, lens))
    assert views.lenses == (lens,) * tiny.VIEWS
    wrong = edge = 0
    for camera, coverage, image in zip(views.cameras, views.coverage, views.images_srgb, strict=True):
        origin, directions = pixel_rays_world(camera)
        distance = tiny.hits_sphere(origin.double().numpy(), directions.double().numpy())
        hit, mask = ~np.isnan(distance), coverage.numpy()
        sure = (mask == 0) | (mask == 255)
        wrong += int((hit != (mask == 255))[sure].sum())
        edge += int((~sure).sum())
        place = origin.numpy() + np.nan_to_num(distance)[..., None] * directions.numpy()
        painted = tiny.color_of_normal(np.clip((place - tiny.SPHERE_CENTER) / tiny.SPHERE_RADIUS, -1, 1)).astype(int)
        inside = hit & (mask == 255)
        assert np.abs(image.numpy()[inside] - painted[inside]).mean() < 1.5
    # Pixels that one of two neighbours says: the mask was painted in whole pixels.
    assert wrong <= 0.02 * edge


def test_what_was_undistorted_is_shrunk_as_any_other_picture(tmp_path: Path) -> None:
    lens, write = BENT["colmap, barrel"]
    folder = write(tmp_path, lens)
    large, small = load_views(folder), load_views(folder, max_side=32)
    assert max(small.images_srgb[0].shape[:2]) == 32
    camera, other = large.cameras[0], small.cameras[0]
    sides = torch.tensor([[other.width / camera.width], [other.height / camera.height], [1.0]])
    torch.testing.assert_close(other.intrinsics, sides * camera.intrinsics)
    torch.testing.assert_close(small.coverage[0].float().mean(), large.coverage[0].float().mean(), rtol=0.03, atol=0)


def test_views_of_several_lenses_are_undistorted_each_by_its_own(tmp_path: Path) -> None:
    folder = tiny.write_nerfstudio(tmp_path)
    document = json.loads((folder / "transforms.json").read_text())
    for frame in document["frames"][::2]:
        frame["k1"] = -0.4
    (folder / "transforms.json").write_text(json.dumps(document))
    views = load_views(folder)
    for lens, camera, image in zip(views.lenses, views.cameras, views.images_srgb, strict=True):
        assert image.shape[:2] == (camera.height, camera.width)
        assert (camera.width > tiny.WIDTH) == (lens is not None)
    assert sum(lens is not None for lens in views.lenses) == tiny.VIEWS // 2


def test_a_lens_with_all_coefficients_zero_leaves_pictures_alone(tmp_path: Path) -> None:
    zeros = (0.0,) * (len(PARAMETER_NAMES["FULL_OPENCV"]) - 4)
    views = load_views(tiny.write_colmap(tmp_path, binary=True, lens=Lens("FULL_OPENCV", (*INTRINSICS, *zeros), tiny.WIDTH, tiny.HEIGHT)))
    assert views.lenses == (None,) * tiny.VIEWS
    np.testing.assert_array_equal(views.images_srgb[3].numpy(), tiny.sphere_views()[3].rgba[..., :3])


@pytest.mark.parametrize("layout", LAYOUTS)
def test_pictures_of_every_layout_are_the_painted_ones(layout: str, tmp_path: Path) -> None:
    views = load_views(LAYOUTS[layout](tmp_path / "capture"))
    painted = {view.name: view.rgba for view in tiny.sphere_views(square=layout == "nerf-synthetic")}
    for camera, image in zip(views.cameras, views.images_srgb, strict=True):
        name = f"r_{int(camera.name):03d}" if layout == "nero" else camera.name
        np.testing.assert_array_equal(image.numpy(), painted[name][..., :3])


def test_pictures_of_several_sizes_are_read_each_with_its_camera(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    path = folder / "train" / "r_005.png"
    with Image.open(path) as picture:
        picture.resize((2 * tiny.WIDTH, 2 * tiny.HEIGHT), Image.Resampling.NEAREST).save(path)
    views, even = load_views(folder), load_views(tiny.write_nerf_synthetic(tmp_path / "even"))
    assert [(camera.width, camera.height) for camera in views.cameras] == [
        (2 * tiny.WIDTH, 2 * tiny.HEIGHT) if camera.name == "r_005" else (tiny.WIDTH, tiny.HEIGHT) for camera in even.cameras
    ]
    for camera, usual, image, mask in zip(views.cameras, even.cameras, views.images_srgb, views.coverage, strict=True):
        assert image.shape == (camera.height, camera.width, 3) and mask.shape == image.shape[:2]
        torch.testing.assert_close(camera.intrinsics[:2] / camera.width, usual.intrinsics[:2] / usual.width)
    small = load_views(folder, max_side=tiny.WIDTH)
    assert {image.shape for image in small.images_srgb} == {(tiny.HEIGHT, tiny.WIDTH, 3)}
    for shrunk, image in zip(small.images_srgb, even.images_srgb, strict=True):
        assert torch.equal(shrunk, image)


def test_nothing_but_the_training_views_of_a_synthetic_capture_is_read(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    for name in ("transforms_test.json", "transforms_val.json", "scene.json", "gt_mesh.ply", "points3d.ply", "env/train.exr"):
        (folder / name).parent.mkdir(exist_ok=True)
        (folder / name).write_bytes(b"\0not to be read")
    assert load_views(folder).points_world is None


def test_the_test_split_is_read_only_when_asked_for(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    document = json.loads((folder / "transforms_train.json").read_text())
    document["frames"] = document["frames"][:5]
    (folder / "transforms_test.json").write_text(json.dumps(document))
    assert len(load_views(folder, split="test").cameras) == 5
    assert len(load_views(folder).cameras) == tiny.VIEWS


def test_nero_holds_every_eighth_view_back(tmp_path: Path) -> None:
    folder = tiny.write_nero(tmp_path)
    assert [camera.name for camera in load_views(folder, split="test").cameras] == ["0", "8", "16"]
    assert not {"0", "8", "16"} & {camera.name for camera in load_views(folder).cameras}


def test_colmap_points_arrive_with_their_colors(tmp_path: Path) -> None:
    points, colors = tiny.sphere_points()
    for binary in (True, False):
        views = load_views(tiny.write_colmap(tmp_path / str(binary), binary))
        torch.testing.assert_close(views.points_world, torch.from_numpy(points).float())
        torch.testing.assert_close(views.point_colors_srgb, torch.from_numpy(colors).float() / 255)


def test_a_simple_pinhole_has_one_focal_length(tmp_path: Path) -> None:
    views = load_views(tiny.write_colmap(tmp_path, binary=True, model="SIMPLE_PINHOLE"))
    expected = torch.tensor([[tiny.FX, 0, tiny.CX], [0, tiny.FX, tiny.CY], [0, 0, 1]])
    torch.testing.assert_close(views.cameras[0].intrinsics, expected)


@pytest.mark.parametrize("naming", ["{name}.png", "{name}.jpg.png"])
def test_a_masks_folder_is_found_by_stem_and_by_full_name(naming: str, tmp_path: Path) -> None:
    views = load_views(tiny.write_colmap(tmp_path, binary=False, masks=naming))
    np.testing.assert_array_equal(views.coverage[3].numpy(), tiny.sphere_views()[3].rgba[..., 3])


def test_points_of_a_nerfstudio_ply_are_read(tmp_path: Path) -> None:
    folder = tiny.write_nerfstudio(tmp_path, ply_file_path="sparse_pc.ply")
    points, colors = tiny.sphere_points(50)
    trimesh.PointCloud(points, colors=colors).export(folder / "sparse_pc.ply")
    views = load_views(folder)
    torch.testing.assert_close(views.points_world, torch.from_numpy(points).float())
    torch.testing.assert_close(views.point_colors_srgb, torch.from_numpy(colors).float() / 255)


def test_alpha_that_is_opaque_everywhere_is_no_mask(tmp_path: Path) -> None:
    opaque = [
        tiny.TinyView(v.name, v.rgba | np.array([0, 0, 0, 255], np.uint8), v.camera_from_world) for v in tiny.sphere_views(square=True)
    ]
    views = load_views(tiny.write_nerf_synthetic(tmp_path, opaque))
    assert not views.has_masks
    assert all(bool((mask == 255).all()) for mask in views.coverage)


def test_shrinking_scales_intrinsics_exactly(tmp_path: Path) -> None:
    folder = tiny.write_nerfstudio(tmp_path)
    small = load_views(folder, max_side=tiny.WIDTH // 2)
    assert tuple(small.images_srgb[0].shape[:2]) == (tiny.HEIGHT // 2, tiny.WIDTH // 2)
    expected = torch.tensor([[tiny.FX / 2, 0, tiny.CX / 2], [0, tiny.FY / 2, tiny.CY / 2], [0, 0, 1]])
    torch.testing.assert_close(small.cameras[0].intrinsics, expected)
    assert (small.cameras[0].width, small.cameras[0].height) == (tiny.WIDTH // 2, tiny.HEIGHT // 2)
    assert load_views(folder, max_side=1000).images_srgb[0].shape[1] == tiny.WIDTH


def test_shrinking_averages_linear_light_of_the_object_only() -> None:
    # Two bright object pixels beside two black background ones, then one dark and one bright object pixel.
    color = np.array([[[200] * 3, [0] * 3, [0] * 3, [255] * 3], [[200] * 3, [0] * 3, [0] * 3, [255] * 3]], np.uint8)
    alpha = np.array([[255, 0, 255, 255], [255, 0, 255, 255]], np.uint8)
    small_color, small_alpha = shrink(color, alpha, 2, 1)
    assert small_color[0, 0].tolist() == [200] * 3, "background bled into the edge"
    assert small_alpha[0].tolist() == [128, 255]
    # The mean of linear 0 and 1 is 0.5, which sRGB writes as 188, not 128.
    assert small_color[0, 1].tolist() == [188] * 3


def test_cameras_of_a_file_are_those_of_its_capture(tmp_path: Path) -> None:
    for write, name in (
        (tiny.write_nerf_synthetic, "transforms_train.json"),
        (tiny.write_nerfstudio, "transforms.json"),
        (lambda folder: tiny.write_nerfstudio(folder / "bent", k1=-0.2), "transforms.json"),
    ):
        folder = write(tmp_path / name)
        for camera, other in zip(load_cameras(folder / name), load_views(folder).cameras, strict=True):
            torch.testing.assert_close(camera.camera_from_world, other.camera_from_world)
            torch.testing.assert_close(camera.intrinsics, other.intrinsics)
            assert (camera.width, camera.height, camera.name) == (other.width, other.height, other.name)


def test_cameras_need_no_images(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    alone = tmp_path / "elsewhere.json"
    (folder / "transforms_train.json").rename(alone)
    for image in (folder / "train").glob("*.png"):
        image.unlink()
    camera = load_cameras(alone)[0]
    assert (camera.width, camera.height) == (400, 400)
    assert float(camera.intrinsics[0, 0]) == pytest.approx(400 * tiny.FX / tiny.WIDTH, rel=1e-6)
    small = load_cameras(alone, size=(36, 28))[0]
    assert (small.width, small.height) == (36, 28)
    assert float(small.intrinsics[1, 1]) == pytest.approx(tiny.FX / 2, rel=1e-6)


def test_another_size_keeps_the_framing(tmp_path: Path) -> None:
    folder = tiny.write_nerfstudio(tmp_path)
    camera = load_cameras(folder / "transforms.json", size=(2 * tiny.WIDTH, 2 * tiny.HEIGHT))[0]
    expected = torch.tensor([[2 * tiny.FX, 0, 2 * tiny.CX], [0, 2 * tiny.FY, 2 * tiny.CY], [0, 0, 1]])
    torch.testing.assert_close(camera.intrinsics, expected)


def test_equal_stems_in_two_folders_get_distinct_names(tmp_path: Path) -> None:
    pose = tiny.sphere_views(1)[0].world_from_opengl.tolist()
    frames = [{"file_path": f"./{side}/0.5", "transform_matrix": pose} for side in ("left", "right")]
    path = tmp_path / "transforms.json"
    path.write_text(json.dumps({"camera_angle_x": 0.6, "frames": frames}))
    assert [camera.name for camera in load_cameras(path)] == ["left_0.5", "right_0.5"]


@pytest.mark.parametrize("mode", ["LA", "P"])
def test_grey_and_palette_pictures_keep_their_mask(mode: str, tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    path = folder / "train" / "r_002.png"
    Image.open(path).convert("LA").convert("RGBA").convert(mode).save(path)
    views = load_views(folder)
    expected = tiny.sphere_views(square=True)[2].rgba[..., 3]
    if mode == "LA":
        assert bool((views.images_srgb[2][..., 0] == views.images_srgb[2][..., 1]).all())
    np.testing.assert_array_equal(views.coverage[2].numpy(), expected)


def test_sixteen_bit_grey_photographs_and_masks_keep_their_shades(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    (folder / "masks").mkdir()
    for path in (folder / "train").glob("*.png"):
        grey = np.asarray(Image.open(path).convert("L")).astype(np.uint16) * 257
        alpha = np.asarray(Image.open(path))[..., 3].astype(np.uint16) * 200  # of which no shade fits into 8 bits
        Image.fromarray(grey).save(path)
        Image.fromarray(alpha).save(folder / "masks" / path.name)
    views = load_views(folder)
    painted = Image.fromarray(tiny.sphere_views(square=True)[2].rgba)
    np.testing.assert_array_equal(views.images_srgb[2][..., 0].numpy(), np.asarray(painted.convert("L")))
    np.testing.assert_array_equal(views.coverage[2].numpy(), np.round(np.asarray(painted)[..., 3].astype(float) * 200 / 257))


@pytest.mark.parametrize("place", ["masks", "masks/train"])
def test_masks_of_a_synthetic_capture_are_found_by_plain_name_and_by_path(place: str, tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    (folder / place).mkdir(parents=True)
    for path in (folder / "train").glob("*.png"):
        picture = Image.open(path)
        picture.getchannel("A").save(folder / place / path.name)
        picture.convert("RGB").save(path)
    views = load_views(folder)
    assert views.has_masks
    np.testing.assert_array_equal(views.coverage[3].numpy(), tiny.sphere_views(square=True)[3].rgba[..., 3])


def test_masks_of_training_views_are_none_of_test_views(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    (folder / "transforms_test.json").write_text((folder / "transforms_train.json").read_text().replace("./train/", "./test/"))
    (folder / "masks").mkdir()
    (folder / "test").mkdir()
    for path in (folder / "train").glob("*.png"):
        (folder / "test" / path.name).write_bytes(path.read_bytes())
        Image.new("L", (tiny.WIDTH, tiny.HEIGHT), 0).save(folder / "masks" / path.name)
    assert any(bool((mask == 255).any()) for mask in load_views(folder, split="test").coverage)
    assert not any(bool((mask > 0).any()) for mask in load_views(folder).coverage)


def test_a_synthetic_capture_may_name_its_masks_frame_by_frame(tmp_path: Path) -> None:
    folder = tiny.write_nerf_synthetic(tmp_path)
    document = json.loads((folder / "transforms_train.json").read_text())
    (folder / "cut").mkdir()
    for index, frame in enumerate(document["frames"]):
        Image.new("L", (tiny.WIDTH, tiny.HEIGHT), 10 * index).save(folder / "cut" / f"{index}.png")
        frame["mask_path"] = f"cut/{index}.png"
    (folder / "transforms_train.json").write_text(json.dumps(document))
    assert int(load_views(folder).coverage[5].max()) == 50
