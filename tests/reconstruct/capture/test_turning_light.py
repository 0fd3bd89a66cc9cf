"""What the light stood still with, told from pictures of a ball on a turntable and of one that a camera went around."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from drgs.evaluate.doctor import doctor
from drgs.maths.color import srgb_from_linear
from drgs.reconstruct.capture.initial_points import initial_points
from drgs.reconstruct.capture.load_views import read_capture
from drgs.reconstruct.capture.load_views.read_pictures import read_pictures
from drgs.reconstruct.capture.turning_light import LightFound, light_found, with_light_of_camera
from drgs.reconstruct.fit.surfels import try_light_frames as module
from drgs.reconstruct.fit.surfels.try_light_frames import light_by_trial, try_light_frames
from tests.reconstruct.tiny_capture import CX, CY, FX, FY, HEIGHT, SPHERE_CENTER, SPHERE_RADIUS, WIDTH, hits_sphere, sphere_views

LAMP = np.array([0.3, -0.8, -0.52])
"""In the camera's frame or in the object's: a direction."""
PICTURES = 20


def write_turntable(folder: Path, lamp_on_camera: bool, same_around: bool, cut_out: bool = False) -> Path:
    """Pictures of a matt ball of many colours, whose lamp and surroundings stand still with the camera, or with the ball."""
    folder.mkdir(exist_ok=True)
    generator = np.random.default_rng(0)
    room = 40 + 150 * generator.random((HEIGHT, WIDTH, 3))
    frames = []
    for view in sphere_views(PICTURES):
        rays = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), -1)
        rays = np.concatenate([(rays - [CX, CY]) / [FX, FY], np.ones((HEIGHT, WIDTH, 1))], -1)
        rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
        rotation = view.camera_from_world[:3, :3]
        position = -rotation.T @ view.camera_from_world[:3, 3]
        distance = np.nan_to_num(hits_sphere(position, rays @ rotation))
        normal = (position + distance[..., None] * (rays @ rotation) - SPHERE_CENTER) / SPHERE_RADIUS
        facing = (normal @ rotation.T if lamp_on_camera else normal) @ LAMP
        paint = 0.45 + 0.15 * normal
        shown = paint * (0.15 + 0.8 * np.clip(facing, 0, None))[..., None]
        pixels = 255 * srgb_from_linear(torch.from_numpy(shown)).numpy()
        inside = view.rgba[..., 3:] > 0
        around = room if same_around else 255 * generator.random((HEIGHT, WIDTH, 3))
        picture = np.where(inside, pixels, around).round().astype(np.uint8)
        if cut_out:
            picture = np.concatenate([picture, view.rgba[..., 3:]], -1)
        Image.fromarray(picture).save(folder / f"{view.name}.png")
        Image.fromarray(view.rgba[..., 3]).save(folder / f"{view.name}_mask.png")
        masks = {} if cut_out else {"mask_path": f"{view.name}_mask.png"}
        frames.append({"file_path": f"{view.name}.png", "transform_matrix": view.world_from_opengl.tolist()} | masks)
    optics = {"fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY, "w": WIDTH, "h": HEIGHT}
    (folder / "transforms.json").write_text(json.dumps({"frames": frames, **optics}))
    return folder


def found_in(folder: Path) -> LightFound:
    capture = read_capture(folder)
    views = read_pictures(capture, None)
    return light_found(capture, views, initial_points(views, 4000, 0))


@pytest.mark.slow
def test_a_turntable_is_told_by_what_stays_and_what_changes(tmp_path: Path) -> None:
    found = found_in(write_turntable(tmp_path / "a", lamp_on_camera=True, same_around=True))
    assert found.frame == "camera" and found.surroundings_differ is not None and found.surroundings_differ < 0.01
    assert found.explained_by_camera > found.explained_by_object + 0.1
    finding = next(f for f in doctor(tmp_path / "a")["findings"] if "turntable" in f["sentence"])
    assert finding["level"] == "info" and "--light object" in finding["advice"]


@pytest.mark.slow
def test_masks_that_are_cut_outs_count_by_their_alpha(tmp_path: Path) -> None:
    for path in write_turntable(tmp_path, lamp_on_camera=True, same_around=True).glob("*_mask.png"):
        mask = np.asarray(Image.open(path))
        Image.fromarray(np.stack([0 * mask, 0 * mask, 0 * mask, mask], -1)).save(path)
    assert found_in(tmp_path).frame == "camera"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("how", "why"),
    [
        ({"lamp_on_camera": False, "same_around": False}, "changes from picture to picture"),
        ({"lamp_on_camera": True, "same_around": False}, "changes from picture to picture"),
        ({"lamp_on_camera": False, "same_around": True}, "follow the camera"),
        ({"lamp_on_camera": True, "same_around": True, "cut_out": True}, "do not show what is around"),
    ],
)
def test_one_sign_alone_is_not_believed(tmp_path: Path, how: dict[str, bool], why: str) -> None:
    found = found_in(write_turntable(tmp_path, **how))
    assert found.frame == "object" and why in found.why
    # Where the surroundings are not to be seen, brightness alone is reason enough to try both.
    assert found.wants_trial == ("cut_out" in how)
    sentences = [f["sentence"] for f in doctor(tmp_path)["findings"]]
    assert any("may stand still with the camera" in sentence for sentence in sentences) == found.wants_trial
    assert not any("stands still with the camera" in sentence for sentence in sentences)


@pytest.mark.slow
@pytest.mark.parametrize("on_camera", [True, False])
def test_two_short_fits_tell_whose_light_it_is_where_pictures_are_cut_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, on_camera: bool
) -> None:
    monkeypatch.setattr(module, "SETTINGS", replace(module.SETTINGS, iterations=40, most_pixels=48 * 48))
    folder = write_turntable(tmp_path, lamp_on_camera=on_camera, same_around=True, cut_out=True)
    capture = read_capture(folder)
    views = read_pictures(capture, None)
    points = initial_points(views, 1500, 0)
    told: list[float] = []
    errors = try_light_frames(views, points, 0, torch.device("cpu"), told.append)
    assert errors is not None and told == sorted(told) and told[-1] == 1
    light = light_by_trial(light_found(capture, views, points), *errors)
    assert light.frame == ("camera" if on_camera else "object") and not light.wants_trial
    assert f"{errors[1] / errors[0]:.2f}" in light.why
    assert try_light_frames(views, points, 0, torch.device("cpu"), should_stop=lambda: True) is None


def test_a_trial_in_which_nothing_can_be_compared_leaves_the_light_as_it_was_found() -> None:
    found = LightFound("object", "the pictures are cut out", wants_trial=True)
    assert light_by_trial(found, 0.0, 0.0) == replace(found, wants_trial=False)
    for errors in ((float("nan"), 1.0), (1.0, float("nan")), (1.0, 0.95)):
        assert light_by_trial(found, *errors).frame == "object"


def test_the_light_of_each_view_is_turned_so_that_cameras_are_still(tmp_path: Path) -> None:
    views = with_light_of_camera(read_pictures(read_capture(write_turntable(tmp_path, True, True)), None))
    assert views.light_from_world is not None
    torch.testing.assert_close(views.light_from_world[0], torch.eye(3), atol=1e-6, rtol=0)
    for camera, turn in zip(views.cameras, views.light_from_world, strict=True):
        ahead = camera.camera_from_world[2, :3]
        torch.testing.assert_close(turn @ ahead, views.cameras[0].camera_from_world[2, :3], atol=1e-5, rtol=0)
