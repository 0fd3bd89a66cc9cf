"""A blue egg on the ground, both of one pattern: the plane, what it looks like, and the egg that stands on it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy import ndimage

from drgs.reconstruct import stages
from drgs.reconstruct.capture import find_masks as find_masks_module
from drgs.reconstruct.capture.find_masks import find_masks
from drgs.reconstruct.capture.initial_points import initial_points, seen_by_all
from drgs.reconstruct.capture.masks_by_strokes.vote_volume import Region, Volume
from drgs.reconstruct.capture.on_ground.ground_picture import ground_likelihood, ground_picture
from drgs.reconstruct.capture.on_ground.ground_plane import ground_plane
from drgs.reconstruct.capture.on_ground.stands_on_ground import OnGroundSettings, look_again, standing_parts, stands_on_ground
from drgs.reconstruct.fit.light.ground_layer import COVER, before_ground, ground_logits
from drgs.reconstruct.presets import PRESETS
from drgs.reconstruct.progress import BuildStopped
from drgs.reconstruct.report_progress import BuildReporter
from drgs.scene.camera import Camera
from drgs.scene.ground import Ground, places_on_ground
from drgs.scene.views import Views
from tests.one_torch_thread import one_torch_thread  # noqa: F401
from tests.reconstruct.pose.textured_scene import FOCAL, RADII, SIZE, noise, orbit, picture

GROUND_Z = -float(RADII[2])
VIEWS, SIDE = 24, 200
FOCAL_PIXELS = FOCAL * SIDE / SIZE
"""Focal length."""
SMALLER = OnGroundSettings(fine_texels=256, fine_views=16)
"""A last picture of the ground as fine as so few and small photographs show it."""
FIRST = dataclasses.replace(SMALLER, side=128, fine_side=SIDE, fine_texels=128, cells=48)
"""Of a first look, which need not be as exact as one at masks."""
BLUE = np.array([0.5, 0.8, 1.2])
CPU = torch.device("cpu")


def on_egg(count: int, random: np.random.Generator) -> np.ndarray:
    directions = random.normal(size=(count, 3))
    return RADII * directions / np.linalg.norm(directions, axis=1, keepdims=True)


def on_ground(count: int, random: np.random.Generator, half: float = 4.0) -> np.ndarray:
    """But below the egg, where nobody sees it."""
    flat = random.uniform(-half, half, (count, 2))
    flat = flat[np.linalg.norm(flat, axis=1) > 1.2]
    return np.column_stack([flat, np.full(len(flat), GROUND_Z)])


def sparse_points() -> np.ndarray:
    """On the egg and the ground, a little off, and some mistakes anywhere above."""
    random = np.random.default_rng(5)
    egg, ground = on_egg(400, random), on_ground(600, random)
    points = np.concatenate([egg, ground]) + random.normal(scale=0.008, size=(len(egg) + len(ground), 3))
    return np.concatenate([points, random.uniform((-3, -3, GROUND_Z), (3, 3, 3), (60, 3))])


@pytest.fixture(scope="module")
def scene() -> tuple[Views, list[np.ndarray]]:
    poses = np.concatenate([orbit(VIEWS // 2, 2.2), orbit(VIEWS // 2, 4.5)])
    cameras, images, masks = [], [], []
    for number, pose in enumerate(poses):
        color, egg = picture(pose, FOCAL_PIXELS, size=SIDE)
        intrinsics = torch.tensor([[FOCAL_PIXELS, 0, SIDE / 2], [0, FOCAL_PIXELS, SIDE / 2], [0, 0, 1]])
        cameras.append(Camera(torch.from_numpy(np.linalg.inv(pose)).float(), intrinsics, SIDE, SIDE, name=f"{number:02d}"))
        images.append(torch.from_numpy(np.where(egg[..., None], color * BLUE, color).round().astype(np.uint8)))
        masks.append(egg)
    points = torch.from_numpy(sparse_points()).float()
    all_of_it = tuple(torch.full((SIDE, SIDE), 255, dtype=torch.uint8) for _ in poses)
    return Views(tuple(cameras), tuple(images), all_of_it, points, torch.full_like(points, 0.5), False, "nerfstudio"), masks


@pytest.fixture(scope="module")
def standing(scene: tuple[Views, list[np.ndarray]]) -> Views | None:
    """What is found of it."""
    return stands_on_ground(scene[0], seed=0, settings=FIRST)


def centers_of(views: Views) -> np.ndarray:
    return torch.stack([camera.center_world for camera in views.cameras]).double().numpy()


def test_the_plane_is_that_of_the_ground(scene: tuple[Views, list[np.ndarray]]) -> None:
    views, _ = scene
    center, radius = seen_by_all(views)
    plane = ground_plane(sparse_points(), centers_of(views), center, radius, seed=0)
    assert plane is not None and plane.normal_world[2] > 0.9999 and plane.offset == pytest.approx(GROUND_Z, abs=0.01)
    assert np.abs(plane.heights(plane.points_world)).max() <= plane.tolerance
    again = ground_plane(sparse_points(), centers_of(views), center, radius, seed=0)
    assert again is not None and np.array_equal(again.normal_world, plane.normal_world), "same seed, same plane"
    # Neither where the world lies nor its unit matter.
    turn, move, unit = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]]), np.array([5.0, -3, 2]), 40.0
    moved = ground_plane(
        unit * sparse_points() @ turn.T + move, unit * centers_of(views) @ turn.T + move, unit * turn @ center + move, unit * radius, 0
    )
    assert moved is not None and moved.normal_world @ turn @ plane.normal_world == pytest.approx(1, abs=1e-4)


@pytest.mark.parametrize("why", ["no points", "an egg alone", "cameras below", "much below"])
def test_without_a_ground_there_is_none(scene: tuple[Views, list[np.ndarray]], why: str) -> None:
    views, _ = scene
    center, radius = seen_by_all(views)
    points, centers, random = sparse_points(), centers_of(views), np.random.default_rng(1)
    if why == "no points":
        points = points[:10]
    elif why == "an egg alone":
        points = on_egg(1000, random)
    elif why == "cameras below":
        centers[::3, 2] = GROUND_Z - 1
    else:
        points = np.concatenate([points, random.uniform((-3, -3, GROUND_Z - 2), (3, 3, GROUND_Z - 0.3), (600, 3))])
    assert ground_plane(points, centers, center, radius, seed=0) is None


def test_what_the_ground_looks_like_and_who_sees_it(scene: tuple[Views, list[np.ndarray]]) -> None:
    views, masks = scene
    center, radius = seen_by_all(views)
    plane = ground_plane(sparse_points(), centers_of(views), center, radius, seed=0)
    assert plane is not None
    free = [torch.from_numpy(~mask) for mask in masks]
    found = ground_picture(plane, views.cameras, views.images_srgb, torch.from_numpy(center).float(), radius, free)
    ground, side = found.ground, found.ground.known.shape[-1]
    assert float(ground.heights(torch.tensor([[0.0, 0, GROUND_Z + 1]]))) == pytest.approx(1, abs=0.02)
    steps = (2 * (torch.arange(side) + 0.5) / side - 1) * ground.half
    places = ground.middle + steps[None, :, None] * ground.axes[0] + steps[:, None, None] * ground.axes[1]
    near = (ground.known[0] > 0) & (places.norm(dim=-1) < 3)
    assert near.float().sum() > 0.05 * side**2
    true = torch.from_numpy(0.2 + 0.6 * noise(places[near].double().numpy()) * np.array([1.0, 0.9, 0.8])).float()
    assert float((ground.color_srgb[:, near].T - true).abs().mean()) < 0.05
    likely, known = ground_likelihood(found, views.cameras[2], views.images_srgb[2])
    egg = torch.from_numpy(masks[2])
    assert float((likely[known & ~egg] > 0).float().mean()) > 0.9, "the ground is known as such"
    assert float((likely[known & egg] > 0).float().mean()) < 0.4, "what stands before it is mostly not"


@pytest.mark.slow
def test_the_egg_is_where_the_ground_is_hidden(scene: tuple[Views, list[np.ndarray]], standing: Views | None) -> None:
    (views, masks), found = scene, standing
    assert found is not None and found.ground is not None and not found.has_masks
    for coverage, mask in zip(found.coverage, masks, strict=True):
        may = coverage.numpy() > 127
        assert (mask & ~may).sum() < 0.06 * mask.sum(), "no picture loses the egg"
        assert may.sum() < 2.2 * mask.sum(), "nor keeps the ground"
    assert stands_on_ground(dataclasses.replace(views, points_world=None), seed=0) is None
    assert stands_on_ground(views, seed=0, should_stop=lambda: True) is None
    assert views.points_world is not None
    lost = dataclasses.replace(views, points_world=torch.full_like(views.points_world, torch.nan))
    assert stands_on_ground(lost, seed=0) is None


def overlap(found: list[np.ndarray], true: list[np.ndarray]) -> float:
    return float(np.mean([(a & b).sum() / (a | b).sum() for a, b in zip(found, true, strict=True)]))


@pytest.mark.slow
def test_masks_that_are_too_wide_are_cut_where_the_ground_is_seen_beside_the_egg(scene: tuple[Views, list[np.ndarray]]) -> None:
    views, masks = scene
    wide = [ndimage.binary_dilation(mask, iterations=4) for mask in masks]
    given = [torch.from_numpy(255 * mask.astype(np.uint8)) for mask in wide]
    again = look_again(views, given, seed=0, settings=SMALLER)
    assert again is not None
    found, cut = again
    assert found.ground is not None and not found.has_masks
    after = [mask.numpy() > 127 for mask in cut]
    assert all((a & ~b).sum() == 0 for a, b in zip(after, wide, strict=True)), "nothing is added"
    assert overlap(after, masks) > overlap(wide, masks) + 0.02
    assert all((b & ~a).sum() < 0.05 * b.sum() for a, b in zip(after, masks, strict=True)), "no picture loses the egg"
    for coverage, mask in zip(found.coverage, after, strict=True):
        assert (mask & (coverage.numpy() < 128)).sum() == 0, "where the masks are, the egg may be"
    assert look_again(views, given, seed=0, should_stop=lambda: True) is None
    assert look_again(dataclasses.replace(views, points_world=None), given, seed=0) is None


def test_the_ground_is_kept_for_a_build_that_goes_on(
    scene: tuple[Views, list[np.ndarray]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views, masks = scene
    ground = Ground(torch.tensor([0.0, 0, -1]), torch.tensor([[1.0, 0, 0], [0, 1, 0]]), 2.0, torch.rand(3, 4, 4), torch.ones(1, 4, 4))
    coverage = tuple(torch.from_numpy(mask.astype(np.uint8) * 255) for mask in masks)
    found = [dataclasses.replace(views, ground=ground, coverage=coverage), None]
    monkeypatch.setattr(stages, "stands_on_ground", lambda *given: found.pop(0))
    for number, expected in enumerate(list(found)):
        reporter = BuildReporter(None, {"read": 1.0})
        place = stages.Workplace(tmp_path / str(number), {"seed": "0"}, False, reporter, lambda: False)
        made = stages.ground_stage(place, views, 0)
        kept = stages.ground_stage(dataclasses.replace(place, resume=True), views, 0)  # found is empty by now: it is not looked for again
        for given in (made, kept):
            assert all(torch.equal(a, b) for a, b in zip(given.coverage, (expected or views).coverage, strict=True))
            assert (given.ground is None) == (expected is None) and not given.has_masks
            if given.ground is not None:
                assert all(
                    torch.equal(getattr(given.ground, name), getattr(ground, name)) for name in ("middle", "axes", "color_srgb", "known")
                )
                assert given.ground.half == ground.half
    stopped = stages.Workplace(tmp_path / "stopped", {"seed": "0"}, False, BuildReporter(None, {"read": 1.0}), lambda: True)
    found.append(None)
    with pytest.raises(BuildStopped):
        stages.ground_stage(stopped, views, 0)
    assert not (tmp_path / "stopped" / stages.GROUND).exists(), "what was not looked at is not said to be without a ground"


def test_the_ground_of_the_second_look_is_kept_as_well(
    scene: tuple[Views, list[np.ndarray]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    views, masks = scene
    coverage = tuple(torch.from_numpy(mask.astype(np.uint8) * 255) for mask in masks)
    ground = Ground(torch.tensor([0.0, 0, -1]), torch.tensor([[1.0, 0, 0], [0, 1, 0]]), 2.0, torch.rand(3, 4, 4), torch.ones(1, 4, 4))
    first, second = (dataclasses.replace(views, ground=dataclasses.replace(ground, half=half)) for half in (2.0, 3.0))
    masked = dataclasses.replace(views, has_masks=True)
    found = [(dataclasses.replace(second, coverage=coverage), [mask.clone() for mask in coverage]), None]
    monkeypatch.setattr(stages, "look_again", lambda *given: found.pop(0))
    for number, expected in enumerate(list(found)):
        place = stages.Workplace(tmp_path / str(number), {"seed": "0"}, False, BuildReporter(None, {"read": 1.0}), lambda: False)
        for resume in (False, True):  # found is empty when it is resumed
            with_ground, with_masks = stages.ground_again_stage(dataclasses.replace(place, resume=resume), first, masked, 0)
            assert with_masks.has_masks and not with_ground.has_masks and with_ground.ground is not None
            assert with_ground.ground.half == (2 if expected is None else 3)
            wanted = masked.coverage if expected is None else coverage
            assert all(torch.equal(a, b) for a, b in zip(with_masks.coverage, wanted, strict=True))
    found.append(None)
    stopped = stages.Workplace(tmp_path / "stopped", {"seed": "0"}, False, BuildReporter(None, {"read": 1.0}), lambda: True)
    with pytest.raises(BuildStopped):
        stages.ground_again_stage(stopped, first, masked, 0)


def test_what_floats_is_none_of_it() -> None:
    flat = Ground(torch.tensor([0.0, 0, -1]), torch.tensor([[1.0, 0, 0], [0, 1, 0]]), 2.0, torch.zeros(3, 4, 4), torch.ones(1, 4, 4))
    region = Region(np.array([-1.0, -1, -1]), np.array([1.0, 1, 1]), 20)
    centers = region.centers().reshape(-1, 3)
    column, cloud = (centers[:, :2].abs().amax(-1) < 0.25) & (centers[:, 2] < 0.25), (centers[:, 0] > 0.5) & (centers[:, 2] > 0.65)
    volume = Volume(centers[column | cloud], region.cell, region.low, region.high)
    standing = standing_parts(volume, flat, 0.3)
    assert standing is not None and torch.equal(standing.centers, centers[column])
    assert standing_parts(dataclasses.replace(volume, centers=centers[cloud]), flat, 0.3) is None


@pytest.mark.slow
def test_a_fit_before_the_ground_finds_the_egg(
    scene: tuple[Views, list[np.ndarray]], standing: Views | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(find_masks_module, "ITERATIONS", 120)
    monkeypatch.setattr(find_masks_module, "SIDE", 64)
    (_, masks), found = scene, standing
    assert found is not None
    points = initial_points(dataclasses.replace(found, has_masks=True), 600, seed=0)
    draft = PRESETS["draft"].fit
    # Surfels before the ground have to fade in a third of the iterations.
    settings = dataclasses.replace(draft, rates=dataclasses.replace(draft.rates, opacity_logits=3 * draft.rates.opacity_logits), seed=0)
    masked = find_masks(found, points, settings, CPU)
    assert masked is not None and masked.has_masks and masked.ground is None
    shares = [((m.numpy() > 127) & mask).sum() / ((m.numpy() > 127) | mask).sum() for m, mask in zip(masked.coverage, masks, strict=True)]
    assert np.mean(shares) > 0.88 and min(shares) > 0.8


def test_the_layer_shows_the_ground_below_and_what_is_behind_it_above() -> None:
    color = torch.rand(3, 8, 8, generator=torch.Generator().manual_seed(0)) * 0.9 + 0.05
    known = torch.zeros(1, 8, 8)
    known[:, :, :4] = 1
    ground = Ground(torch.tensor([0.0, 0, -1]), torch.tensor([[1.0, 0, 0], [0, 1, 0]]), 2.0, color, known)
    down = torch.tensor([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]])  # from (0, 0, 3), four above it
    camera = Camera(down, torch.tensor([[16.0, 0, 4], [0, 16, 4], [0, 0, 1]]), 8, 8)
    places, meets = places_on_ground(ground, camera, 0.05)
    assert meets.all() and places.abs().max() < 0.5
    behind = torch.full((8, 8, 3), 0.5)
    logits = ground_logits(ground).requires_grad_(True)
    seen = before_ground(logits, ground, camera, behind)
    # Column and row of the middle of the picture, of which the left half is known and the rest has the colours beside it.
    expected = torch.sigmoid(torch.nn.functional.grid_sample(logits[:, :3], places[None], align_corners=False)[0].permute(1, 2, 0))
    assert torch.allclose(seen[:, :3], COVER * expected[:, :3] + (1 - COVER) * 0.5, atol=1e-5)
    seen.sum().backward()
    assert logits.grad is not None and logits.grad.abs().sum() > 0
    up = torch.diag(torch.tensor([1.0, -1, -1, 1])) @ down  # looks away from it
    away = dataclasses.replace(camera, camera_from_world=up)
    assert torch.equal(before_ground(logits, ground, away, behind), behind)
