"""Cameras that are a part of a pixel off, held against a ball drawn from where they truly are by the formula that the fit shades with."""

import dataclasses
from collections.abc import Sequence

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from drgs.reconstruct.fit.evidence import register_cameras as module
from drgs.reconstruct.fit.evidence.register_cameras import (
    CamerasFound,
    agreement,
    moved_pixels,
    register_cameras,
    seen_from,
    without_common,
)
from drgs.reconstruct.fit.light.split_sum import filter_environment
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.mask_outlines import MaskOutline, mask_outline
from drgs.render.intersect.trace_rays import build_tracer
from drgs.scene.mesh import TriangleMesh
from drgs.scene.views import Views
from tests.reconstruct.fit.evidence.test_metal_evidence import light, open_light, pictures
from tests.render.closed_form_scenes import sphere_mesh

TURNED = 0.002
"""Standard deviation of a camera's rotation about each axis [radians]."""
MOVED = 0.004
"""Of its place along each [world units]; the ball's radius is 1."""


def spotted_ball() -> TriangleMesh:
    """Painted with waves in all directions, some eight pixels long."""
    mesh = sphere_mesh(subdivisions=5, roughness=0.4)
    waves = torch.randn(3, 3, 10, generator=torch.Generator().manual_seed(0)) * 8
    paint = torch.stack([(mesh.vertices @ wave).sin().mean(1) for wave in waves], 1)
    return dataclasses.replace(mesh, albedo=(0.5 + paint).clamp(0.05, 0.95))


def rigid(twist: np.ndarray) -> np.ndarray:
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = Rotation.from_rotvec(twist[:3]).as_matrix(), twist[3:]
    return transform


def by_chance(targets: Sequence[ViewTarget], share: float = 1.0) -> list[ViewTarget]:
    """With cameras that are off."""
    random, off = np.random.default_rng(0), []
    for target in targets:
        twist = share * random.normal(size=6) * np.repeat([TURNED, MOVED], 3)
        transform = torch.from_numpy(rigid(twist)).float() @ target.camera.camera_from_world
        off.append(dataclasses.replace(target, camera=dataclasses.replace(target.camera, camera_from_world=transform)))
    return off


def views_of(targets: Sequence[ViewTarget]) -> Views:
    images, masks = ([(255 * getattr(target, name) + 0.5).byte() for target in targets] for name in ("photo", "mask"))
    return Views(tuple(target.camera for target in targets), tuple(images), tuple(masks), None, None, True, "test")


def registered(mesh: TriangleMesh, targets: Sequence[ViewTarget], outlines: list[MaskOutline | None]) -> CamerasFound:
    surface = torch.cat([mesh.normals, mesh.albedo, mesh.roughness[:, None], mesh.metallic[:, None]], 1)
    return register_cameras(build_tracer(mesh), targets, outlines, open_light(mesh, filter_environment(light())), surface, 0)


def off_by(true: Sequence[ViewTarget], views: Views) -> float:
    """[pixels] Without what all cameras have in common, which nothing tells."""
    motions, twists = [], []
    for target, camera in zip(true, views.cameras, strict=True):
        pose = target.camera.camera_from_world.double().numpy()
        step = camera.camera_from_world.double().numpy() @ np.linalg.inv(pose)
        twists.append(np.concatenate([Rotation.from_matrix(step[:3, :3]).as_rotvec(), step[:3, 3]]))
        places = sphere_mesh(subdivisions=2).vertices.double().numpy() @ pose[:3, :3].T + pose[:3, 3]
        flows = module._flows(places, target.camera.intrinsics.double().numpy())
        metric = np.einsum("pka,pkb->ab", flows, flows) / len(places)
        motions.append(module._Motion(pose, (np.zeros(6), np.zeros(6)), np.zeros(6), metric))
    own = without_common(motions, twists)
    return float(np.sqrt(np.mean([twist @ motion.metric @ twist for twist, motion in zip(own, motions, strict=True)])))


