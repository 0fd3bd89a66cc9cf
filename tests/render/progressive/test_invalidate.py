"""Edit X recomputes exactly set Y: counted calls, and pictures equal to those of a frame made from nothing."""

import dataclasses
from collections import Counter
from collections.abc import Callable

import pytest
import torch

from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.integrate.fused_embree import FusedEmbreeIntegrator
from drgs.render.intersect.tracer_embree import EmbreeTracer
from drgs.render.progressive import refine as refine_module
from drgs.render.progressive import start_frame as start_module
from drgs.render.progressive.frame_state import FrameState
from drgs.render.progressive.invalidate import MADE_FROM, PARTS
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import RenderSettings
from drgs.scene.environment import Environment
from drgs.scene.materials import Materials
from drgs.scene.posed_scene import PosedScene, PosedSurfels
from tests.render.closed_form_scenes import front_camera, sphere_mesh, sunny_sky, two_spheres

STEPS = {
    "build_tracer": start_module,
    "tiles_of_mesh": start_module,
    "build_environment_table": start_module,
    "trace_primary_points": refine_module,
    "rasterize_gbuffer": start_module,
    "lift_points": start_module,
    "plan_frame": start_module,
}
"""By the module that calls them."""
CAMERA = front_camera(20, distance=8)
SETTINGS = RenderSettings(samples_per_pass=8)


def mesh_scene() -> PosedScene:
    return PosedScene(None, two_spheres(metallic=0.5), sunny_sky(sun=20.0))


def surfel_scene() -> PosedScene:
    """A sphere of overlapping discs around the mesh of the same sphere."""
    mesh, discs = sphere_mesh(3, metallic=0.5), sphere_mesh(2, metallic=0.5)
    u = torch.nn.functional.normalize(torch.linalg.cross(discs.normals, torch.tensor([0.3, 0.5, 0.8]).expand_as(discs.normals)), dim=-1)
    tangents = 0.15 * torch.stack([u, torch.linalg.cross(discs.normals, u)], -1)
    count = len(discs.vertices)
    materials = Materials(discs.albedo, discs.roughness, discs.metallic)
    return PosedScene(PosedSurfels(discs.vertices, tangents, torch.full((count,), 0.95), materials), mesh, sunny_sky(sun=20.0))


def same(scene: PosedScene) -> PosedScene:
    return scene


def new_albedo(scene: PosedScene) -> PosedScene:
    mesh = dataclasses.replace(scene.mesh, albedo=scene.mesh.albedo * torch.tensor([0.5, 1.0, 0.2]))
    surfels = scene.surfels
    if surfels is not None:
        materials = dataclasses.replace(surfels.materials, albedo=surfels.materials.albedo * torch.tensor([0.5, 1.0, 0.2]))
        surfels = dataclasses.replace(surfels, materials=materials)
    return dataclasses.replace(scene, mesh=mesh, surfels=surfels)


def new_sky(scene: PosedScene) -> PosedScene:
    return dataclasses.replace(scene, environment=Environment(scene.environment.radiance.flip(1)))


def turned_sky(scene: PosedScene) -> PosedScene:
    return dataclasses.replace(scene, environment_rotation_degrees=77.0)


def stronger_sky(scene: PosedScene) -> PosedScene:
    return dataclasses.replace(scene, environment_intensity=3.0)


def moved(scene: PosedScene) -> PosedScene:
    return dataclasses.replace(scene, mesh=dataclasses.replace(scene.mesh, vertices=scene.mesh.vertices * torch.tensor([1.0, 1.0, 1.2])))


MESH_TABLE: list[tuple[Callable, set[str]]] = [
    (same, set()),
    (stronger_sky, {"plan_frame"}),
    (turned_sky, set()),
    (new_sky, {"build_environment_table", "plan_frame"}),
    (new_albedo, {"plan_frame"}),
    (moved, {"build_tracer", "tiles_of_mesh", "trace_primary_points", "plan_frame"}),
]


