"""The measures of `quality` against closed forms: a disc, two spheres, a sphere with a dent."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from benchmarks.measures.error_regions import REGIONS, TestView, label_regions, outline_distance, region_figures
from benchmarks.measures.mesh_accuracy import mesh_figures, sample_surface
from benchmarks.measures.outline_distance import mesh_coverages, outline_figures, outline_length
from benchmarks.scenes.bench_scene import TrueMaps
from drgs.reconstruct.capture.visual_hull import VisualHull
from drgs.scene.camera import Camera, camera_from_opengl, pixel_rays_world
from tests.render.closed_form_scenes import front_camera, mesh_of

SIZE = 96


def disc(radius: float, fine: int = 8) -> np.ndarray:
    """(SIZE, SIZE) exact coverage but for 1/fine of a pixel."""
    place = (np.arange(SIZE * fine) + 0.5) / fine - SIZE / 2
    inside = place[:, None] ** 2 + place**2 < radius**2
    return inside.reshape(SIZE, fine, SIZE, fine).mean((1, 3))


def test_a_disc_shrunk_by_half_a_pixel_lies_half_a_pixel_inside() -> None:
    assert outline_length(disc(30)) == pytest.approx(2 * math.pi * 30, rel=0.01)
    for change in (-0.5, 0.25, 2.0):
        found = outline_figures([(disc(30 + change), disc(30))])
        exact = change + change**2 / (2 * 30)
        assert found["signed_pixels"] == pytest.approx(exact, abs=0.03)
        assert found["absolute_pixels"] == pytest.approx(abs(exact), abs=0.03)


def test_ins_and_outs_cancel_in_the_signed_distance_only() -> None:
    moved = np.roll(disc(30), 2, axis=1)
    found = outline_figures([(moved, disc(30))])
    assert found["signed_pixels"] == pytest.approx(0, abs=1e-9)
    assert found["absolute_pixels"] == pytest.approx(2 * 2 / math.pi, rel=0.03)  # mean of |2 cos|


def test_a_mask_without_an_outline_is_refused() -> None:
    with pytest.raises(ValueError, match="outline"):
        outline_figures([(np.ones((8, 8)), np.ones((8, 8)))])


def test_coverage_of_a_sphere_is_that_of_its_disc() -> None:
    camera = front_camera(SIZE, 4.0, 0.6)
    (coverage,) = mesh_coverages(mesh_of(trimesh.creation.icosphere(5, 1.0), 0.5, 0.5, 0.0), (camera,))
    radius = float(camera.intrinsics[0, 0]) * math.tan(math.asin(1 / 4))
    assert coverage.sum() == pytest.approx(math.pi * radius**2, rel=2e-3)
    assert outline_figures([(coverage, disc(radius))])["absolute_pixels"] < 0.15


def cameras_around(count: int = 6) -> list[Camera]:
    """At distance 4, on the axes, looking at the origin."""
    cameras = []
    for axis in np.concatenate([np.eye(3), -np.eye(3)])[:count]:
        back, up = axis, np.roll(axis, 1)
        pose = np.eye(4)
        pose[:3, :4] = np.stack([np.cross(up, back), up, back, 4 * back], 1)
        intrinsics = torch.tensor([[150.0, 0, 48], [0, 150, 48], [0, 0, 1]])
        cameras.append(camera_from_opengl(torch.from_numpy(pose), intrinsics, 96, 96))
    return cameras


def test_a_sphere_one_percent_too_small_lies_one_percent_inside() -> None:
    true, small = (mesh_of(trimesh.creation.icosphere(5, radius), 0.5, 0.5, 0.0) for radius in (0.7, 0.7 * 0.99))
    found = mesh_figures(true, small, cameras_around(), count=20_000)
    assert found["offset_median"] == pytest.approx(-1, abs=0.02) and found["share_inside"] == 1
    assert found["accuracy_mean"] == pytest.approx(1, abs=0.15) and found["completeness_mean"] == pytest.approx(1, abs=0.15)
    assert found["recall"] == 0 and found["normal_median"] < 2
    assert (found["components"], found["watertight"], found["faces"]) == (1, True, len(small.faces))


def test_samples_lie_evenly_on_the_surface() -> None:
    samples = sample_surface(mesh_of(trimesh.creation.icosphere(4, 1.0), 0.5, 0.5, 0.0), 4000, 0)
    assert np.linalg.norm(samples.points, axis=1) == pytest.approx(1, abs=0.01)
    assert np.abs(samples.points.mean(0)).max() < 0.05
    assert (samples.points * samples.normals).sum(1).min() > 0.95
    assert samples.barycentric.sum(1) == pytest.approx(1)


def test_true_surface_that_no_camera_sees_is_not_asked_for() -> None:
    """The built mesh lacks the half that nobody sees."""
    whole = trimesh.creation.icosphere(4, 1.0)
    half = whole.submesh([np.flatnonzero(whole.triangles_center[:, 0] > -0.2)], append=True)
    true, built = (mesh_of(shape, 0.5, 0.5, 0.0) for shape in (whole, half))
    (front, *_), side = cameras_around(), cameras_around()[1]
    assert mesh_figures(true, built, [front, front], count=2000)["completeness_mean"] < 2
    assert mesh_figures(true, built, [side, side], count=2000)["completeness_mean"] > 2


def dented_sphere() -> tuple[TestView, VisualHull]:
    """A unit sphere, metal above and paint below, that lies half a unit deeper than its hull where x > 0; a bright square at the middle left."""
    camera = front_camera(SIZE, 4.0, 0.6)
    origin, directions = pixel_rays_world(camera)
    b = (directions @ origin).double().numpy()
    discriminant = b * b - float(origin @ origin) + 1
    inside = discriminant > 0
    distance = -b - np.sqrt(np.maximum(discriminant, 0))
    position = origin.double().numpy() + distance[..., None] * directions.double().numpy()
    normal = np.where(inside[..., None], position, [0, -1.0, 0])
    depth = (position - origin.double().numpy()) @ np.array([0, 1.0, 0])
    depth = np.where(inside & (position[..., 0] > 0), depth + 0.5, depth)
    metallic = (position[..., 2] > 0).astype(float)
    maps = TrueMaps(np.full((SIZE, SIZE, 3), 0.5), normal, depth, np.full(inside.shape, 0.5), metallic, inside.astype(float))
    true = np.concatenate([np.full((SIZE, SIZE, 3), 0.4), inside[..., None]], -1)
    true[44:52, 34:42, :3] = 0.9
    shape = trimesh.creation.icosphere(5, 1.0)
    hull = VisualHull(shape.vertices.astype(np.float32), shape.faces.astype(np.int64), 0.1)
    rendered = true.copy()
    return TestView(camera, rendered, true, maps), hull


def test_each_pixel_belongs_to_the_first_region_that_it_fits() -> None:
    view, hull = dented_sphere()
    maps = view.maps
    hull_depth = np.where(np.arange(SIZE)[None, :] >= SIZE // 2, maps.depth - 0.5, maps.depth)
    region = label_regions(view, hull_depth, hull.cell, brightest=0.5)
    inside = maps.alpha > 0.5
    left = np.broadcast_to(np.arange(SIZE)[None, :] < SIZE // 2, inside.shape)
    names = np.array(REGIONS)[region]
    assert (names[inside & ~left] == "hollow").all()
    radius = float(view.camera.intrinsics[0, 0]) * math.tan(math.asin(1 / 4))
    y, x = np.mgrid[:SIZE, :SIZE] + 0.5 - SIZE / 2
    ring = np.hypot(x, y) - radius
    assert (names[left & (np.abs(ring) < 2)] == "outline").all() and (names[np.abs(ring) > 4] != "outline").all()
    cosine = -(maps.normal_world * pixel_rays_world(view.camera)[1].double().numpy()).sum(-1)
    deep = left & (ring < -4)
    assert (names[deep & (cosine < 0.3)] == "grazing").all()
    bright = (view.true[..., 0] > 0.8) & deep & (cosine > 0.3)
    assert bright.sum() == 64 and (names[bright] == "brightest").all()
    plain = deep & (cosine > 0.3) & ~bright
    assert (names[plain & (y < 0)] == "metal").all() and (names[plain & (y > 0)] == "paint").all()
    assert (names[ring > 4] == "rest").all()


def test_error_goes_to_the_region_that_it_was_put_in() -> None:
    view, hull = dented_sphere()
    rendered = view.rendered.copy()
    rendered[:, SIZE // 2 + 8 :, :3] += 0.1  # in the dent, and outside the object, where alpha hides it
    figures = region_figures([replace(view, rendered=rendered)], hull)
    assert list(figures) == list(REGIONS)
    assert figures["hollow"]["error_share"] == pytest.approx(1, abs=0.01)
    assert sum(row["pixel_share"] for row in figures.values()) == pytest.approx(1)
    rendered[44:52, 34:42, :3] -= 0.1
    both = region_figures([replace(view, rendered=rendered)], hull)
    hollow_pixels = float((rendered[:, SIZE // 2 + 8 :, 3] > 0.5).sum())
    assert both["brightest"]["error_share"] == pytest.approx(64 / (64 + hollow_pixels), rel=0.02)
    assert both["brightest"]["gain_db"] == pytest.approx(-10 * math.log10(1 - both["brightest"]["error_share"]))


def test_distance_from_an_outline_is_that_of_pixel_centres() -> None:
    inside = np.zeros((9, 9), bool)
    inside[:, 4:] = True
    assert outline_distance(inside)[4].tolist() == [3.5, 2.5, 1.5, 0.5, 0.5, 1.5, 2.5, 3.5, 4.5]
