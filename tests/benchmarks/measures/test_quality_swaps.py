"""Swapping parts of an asset for the truth, and what is said of a recovered light."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

from benchmarks.measures.light_energy import light_figures
from benchmarks.measures.mesh_accuracy import sample_surface
from benchmarks.measures.swap_parts import Subject, nearest_facing, recipes, swap_rows, swapped_picture, transfer_attributes
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.render_frame import RenderSettings, render_frame
from drgs.scene.environment import Environment
from drgs.scene.posed_scene import PosedScene
from tests.render.closed_form_scenes import constant_sky, front_camera, mesh_of, sphere_mesh, sunny_sky, two_spheres

CAMERA = front_camera(20, 4.0, 0.7)


def test_no_picture_is_rendered_twice_and_every_part_is_swapped_both_ways() -> None:
    rows = recipes()
    assert len({row.key for row in rows}) == len(rows) == 16
    names = {row.name for row in rows}
    for part in ("normals", "albedo", "roughness", "metallic", "occluders"):
        assert {f"fitted, true {part}", f"true, fitted {part}"} <= names
    keys = {row.name: row.key for row in rows}
    assert keys["fitted, true geometry"] == ("true", "fitted", "fitted", "fitted", "true", "true")
    assert keys["fitted, true occluders"] == ("fitted", "fitted", "fitted", "fitted", "fitted", "true")


@pytest.mark.slow
def test_each_part_comes_from_where_the_recipe_says() -> None:
    fitted, true = sphere_mesh(2, 0.3, 0.2, 0.0, 0.9), sphere_mesh(3, 0.8, 0.6, 1.0, 1.0)
    subject = Subject(fitted, true)
    by_name = {row.name: row for row in recipes()}
    mesh = subject.seen_mesh(by_name["fitted, true roughness"])
    assert mesh.vertices is fitted.vertices and mesh.roughness == pytest.approx(0.6) and mesh.albedo == pytest.approx(0.3)
    mesh = subject.seen_mesh(by_name["true, fitted albedo and metallic"])
    assert mesh.vertices is true.vertices and mesh.albedo == pytest.approx(0.3) and mesh.metallic == pytest.approx(0)
    assert mesh.roughness == pytest.approx(0.6) and mesh.normals is true.normals
    row = by_name["fitted, true occluders"]
    assert subject.occluding_mesh(row).vertices is true.vertices and subject.occluding_mesh(row).albedo == pytest.approx(0.3)
    assert subject.seen_mesh(row).vertices is fitted.vertices


@pytest.mark.slow
def test_attributes_do_not_pass_through_a_thin_wall() -> None:
    """A shell of outer radius 1 and inner radius 0.98: what lies at 0.97 and faces outwards gets those of the outside."""
    outer, inner = trimesh.creation.icosphere(4, 1.0), trimesh.creation.icosphere(4, 0.98)
    inner.invert()
    shell = mesh_of(trimesh.util.concatenate([outer, inner]), 0.5, 0.5, 0.0)
    roughness = torch.cat([torch.full((len(outer.vertices),), 0.9), torch.full((len(inner.vertices),), 0.1)])
    found = transfer_attributes(replace(shell, roughness=roughness), sphere_mesh(3, radius=0.97))
    assert found["roughness"] == pytest.approx(0.9)
    assert (found["normals"] * sphere_mesh(3).normals).sum(-1).min() > 0.99


def test_points_that_face_as_nothing_does_get_the_nearest() -> None:
    floor = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]])
    samples = sample_surface(mesh_of(floor, 0.5, 0.5, 0.0), 100, 0)
    point = samples.points[[7]] - [0, 0, 0.001]
    assert nearest_facing(samples, point, np.array([[0, 0, -1.0]])).tolist() == [7]


def test_a_picture_of_looks_is_that_of_the_mesh_as_primary_surface() -> None:
    mesh, light = two_spheres(roughness=0.4, metallic=0.5), sunny_sky(sun=20.0)
    tracer = build_tracer(mesh)
    found = swapped_picture(tracer, tracer, light, CAMERA, samples=512, bounces=2)
    frame = render_frame(PosedScene(None, mesh, light), CAMERA, RenderSettings(samples_per_pixel=512, bounces=2, primary="mesh"))
    expected = frame.rgba_srgb.double().numpy()
    assert np.abs(found[..., 3] - expected[..., 3]).max() <= 0.25
    inside = (found[..., 3] == 1) & (expected[..., 3] == 1)
    assert inside.sum() > 50
    assert np.abs(found - expected)[inside].mean() < 0.02
    assert (found - expected)[inside].mean() == pytest.approx(0, abs=0.005)


def test_occluders_shade_what_the_camera_sees() -> None:
    """The left of two spheres, lit through both or alone."""
    both = two_spheres(albedo=0.8, roughness=1.0)
    shape = trimesh.creation.icosphere(3)
    shape.apply_translation([-1.02, 0, 0])
    seen = build_tracer(mesh_of(shape, 0.8, 1.0, 0.0))
    alone, shaded = (swapped_picture(seen, occluding, constant_sky(), CAMERA, 256, 0) for occluding in (seen, build_tracer(both)))
    assert (alone[..., 3] == shaded[..., 3]).all()
    inside = alone[..., 3] > 0.9
    darker, column = (alone - shaded)[..., 0], np.arange(20)[None, :]
    near, far = inside & (column > 7), inside & (column < 3)
    assert near.any() and far.any()
    assert darker[near].mean() > 0.05 and np.abs(darker[far]).max() < 0.02


@pytest.mark.slow
def test_swapping_in_all_that_differs_gives_the_truth() -> None:
    true = sphere_mesh(3, 0.8, 0.5, 0.0)
    subject = Subject(sphere_mesh(3, 0.4, 0.5, 0.0), true)
    light = constant_sky()
    tracer = build_tracer(true)
    truth = [swapped_picture(tracer, tracer, light, CAMERA, 32, 0)]
    rows = {row["name"]: row for row in swap_rows(subject, (CAMERA,), {"training": (light, truth), "new": (light, truth)}, light, 32, 0)}
    assert rows["true"]["training"]["psnr"] == 120
    assert rows["fitted, true albedo"]["new"]["psnr"] > 40  # the albedo came from samples of the other mesh
    assert rows["fitted, true roughness"]["new"]["psnr"] < 25
    assert rows["fitted"]["new"]["scale"] == pytest.approx([2, 2, 2], rel=0.15)
    assert rows["fitted"]["new"]["psnr_scaled"] > rows["fitted"]["new"]["psnr"] + 3
    assert [name for name, row in rows.items() if "fitted_light" in row] == ["fitted", "true"]


def lamp(strength: float, height: int = 32) -> Environment:
    radiance = torch.full((height, 2 * height, 3), 0.2)
    radiance[height // 2 - 1 : height // 2 + 1, 8:12] = strength
    return Environment(radiance)


def test_the_true_light_scores_one_and_its_double_two() -> None:
    same = light_figures(lamp(50.0), lamp(50.0))
    assert same["brightest_energy"] == pytest.approx(1) and same["tone_psnr"] > 80
    double = light_figures(Environment(2 * lamp(50.0).radiance), lamp(50.0))
    assert double["energy"] == pytest.approx([2, 2, 2]) and double["brightest_energy"] == pytest.approx(2)
    assert double["brightest_energy_scaled"] == pytest.approx(1) and double["tone_scale"] == pytest.approx(0.5, rel=1e-3)
    assert double["tone_psnr"] > 60


def test_a_lamp_too_weak_or_elsewhere_shows_in_the_lamps_energy() -> None:
    weak = light_figures(lamp(25.0), lamp(50.0))
    assert weak["brightest_energy"] == pytest.approx(0.5, rel=0.02) and weak["lamp_energy"] == pytest.approx(0.5, rel=0.02)
    elsewhere = light_figures(Environment(lamp(50.0).radiance.roll(20, 1)), lamp(50.0))
    assert elsewhere["brightest_energy"] == pytest.approx(1) and elsewhere["lamp_energy"] < 0.05


def test_lights_of_two_sizes_are_compared_at_the_coarser() -> None:
    fine = Environment(lamp(50.0).radiance.repeat_interleave(2, 0).repeat_interleave(2, 1))
    assert light_figures(lamp(50.0), fine)["energy"] == pytest.approx([1, 1, 1])