@pytest.fixture
def calls(monkeypatch: pytest.MonkeyPatch) -> Counter:
    counted: Counter = Counter()

    def count(owner: object, name: str) -> None:
        original = getattr(owner, name)

        def counting(*arguments, **named):
            counted[name] += len(arguments[1]) if name in ("occluded", "closest_hits") else 1
            return original(*arguments, **named)

        monkeypatch.setattr(owner, name, counting)

    for step, caller in STEPS.items():
        count(caller, step)
    count(EmbreeTracer, "occluded")
    count(EmbreeTracer, "closest_hits")

    shade_slice = FusedEmbreeIntegrator.shade_slice

    def slice_and_count(*arguments) -> int:
        traced = shade_slice(*arguments)
        counted["traced in slices"] += traced
        return traced

    monkeypatch.setattr(FusedEmbreeIntegrator, "shade_slice", slice_and_count)
    return counted


def steps(calls: Counter) -> set[str]:
    return {name for name in STEPS if calls[name]}


@pytest.mark.parametrize(("edit", "made"), MESH_TABLE, ids=lambda value: getattr(value, "__name__", ""))
def test_an_edit_of_a_mesh_scene_makes_its_parts_and_no_others(edit: Callable, made: set[str], calls: Counter) -> None:
    scene = mesh_scene()
    before = refine_frame(start_frame(scene, CAMERA, SETTINGS))
    calls.clear()
    edited = edit(scene)
    after = start_frame(edited, CAMERA, SETTINGS, previous=before)
    if after.passes == 0:
        after = refine_frame(after)
    assert steps(calls) == made
    fresh = refine_frame(start_frame(edited, CAMERA, SETTINGS))
    torch.testing.assert_close(resolve_frame(after).radiance_linear, resolve_frame(fresh).radiance_linear, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    ("edit", "made"),
    [(same, set()), (new_sky, {"build_environment_table", "plan_frame"}), (turned_sky, set()), (new_albedo, {"plan_frame"})],
    ids=lambda value: getattr(value, "__name__", ""),
)
def test_an_edit_of_a_scene_of_surfels_keeps_where_they_are(edit: Callable, made: set[str], calls: Counter) -> None:
    scene = surfel_scene()
    before = refine_frame(start_frame(scene, CAMERA, SETTINGS))
    calls.clear()
    edited = edit(scene)
    after = start_frame(edited, CAMERA, SETTINGS, previous=before)
    after = refine_frame(after) if after.passes == 0 else after
    assert steps(calls) == made
    fresh = refine_frame(start_frame(edited, CAMERA, SETTINGS))
    torch.testing.assert_close(resolve_frame(after).radiance_linear, resolve_frame(fresh).radiance_linear, rtol=1e-4, atol=1e-5)


def test_a_camera_that_moves_keeps_tree_light_and_horizons(calls: Counter) -> None:
    scene = mesh_scene()
    before = refine_frame(start_frame(scene, CAMERA, SETTINGS))
    calls.clear()
    after = refine_frame(start_frame(scene, front_camera(20, distance=7), SETTINGS, previous=before))
    assert steps(calls) == {"tiles_of_mesh", "trace_primary_points", "plan_frame"}
    assert after.traced.tracer.horizons is before.traced.tracer.horizons and after.passes == 1


def rays_of_first_pass(edit: Callable, calls: Counter, bounces: int) -> tuple[int, int]:
    """Rays asked for with and without the frame before."""
    scene, settings = mesh_scene(), dataclasses.replace(SETTINGS, bounces=bounces)
    before = refine_frame(start_frame(scene, CAMERA, settings))
    numbers = []
    for previous in (before, None):
        state = start_frame(edit(scene), CAMERA, settings, previous=previous)
        calls.clear()
        refine_frame(state)
        numbers.append(calls["occluded"] + calls["closest_hits"] + calls["traced in slices"])
    return numbers[0], numbers[1]


def test_turning_the_light_traces_only_the_rays_that_turned_with_it(calls: Counter) -> None:
    after, fresh = rays_of_first_pass(turned_sky, calls, bounces=0)
    assert 0 < after < 0.5 * fresh  # of eight rays two aim at the light; the camera's ray is known too


def test_another_albedo_traces_hardly_a_ray(calls: Counter) -> None:
    after, fresh = rays_of_first_pass(new_albedo, calls, bounces=0)
    assert after < 0.5 * fresh


