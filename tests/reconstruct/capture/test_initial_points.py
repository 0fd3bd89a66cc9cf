"""Initial points of a sphere, whose hull, normals and colours are known in closed form."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from drgs.reconstruct.capture.initial_points import InitialPoints, initial_points
from drgs.reconstruct.capture.load_views import load_views
from drgs.reconstruct.capture.visual_hull import VisualHullSettings, axes_meeting_point, visual_hull
from drgs.scene.camera import Camera, scaled_camera
from drgs.scene.views import Views
from tests.reconstruct import tiny_capture as tiny

COUNT = 3000


@pytest.fixture(scope="module")
def sphere(tmp_path_factory: pytest.TempPathFactory) -> Views:
    return load_views(tiny.write_nerf_synthetic(tmp_path_factory.mktemp("capture")))


@pytest.fixture(scope="module")
def points(sphere: Views) -> InitialPoints:
    return initial_points(sphere, COUNT, seed=0)


def _radii(points: torch.Tensor) -> np.ndarray:
    """Distance from the sphere's centre, in radii."""
    return np.linalg.norm(points.double().numpy() - tiny.SPHERE_CENTER, axis=1) / tiny.SPHERE_RADIUS


@pytest.mark.slow
def test_hull_points_lie_on_the_sphere_or_just_outside(points: InitialPoints) -> None:
    assert points.origin == "hull"
    assert points.points_world.shape == (COUNT, 3)
    radii = _radii(points.points_world)
    # A pixel is 0.06 radii wide. A hull of 24 silhouettes stands out between them, but nowhere cuts into the object.
    assert radii.min() > 0.96
    assert np.median(radii) < 1.04
    assert radii.max() < 1.25


def test_hull_normals_point_outward(points: InitialPoints) -> None:
    radial = torch.nn.functional.normalize(points.points_world - torch.tensor(tiny.SPHERE_CENTER).float(), dim=1)
    cosines = (radial * points.normals_world).sum(1)
    torch.testing.assert_close(points.normals_world.norm(dim=1), torch.ones(COUNT))
    assert float(cosines.mean()) > 0.95
    assert float((cosines > 0).float().mean()) > 0.999


def test_the_bounding_sphere_is_that_of_the_object(points: InitialPoints) -> None:
    np.testing.assert_allclose(points.bounds_center.numpy(), tiny.SPHERE_CENTER, atol=0.05)
    assert tiny.SPHERE_RADIUS * 0.98 < points.bounds_radius < tiny.SPHERE_RADIUS * 1.25


def test_points_take_the_color_painted_where_they_lie(points: InitialPoints) -> None:
    normal = points.points_world.double().numpy() - tiny.SPHERE_CENTER
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    painted = tiny.color_of_normal(normal) / 255
    error = np.abs(points.colors_srgb.numpy() - painted).max(1)
    seen = (points.colors_srgb != 0.5).any(1).numpy()
    assert seen.mean() > 0.9
    assert np.median(error[seen]) < 0.04