def test_cameras_that_are_off_come_back():
    mesh = spotted_ball()
    true = pictures(mesh, filter_environment(light()))
    given = by_chance(true)
    found = registered(mesh, given, [mask_outline(target.mask) for target in true])
    assert found.camera_from_world is not None
    before, left = off_by(true, views_of(given)), off_by(true, seen_from(views_of(given), found.camera_from_world))
    assert before > 0.3 and left < 0.1 * before, (before, left)
    # Of a ball outlines do not tell which way it is turned.
    assert 0.5 * before < found.agreed < 1.1 * before and found.noise < 0.5 * found.agreed


def test_a_camera_that_is_far_off_comes_nearer_step_by_step(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "FARTHEST", 0.1)
    mesh = spotted_ball()
    true = pictures(mesh, filter_environment(light()))
    given = by_chance(true)
    found = registered(mesh, given, [mask_outline(target.mask) for target in true])
    assert found.camera_from_world is not None
    moved = seen_from(views_of(given), found.camera_from_world)
    assert moved_pixels(views_of(given), moved, mesh.vertices) < 0.12
    assert off_by(true, moved) < off_by(true, views_of(given)) - 0.05


@pytest.mark.parametrize("says", ["colours", "outlines"])
def test_what_one_witness_says_alone_moves_nothing(says: str):
    """Gloss that moves with the light, or masks drawn by hand, are no camera's error."""
    mesh = spotted_ball()
    true = pictures(mesh, filter_environment(light()))
    given = by_chance(true)
    outlines = [mask_outline(target.mask) for target in true]
    drawn = pictures(mesh, filter_environment(light()), cameras=[target.camera for target in given])
    if says == "colours":
        found = registered(mesh, given, [mask_outline(target.mask) for target in drawn])
    else:
        seen = [dataclasses.replace(off, saturation=right.saturation, mask=right.mask) for off, right in zip(given, drawn, strict=True)]
        found = registered(mesh, seen, outlines)
    assert found.camera_from_world is None and found.noise > 0.05, (found.agreed, found.noise)
    assert registered(mesh, given, [None] * len(given)).camera_from_world is None


def test_right_cameras_stay_and_so_do_those_of_which_nothing_is_seen():
    mesh = spotted_ball()
    true = pictures(mesh, filter_environment(light()))
    outlines = [mask_outline(target.mask) for target in true]
    found = registered(mesh, true, outlines)
    assert found.camera_from_world is None and found.agreed < 0.05
    nothing = [dataclasses.replace(target, mask=torch.zeros_like(target.mask)) for target in by_chance(true)]
    found = registered(mesh, nothing, [None] * len(nothing))
    assert (found.camera_from_world, found.agreed, found.noise) == (None, 0.0, 0.0)


def test_what_a_surface_has_wrong_is_no_motion():
    mesh = spotted_ball()
    true = pictures(mesh, filter_environment(light()))
    random = torch.Generator().manual_seed(1)
    lumps = torch.stack([(mesh.vertices @ (3 * torch.randn(3, 1, generator=random))).sin() for _ in range(20)]).mean(0)
    lumpy = dataclasses.replace(mesh, vertices=mesh.vertices * (1 + 0.02 * lumps))
    found = registered(lumpy, true, [mask_outline(target.mask) for target in true])
    assert found.camera_from_world is None and found.noise > 0.01, (found.agreed, found.noise)