def test_first_hits_are_remembered_under_bounces_too(calls: Counter) -> None:
    after, fresh = rays_of_first_pass(turned_sky, calls, bounces=1)
    assert 0 < after < 0.75 * fresh


def test_no_ray_is_kept_while_the_camera_moves_and_the_next_edit_traces_anew(calls: Counter) -> None:
    scene = mesh_scene()
    before = refine_frame(start_frame(scene, CAMERA, SETTINGS))
    moved_on = refine_frame(start_frame(scene, front_camera(20, distance=7), SETTINGS, previous=before))
    assert before.first_rays.rays is not None and moved_on.first_rays.rays is None
    edited = refine_frame(start_frame(new_sky(scene), front_camera(20, distance=7), SETTINGS, previous=moved_on))
    fresh = refine_frame(start_frame(new_sky(scene), front_camera(20, distance=7), SETTINGS))
    torch.testing.assert_close(resolve_frame(edited).radiance_linear, resolve_frame(fresh).radiance_linear, rtol=1e-4, atol=1e-5)
    assert edited.first_rays.rays is not None


def test_a_brighter_light_multiplies_the_sums_it_has() -> None:
    scene = mesh_scene()
    before = refine_frame(start_frame(scene, CAMERA, SETTINGS), 3)
    after = start_frame(stronger_sky(scene), CAMERA, SETTINGS, previous=before)
    assert after.passes == 3
    a, b = resolve_frame(before), resolve_frame(after)
    torch.testing.assert_close(b.radiance_linear, 3 * a.radiance_linear)
    torch.testing.assert_close(b.radiance.variance, 9 * a.radiance.variance)


def test_light_switched_off_and_on_is_no_factor() -> None:
    dark = dataclasses.replace(mesh_scene(), environment_intensity=0.0)
    state: FrameState = refine_frame(start_frame(dark, CAMERA, SETTINGS))
    lit = start_frame(dataclasses.replace(dark, environment_intensity=1.0), CAMERA, SETTINGS, previous=state)
    assert lit.passes == 0 and float(resolve_frame(refine_frame(lit)).radiance_linear.max()) > 0


def test_another_exposure_goes_on_where_the_frame_was() -> None:
    before = refine_frame(start_frame(mesh_scene(), CAMERA, SETTINGS), 2)
    after = start_frame(before.inputs.scene, CAMERA, dataclasses.replace(SETTINGS, exposure=1.0), previous=before)
    assert after.passes == 2 and after.computed_parts == ()
    assert torch.equal(refine_frame(after).sums.diffuse, refine_frame(before).sums.diffuse)


def test_light_of_other_surfaces_is_summed_anew_on_the_same_points_and_rays_and_left_out_at_once(calls: Counter) -> None:
    split = dataclasses.replace(SETTINGS, split_indirect=True)
    plain = refine_frame(start_frame(mesh_scene(), CAMERA, SETTINGS))
    scene = plain.inputs.scene
    calls.clear()
    asked = refine_frame(start_frame(scene, CAMERA, split, previous=plain))
    assert asked.computed_parts == ("sums",) and steps(calls) == set()
    fresh = refine_frame(start_frame(scene, CAMERA, split))
    shown, exact = resolve_frame(asked).radiance, resolve_frame(fresh).radiance
    assert shown.indirect is not None and exact.indirect is not None and float(shown.indirect.max()) > 0.1
    torch.testing.assert_close(shown.indirect, exact.indirect, rtol=1e-4, atol=1e-5)
    brighter = start_frame(stronger_sky(scene), CAMERA, split, previous=asked)
    torch.testing.assert_close(resolve_frame(brighter).radiance.indirect, 3 * shown.indirect)
    left_out = refine_frame(start_frame(scene, CAMERA, SETTINGS, previous=asked))
    assert left_out.passes == 2 and resolve_frame(left_out).radiance.indirect is None
    assert start_frame(scene, CAMERA, split, previous=left_out).passes == 0


def test_every_part_depends_on_something_and_sums_on_all_that_changes_light() -> None:
    assert set(MADE_FROM) == set(PARTS) and all(MADE_FROM.values())
    assert MADE_FROM["sums"] | MADE_FROM["scale"] == frozenset().union(*MADE_FROM.values())