@pytest.mark.slow
def test_the_hull_is_a_closed_surface_wound_outward(sphere: Views) -> None:
    hull = visual_hull(sphere)
    assert hull is not None
    edges = np.concatenate([hull.faces[:, [0, 1]], hull.faces[:, [1, 2]], hull.faces[:, [2, 0]]])
    directed = {tuple(edge) for edge in edges.tolist()}
    assert len(directed) == len(edges), "an edge is used twice in one direction"
    assert all((b, a) in directed for a, b in directed), "an edge has a face on one side only"
    corners = hull.vertices_world[hull.faces].astype(np.float64)
    volume = np.einsum("fi,fi->", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    exact = 4 / 3 * np.pi * tiny.SPHERE_RADIUS**3
    assert 0.97 * exact < volume < 1.2 * exact


@pytest.mark.slow
def test_large_masks_give_the_hull_of_their_averages(sphere: Views) -> None:
    hull = visual_hull(sphere, VisualHullSettings(mask_side=36))
    assert hull is not None
    radii = np.linalg.norm(hull.vertices_world - tiny.SPHERE_CENTER, axis=1) / tiny.SPHERE_RADIUS
    # Pixels are 0.12 radii wide now.
    assert radii.min() > 0.93 and np.median(radii) < 1.07
    np.testing.assert_allclose((hull.vertices_world.min(0) + hull.vertices_world.max(0)) / 2, tiny.SPHERE_CENTER, atol=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("fill", [0, 255])
def test_one_wrong_mask_is_left_out(fill: int, sphere: Views) -> None:
    coverage = tuple(torch.full_like(mask, fill) if view == 5 else mask for view, mask in enumerate(sphere.coverage))
    radii = _radii(initial_points(replace(sphere, coverage=coverage), COUNT, seed=0).points_world)
    assert radii.min() > 0.96
    assert np.median(radii) < 1.06


@pytest.mark.slow
def test_pictures_of_several_sizes_carve_the_same_hull(sphere: Views) -> None:
    def at(share: float, camera: Camera, mask: torch.Tensor) -> tuple[Camera, torch.Tensor]:
        smaller = scaled_camera(camera, share)
        small = torch.nn.functional.interpolate(mask[None, None].float(), (smaller.height, smaller.width), mode="area")[0, 0]
        return smaller, small.round().to(torch.uint8)

    pairs = [
        at(0.5 if view % 3 else 1.0, camera, mask) for view, (camera, mask) in enumerate(zip(sphere.cameras, sphere.coverage, strict=True))
    ]
    mixed = visual_hull(replace(sphere, cameras=tuple(camera for camera, _ in pairs), coverage=tuple(mask for _, mask in pairs)))
    even = visual_hull(sphere)
    assert mixed is not None and even is not None
    radii = [_radii(torch.from_numpy(hull.vertices_world)) for hull in (mixed, even)]
    assert abs(np.median(radii[0]) - np.median(radii[1])) < 0.01
    assert radii[0].min() > 0.93


@pytest.mark.slow
def test_what_few_close_views_alone_see_is_not_the_object(sphere: Views) -> None:
    def zoomed(camera: Camera, factor: float) -> Camera:
        center = torch.tensor(tiny.SPHERE_CENTER).float() @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
        focal = factor * 0.5 * camera.width * float(center[2]) / tiny.SPHERE_RADIUS
        at = focal * center[:2] / center[2]
        middle = torch.tensor([camera.width / 2, camera.height / 2]) - at
        return replace(camera, intrinsics=torch.tensor([[focal, 0, middle[0]], [0, focal, middle[1]], [0, 0, 1]]))

    def disc(share: float) -> torch.Tensor:
        y, x = torch.meshgrid(*((torch.arange(size) + 0.5) / size - 0.5 for size in sphere.coverage[0].shape), indexing="ij")
        return ((x**2 + y**2).sqrt() < 0.5 * share).to(torch.uint8) * 255

    # The sphere just fits into each picture, but eight neighbours stand so near that it fills theirs.
    around = [zoomed(camera, 0.9) for camera in sphere.cameras]
    near = [zoomed(sphere.cameras[0], 4.0 + 0.01 * k) for k in range(8)]
    coverage = (*[disc(0.9)] * len(around), *[disc(4.0)] * len(near))
    views = replace(sphere, cameras=(*around, *near), coverage=coverage, images_srgb=sphere.images_srgb[:1] * len(coverage))
    # As many cells as other hulls here have: pixels of near views would ask for many more.
    hull = visual_hull(views, VisualHullSettings(fine_cells=72))
    assert hull is not None
    assert _radii(torch.from_numpy(hull.vertices_world)).max() < 1.3


def test_two_separate_parts_both_get_points(sphere: Views) -> None:
    # A small second ball beside the first, drawn into every mask by its own silhouette.
    center, radius = np.array([0.1, 0.75, 0.2]), 0.12
    coverage = tuple(mask.clone() for mask in sphere.coverage)
    for index, camera in enumerate(sphere.cameras):
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        rays = np.stack([x, y, np.ones_like(x)], -1) @ np.linalg.inv(camera.intrinsics.double().numpy()).T
        rays = rays @ camera.camera_from_world.double().numpy()[:3, :3]
        offset = center - camera.center_world.double().numpy()
        along = rays @ offset / np.linalg.norm(rays, axis=-1)
        coverage[index][torch.from_numpy(offset @ offset - along**2 < radius**2)] = 255
    points = initial_points(replace(sphere, coverage=coverage), COUNT, seed=0).points_world.numpy()
    near_second = np.linalg.norm(points - center, axis=1) < 1.6 * radius
    assert 20 < near_second.sum() < COUNT / 4


@pytest.mark.slow
def test_the_same_seed_gives_the_same_points_and_another_does_not(sphere: Views) -> None:
    first, again, other = (initial_points(sphere, 500, seed=seed).points_world for seed in (3, 3, 4))
    assert torch.equal(first, again)
    assert not torch.equal(first, other)


def test_masks_without_a_common_shape_are_refused(sphere: Views) -> None:
    # Each mask is a corner of its picture that the others do not see.
    coverage = tuple(torch.zeros_like(mask) for mask in sphere.coverage)
    for index, mask in enumerate(coverage):
        mask[:8, :8] = 255 if index % 2 else 0
        mask[-8:, -8:] = 0 if index % 2 else 255
    with pytest.raises(ValueError, match="no common shape"):
        initial_points(replace(sphere, coverage=coverage), COUNT, seed=0)


@pytest.mark.slow
def test_sparse_points_off_the_mask_or_far_away_are_dropped_and_the_hull_fills_up(sphere: Views) -> None:
    on_sphere, colors = tiny.sphere_points(300)
    strays = np.random.default_rng(0).uniform(1.0, 1.3, (60, 3))
    views = replace(
        sphere,
        points_world=torch.from_numpy(np.concatenate([on_sphere, strays])).float(),
        point_colors_srgb=torch.from_numpy(np.concatenate([colors / 255, np.ones((60, 3))])).float(),
    )
    points = initial_points(views, COUNT, seed=0)
    assert points.origin == "sparse+hull"
    assert points.points_world.shape == (COUNT, 3)
    assert points.normals_world is not None
    assert _radii(points.points_world).max() < 1.25
    few = initial_points(views, 200, seed=0)
    assert few.origin == "sparse"
    np.testing.assert_allclose(_radii(few.points_world), 1.0, atol=1e-3)


def test_without_masks_the_bounds_ignore_points_of_the_room(sphere: Views) -> None:
    random = np.random.default_rng(0)
    room = np.concatenate([tiny.sphere_points(300)[0], random.uniform(-20, 20, (2000, 3))])
    views = replace(
        sphere,
        coverage=tuple(torch.full_like(mask, 255) for mask in sphere.coverage),
        has_masks=False,
        points_world=torch.from_numpy(room).float(),
        point_colors_srgb=torch.full((len(room), 3), 0.5),
    )
    points = initial_points(views, COUNT, seed=0)
    assert points.origin == "sparse"
    assert points.bounds_radius < 2


def test_without_masks_points_are_random_where_all_cameras_look(sphere: Views) -> None:
    views = replace(sphere, coverage=tuple(torch.full_like(mask, 255) for mask in sphere.coverage), has_masks=False)
    points = initial_points(views, COUNT, seed=0)
    assert points.origin == "random" and points.normals_world is None and points.hull_faces is None
    np.testing.assert_allclose(points.bounds_center.numpy(), 0, atol=1e-3)  # the cameras look at the origin
    assert float((points.points_world - points.bounds_center).abs().max()) <= points.bounds_radius * (1 + 1e-6)
    # The half-angle of the shorter side at distance 3.
    assert points.bounds_radius == pytest.approx(3 * np.sin(np.arctan(tiny.HEIGHT / 2 / tiny.FX)), rel=1e-3)


def test_lines_through_one_point_meet_there() -> None:
    random = np.random.default_rng(0)
    target = np.array([0.3, -0.2, 5.0])
    centers = random.normal(size=(10, 3)) * 4
    directions = target - centers
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(axes_meeting_point(centers, directions), target, atol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("scale", [2.0**-23, 2.0**12])
def test_the_unit_of_the_world_does_not_matter(tmp_path: Path, scale: float) -> None:
    # Powers of two change no digit, so whatever differs comes from a length that is written down somewhere.
    views = tiny.sphere_views(square=True)
    here, there = (load_views(tiny.write_nerf_synthetic(tmp_path / str(k), tiny.at_scale(views, k))) for k in (1.0, scale))
    for has_masks in (True, False):
        points, scaled = (initial_points(replace(found, has_masks=has_masks), COUNT, seed=0) for found in (here, there))
        assert scaled.origin == points.origin and scaled.bounds_radius == pytest.approx(scale * points.bounds_radius, rel=1e-5)
        pairs = [(scaled.points_world / scale, points.points_world), (scaled.colors_srgb, points.colors_srgb)]
        if points.normals_world is not None:
            pairs.append((scaled.normals_world, points.normals_world))
        for found, expected in pairs:  # rounding may send a point to the next face
            assert float(((found - expected).abs().amax(1) < 1e-4).float().mean()) > 0.99