def test_others_of_the_views_are_looked_at_where_some_say_that_cameras_are_off(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(module, "FIRST_LOOK", 4)
    looked: list[str] = []
    motion_of = module._motion_of

    def told(target: ViewTarget, *given):
        looked.append(target.camera.name)
        return motion_of(target, *given)

    monkeypatch.setattr(module, "_motion_of", told)
    mesh = spotted_ball()
    true = pictures(mesh, filter_environment(light()))
    true = [dataclasses.replace(t, camera=dataclasses.replace(t.camera, name=str(k))) for k, t in enumerate(true)]
    outlines = [mask_outline(target.mask) for target in true]
    assert registered(mesh, true, outlines).camera_from_world is None and len(looked) == 4
    looked.clear()
    assert registered(mesh, by_chance(true), outlines).camera_from_world is not None
    assert sorted(looked, key=int) == [str(k) for k in range(len(true))]


def test_motions_of_the_world_are_those_of_the_camera_and_flows_are_their_derivative():
    random = np.random.default_rng(0)
    camera_from_world = rigid(random.normal(size=6))
    motion = module._Motion(camera_from_world, (np.zeros(6), np.zeros(6)), np.zeros(6), np.eye(6))
    twist = 1e-6 * random.normal(size=6)
    np.testing.assert_allclose(rigid(motion.of_camera(twist)) @ camera_from_world, camera_from_world @ rigid(twist), atol=1e-11)
    intrinsics = np.array([[90.0, 0, 38], [0, 84, 26], [0, 0, 1]])
    places = random.normal(size=(5, 3)) + np.array([0, 0, 4])

    def pixels(at: np.ndarray) -> np.ndarray:
        seen = at @ intrinsics.T
        return seen[:, :2] / seen[:, 2:]

    moved = places @ rigid(twist)[:3, :3].T + twist[3:]
    flows = module._flows(places, intrinsics)
    np.testing.assert_allclose(flows @ twist, pixels(moved) - pixels(places), rtol=1e-4, atol=1e-9)


def test_places_that_no_camera_sees_do_not_count_as_moved():
    mesh = spotted_ball()
    given = by_chance(true := pictures(mesh, filter_environment(light())))
    before, after = views_of(true), views_of(given)
    camera = before.cameras[0]
    behind = camera.center_world + 3 * (camera.center_world - mesh.vertices.mean(0))
    one = [dataclasses.replace(views, cameras=views.cameras[:1]) for views in (before, after)]
    assert moved_pixels(*one, behind[None]) == 0
    assert moved_pixels(*one, torch.cat([mesh.vertices, behind[None]])) == pytest.approx(moved_pixels(*one, mesh.vertices))


def motions_of(random: np.random.Generator, said: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[module._Motion]:
    motions = []
    for apart in said:
        spread = random.normal(size=(6, 6))
        motions.append(module._Motion(rigid(2 * random.normal(size=6)), apart, apart[0], spread @ spread.T + np.eye(6)))
    return motions


def test_a_world_that_is_elsewhere_turned_and_larger_is_no_camera_s_error():
    random = np.random.default_rng(0)
    motions = motions_of(random, [(np.zeros(6), np.zeros(6))] * 7)
    moved, grown = 1e-3 * random.normal(size=6), 1e-3
    common = [motion.of_camera(moved + grown * np.concatenate([np.zeros(3), motion.center])) for motion in motions]
    np.testing.assert_allclose(without_common(motions, common), 0, atol=1e-12)
    twists = list(1e-3 * random.normal(size=(7, 6)))
    own = without_common(motions, twists)
    np.testing.assert_allclose(without_common(motions, [a + b for a, b in zip(twists, common, strict=True)]), own, atol=1e-12)
    # No other similarity leaves less to be seen.
    seen, other = (sum(t @ m.metric @ t for m, t in zip(motions, some, strict=True)) for some in (own, np.add(own, 0.1 * np.array(common))))
    assert seen < other
    point = np.array([0.3, -0.2, 0.5, 1.0])
    for motion in motions:
        larger = motion.camera_from_world @ np.append((1 + grown) * point[:3], 1.0)
        nearer = rigid(motion.of_camera(grown * np.concatenate([np.zeros(3), motion.center]))) @ motion.camera_from_world @ point
        np.testing.assert_allclose(nearer[:2] / nearer[2], larger[:2] / larger[2], rtol=1e-5)


def test_witnesses_that_contradict_each_other_agree_on_nothing():
    random = np.random.default_rng(0)
    twists = [1e-3 * random.normal(size=6) for _ in range(9)]
    agreed, noise = agreement(motions_of(random, [(twist, -twist) for twist in twists]))
    assert agreed == 0 and noise > 0
    agreed, noise = agreement(motions_of(random, [(twist, twist) for twist in twists]))
    assert agreed > 0 and noise == pytest.approx(0, abs=1e-12)
