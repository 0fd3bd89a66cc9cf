"""For each thing that a frame may leave out: the scenes made to tempt it. What is exact must give the bits of a frame that leaves nothing out."""

import dataclasses
import math
from collections.abc import Callable

import pytest
import torch
import trimesh

from drgs.render.film.resolve_frame import resolve_frame
from drgs.render.intersect.horizon import Horizons
from drgs.render.intersect.trace_rays import build_tracer
from drgs.render.progressive.frame_state import FrameState
from drgs.render.progressive.refine import refine_frame
from drgs.render.progressive.start_frame import start_frame
from drgs.render.records import Frame, RenderSettings
from drgs.scene.camera import Camera
from drgs.scene.environment import Environment
from drgs.scene.gaussians import surfel_tangents
from drgs.scene.materials import Materials
from drgs.scene.mesh import TriangleMesh
from drgs.scene.posed_scene import PosedScene, PosedSurfels
from tests.reconstruct.surfel_spheres import surfel_sphere
from tests.render.closed_form_scenes import constant_sky, front_camera, mesh_of, sphere_mesh, sunny_sky, two_spheres

CAMERA = front_camera(24, 6.0)


def started(scene: PosedScene, camera: Camera = CAMERA, horizons: bool = False, **settings) -> FrameState:
    """Horizons of all faces known beforehand, where asked for."""
    tracer = build_tracer(scene.mesh)
    if horizons:
        tracer.horizons = Horizons(scene.mesh, tracer.lift)
        tracer.horizons.find(tracer.horizons.faces)
    return start_frame(scene, camera, RenderSettings(**settings), tracer)


def rendered(scene: PosedScene, passes: int = 4, camera: Camera = CAMERA, horizons: bool = False, **settings) -> Frame:
    return resolve_frame(refine_frame(started(scene, camera, horizons, **settings), passes))


def left_out(frame: Frame) -> list[str]:
    return [skip["what"] for skip in frame.metadata["skipped"]]


def mean_and_error(frame: Frame) -> tuple[float, float]:
    covered = frame.gbuffer.coverage > 0
    luminance = frame.radiance_linear[covered] @ torch.tensor([0.2126, 0.7152, 0.0722])
    return float(luminance.mean()), float(frame.radiance.variance[covered].sum().sqrt()) / int(covered.sum())


def assert_same_mean(scene: PosedScene, passes: int = 64) -> None:
    (a, noise_a), (b, noise_b) = (mean_and_error(rendered(scene, passes, skip=skip, seed=int(skip))) for skip in (True, False))
    assert abs(a - b) < 4 * math.hypot(noise_a, noise_b) + 1e-6, (a, b, noise_a, noise_b)


# Light rays are left out under a black sky.


@pytest.mark.parametrize(("row", "column", "channel", "value"), [(0, 0, 2, 1e-3), (15, 31, 0, 1e-20), (7, 16, 1, 1e6)])
def test_a_sky_with_light_in_one_channel_of_one_texel_is_not_black(row: int, column: int, channel: int, value: float) -> None:
    radiance = torch.zeros(16, 32, 3)
    radiance[row, column, channel] = value
    frame = rendered(PosedScene(None, sphere_mesh(2), Environment(radiance)))
    assert "light rays" not in left_out(frame)
    if value > 1e-10:
        assert float(frame.radiance_linear[..., channel].max()) > 0


def test_light_that_is_switched_off_and_on_again_comes_back() -> None:
    lit = PosedScene(None, sphere_mesh(2), constant_sky())
    off = dataclasses.replace(lit, environment_intensity=0.0)
    states = [refine_frame(started(lit))]
    for scene in (off, lit):
        states.append(refine_frame(start_frame(scene, CAMERA, RenderSettings(), previous=states[-1])))
    pictures = [resolve_frame(state) for state in states]
    assert "light rays" in left_out(pictures[1]) and float(pictures[1].radiance_linear.max()) == 0.0
    assert torch.equal(pictures[0].radiance_linear, pictures[2].radiance_linear)


# Tiles in which nothing can be seen get no rays.


def triangle(*corners: tuple[float, float, float]) -> TriangleMesh:
    return mesh_of(trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 1]], process=False), 0.7, 0.5, 0.0)


TEMPTING_TRIANGLES = {
    "no corner in the picture, all of it covered": triangle((-90, 3, -90), (90, 3, -90), (0, 3, 150)),
    "one corner behind the camera": triangle((0, -40, 0.5), (-1, 0, -1), (1, 0, -1)),
    "in the camera's own plane": triangle((-5, -6, -1), (5, -6, -1), (0, 20, 1)),
    "a sliver across tiles": triangle((-3, 0, -3), (3, 0, 3), (3, 0, 3.02)),
    "a corner of a tile": triangle((-0.02, 0, -0.02), (0.02, 0, -0.02), (0, 0, 0.02)),
    "at the rim of the picture": triangle((-2.2, 0, 0), (-1.83, 0, -0.05), (-1.83, 0, 0.05)),
}


@pytest.mark.parametrize("mesh", TEMPTING_TRIANGLES.values(), ids=TEMPTING_TRIANGLES)
def test_no_triangle_hides_in_a_tile_taken_for_empty(mesh: TriangleMesh) -> None:
    scene, camera = PosedScene(None, mesh, constant_sky()), front_camera(40, 6.0)
    frames = [rendered(scene, 16, camera, skip=skip) for skip in (True, False)]
    assert float(frames[1].gbuffer.coverage.max()) > 0  # there is something to hide
    assert torch.equal(frames[0].gbuffer.coverage, frames[1].gbuffer.coverage)


def test_a_mesh_behind_the_camera_leaves_all_tiles_empty_and_a_picture_of_nothing() -> None:
    mesh = dataclasses.replace(sphere_mesh(1), vertices=sphere_mesh(1).vertices - torch.tensor([0.0, 50.0, 0.0]))
    frame = rendered(PosedScene(None, mesh, constant_sky()))
    assert "rays through empty tiles" in left_out(frame) and float(frame.gbuffer.coverage.max()) == 0.0


# Strategies are dropped where no surface needs them.


def spotted(mesh: TriangleMesh, **values: float) -> TriangleMesh:
    """One vertex of the far side changed."""
    changed = {name: getattr(mesh, name).clone() for name in values}
    for name, value in values.items():
        changed[name][int(mesh.vertices[:, 1].argmax())] = value
    return dataclasses.replace(mesh, **changed)


def covered_by(mesh: TriangleMesh, roughness: float, metallic: float) -> PosedSurfels:
    """Surfels of one material over a unit sphere."""
    ball = surfel_sphere(200)
    count = len(ball.centers)
    return PosedSurfels(
        ball.centers,
        surfel_tangents(ball),
        torch.full((count,), 0.95),
        Materials(torch.full((count, 3), 0.7), torch.full((count,), roughness), torch.full((count,), metallic)),
    )


@pytest.mark.parametrize(
    ("sky", "even"),
    [
        (constant_sky(), True),
        (Environment(constant_sky().radiance * torch.tensor([1.0, 0.5, 0.2])), False),  # even but coloured: more than it needs, never less
        (Environment(torch.tensor([[1.0, 0, 0], [0, 1, 0]]).repeat(4, 4, 1)), False),  # the largest channel is 1 everywhere
        (Environment(torch.ones(64, 128, 3).index_fill_(0, torch.tensor([0]), 1.002)), False),  # the polar row alone
    ],
)
def test_only_a_sky_that_is_the_same_everywhere_is_even(sky: Environment, even: bool) -> None:
    assert ("environment samples" in left_out(rendered(PosedScene(None, sphere_mesh(2), sky), 1))) == even


def test_one_surface_that_is_not_quite_bare_metal_keeps_cosine_samples() -> None:
    metal = sphere_mesh(2, metallic=1.0, roughness=0.4)
    assert "cosine samples" in left_out(rendered(PosedScene(None, metal, sunny_sky()), 1))
    assert "cosine samples" not in left_out(rendered(PosedScene(None, spotted(metal, metallic=0.999), sunny_sky()), 1))
    # Metal surfels over a mesh of paint: reflections show the mesh.
    painted = PosedScene(covered_by(metal, 0.4, 1.0), sphere_mesh(2), sunny_sky())
    assert "cosine samples" not in left_out(rendered(painted, 1))


def test_a_black_dielectric_has_no_diffuse_part_and_keeps_its_gloss() -> None:
    scene = PosedScene(None, sphere_mesh(2, albedo=0.0, roughness=0.3), sunny_sky(sun=10.0))
    assert "cosine samples" in left_out(rendered(scene, 1))
    assert_same_mean(scene)


def test_one_surface_that_is_a_bit_smoother_or_a_bit_metal_keeps_ggx_samples() -> None:
    rough = sphere_mesh(2, roughness=0.8)
    assert "GGX samples" in left_out(rendered(PosedScene(None, rough, sunny_sky()), 1))
    for values in ({"roughness": 0.69}, {"metallic": 0.001}):
        assert "GGX samples" not in left_out(rendered(PosedScene(None, spotted(rough, **values), sunny_sky()), 1))
    assert "GGX samples" not in left_out(rendered(PosedScene(covered_by(rough, 0.2, 0.0), rough, sunny_sky()), 1))


@pytest.mark.parametrize("roughness", [0.71, 1.0])
def test_rough_dielectrics_keep_the_glare_of_a_low_sun_without_ggx_samples(roughness: float) -> None:
    """Seen against a sun near the horizon, where Fresnel's term is largest, the dropped lobe matters most."""
    radiance = torch.full((32, 64, 3), 0.05)
    radiance[15, 16] = 500.0  # behind the object, seen from the camera
    scene = PosedScene(None, sphere_mesh(3, albedo=0.1, roughness=roughness), Environment(radiance))
    assert "GGX samples" in left_out(rendered(scene, 1))
    assert_same_mean(scene)


@pytest.mark.parametrize(("roughness", "metallic"), [(0.0, 1.0), (0.24, 0.97), (1.0, 0.03), (0.26, 0.5)])
def test_samples_shared_out_by_material_keep_the_mean_at_the_rules_ends(roughness: float, metallic: float) -> None:
    assert_same_mean(PosedScene(None, two_spheres(roughness=roughness, metallic=metallic), sunny_sky(sun=5.0)))


# Rays above a face's horizon are not traced.


def joined(*shapes: trimesh.Trimesh) -> TriangleMesh:
    return mesh_of(trimesh.util.concatenate(list(shapes)), 0.8, 0.3, 0.5)


def ground() -> trimesh.Trimesh:
    return trimesh.Trimesh([[-2, -2, -1], [2, -2, -1], [2, 2, -1], [-2, 2, -1]], [[0, 1, 2], [0, 2, 3]]).subdivide().subdivide()


def box(size: tuple[float, float, float], at: tuple[float, float, float], inside_out: bool = False) -> trimesh.Trimesh:
    shape = trimesh.creation.box(size)
    shape.apply_translation(at)
    if inside_out:
        shape.invert()
    return shape


def bowl() -> trimesh.Trimesh:
    shape = trimesh.creation.icosphere(3, 1.0)
    shape = trimesh.Trimesh(shape.vertices, shape.faces[shape.triangles_center[:, 2] < 0.2])
    shape.invert()
    return shape


TEMPTING_SHAPES: dict[str, Callable[[], TriangleMesh]] = {
    "a far tower as thin as a needle": lambda: joined(ground(), box((0.01, 0.01, 30.0), (1.9, 1.9, 14.0))),
    "a roof overhead": lambda: joined(ground(), box((2.0, 2.0, 0.05), (0, 0, 0.5))),
    "a leaf a hair above the ground": lambda: joined(ground(), box((1.0, 1.0, 1e-3), (0, 0, -0.998))),
    "a wall that starts in the middle of a face": lambda: joined(ground(), box((0.02, 3.0, 1.0), (0.13, 0, -0.6))),
    "an occluder turned inside out": lambda: joined(ground(), box((0.7, 0.7, 0.7), (0, 0, 0.0), inside_out=True)),
    "the inside of a bowl": lambda: joined(bowl()),
    "a speck high above": lambda: joined(ground(), box((0.05, 0.05, 0.05), (0.3, 0.2, 3.0))),
}


@pytest.mark.slow
@pytest.mark.parametrize("shape", TEMPTING_SHAPES.values(), ids=TEMPTING_SHAPES)
def test_horizons_let_no_ray_off_that_meets_something(shape: Callable[[], TriangleMesh]) -> None:
    scene = PosedScene(None, shape(), sunny_sky(sun=50.0))
    down = Camera(CAMERA.camera_from_world.clone(), CAMERA.intrinsics, CAMERA.width, CAMERA.height)
    angle = math.radians(35)
    tilt = torch.eye(4)
    tilt[1:3, 1:3] = torch.tensor([[math.cos(angle), math.sin(angle)], [-math.sin(angle), math.cos(angle)]])
    down = dataclasses.replace(down, camera_from_world=CAMERA.camera_from_world @ tilt.T)
    for bounces in (0, 2):
        known = rendered(scene, 6, down, horizons=True, bounces=bounces)
        unknown = rendered(scene, 6, down, bounces=bounces)
        assert known.metadata["horizons"]["faces_known"] > unknown.metadata["horizons"]["faces_known"]
        assert float(known.gbuffer.coverage.mean()) > 0.1
        assert torch.equal(known.radiance_linear, unknown.radiance_linear)


def test_horizons_of_a_shape_do_not_outlive_it() -> None:
    """A box far away comes near: what was open sky over the ground is not any more."""
    apart, near = (joined(ground(), box((1.0, 1.0, 0.4), at)) for at in ((40.0, 0.0, 0.0), (0.0, 0.0, -0.2)))
    sky = sunny_sky(sun=50.0)
    before = refine_frame(started(PosedScene(None, apart, sky), horizons=True), 2)
    after = resolve_frame(refine_frame(start_frame(PosedScene(None, near, sky), CAMERA, RenderSettings(), previous=before), 2))
    assert torch.equal(after.radiance_linear, rendered(PosedScene(None, near, sky), 2).radiance_linear)


@pytest.mark.parametrize("error", [0.01, 0.2])
def test_what_hides_more_of_the_sky_than_may_be_given_up_still_hides_it(error: float) -> None:
    mesh = TEMPTING_SHAPES["a roof overhead"]()
    count = len(mesh.vertices)
    mesh = dataclasses.replace(mesh, albedo=torch.ones(count, 3), metallic=torch.zeros(count), roughness=torch.ones(count))
    scene = PosedScene(None, mesh, constant_sky())
    bold, exact = (rendered(scene, 32, horizons=True, bounces=0, skip_error=share) for share in (error, 0.0))
    brighter = (bold.radiance.diffuse - exact.radiance.diffuse)[exact.gbuffer.coverage == 1]
    assert float(brighter.min()) > -1e-6 and float(brighter.max()) <= error + 0.02


# Parts are taken over from the frame before.


def shifted(scene: PosedScene, **mesh_changes: Callable[[torch.Tensor], torch.Tensor]) -> PosedScene:
    changed = {name: change(getattr(scene.mesh, name).clone()) for name, change in mesh_changes.items()}
    return dataclasses.replace(scene, mesh=dataclasses.replace(scene.mesh, **changed))


def nudge(values: torch.Tensor) -> torch.Tensor:
    values[3] += 1e-3
    return values


TEMPTING_EDITS: dict[str, Callable[[PosedScene], PosedScene]] = {
    "one vertex moved by a thousandth": lambda s: shifted(s, vertices=nudge),
    "one shading normal tilted": lambda s: shifted(s, normals=nudge),
    "one vertex a bit rougher": lambda s: shifted(s, roughness=nudge),
    "another sky of the same values": lambda s: dataclasses.replace(s, environment=Environment(s.environment.radiance.clone())),
    "one texel brighter": lambda s: dataclasses.replace(
        s, environment=Environment(nudge(s.environment.radiance.clone().view(-1, 3)).view(16, 32, 3))
    ),
    "turned a full circle": lambda s: dataclasses.replace(s, environment_rotation_degrees=360.0),
    "turned by a hair": lambda s: dataclasses.replace(s, environment_rotation_degrees=1e-3),
    "two faces exchanged": lambda s: shifted(s, faces=lambda f: f[torch.cat([torch.tensor([1, 0]), torch.arange(2, len(f))])]),
}


@pytest.mark.slow
@pytest.mark.parametrize("edit", TEMPTING_EDITS.values(), ids=TEMPTING_EDITS)
def test_a_small_edit_gives_the_bits_of_a_frame_made_from_nothing(edit: Callable[[PosedScene], PosedScene]) -> None:
    scene = PosedScene(None, two_spheres(roughness=0.3, metallic=0.5), sunny_sky(sun=20.0))
    changed = edit(scene)
    before = refine_frame(started(scene), 2)
    after = refine_frame(start_frame(changed, CAMERA, RenderSettings(), previous=before), 2)
    assert torch.equal(resolve_frame(after).radiance_linear, rendered(changed, 2).radiance_linear)


def test_a_camera_moved_by_a_hair_sees_anew() -> None:
    scene = PosedScene(None, two_spheres(roughness=0.3), sunny_sky(sun=20.0))
    pose = CAMERA.camera_from_world.clone()
    pose[0, 3] += 1e-4
    moved = dataclasses.replace(CAMERA, camera_from_world=pose)
    after = refine_frame(start_frame(scene, moved, RenderSettings(), previous=refine_frame(started(scene), 2)), 2)
    assert torch.equal(resolve_frame(after).radiance_linear, rendered(scene, 2, moved).radiance_linear)


# Tiles at rest get no more rays.


def test_tiles_rest_only_once_their_light_is_found() -> None:
    """A narrow lobe finds a small sun's image in few of the pixels; the mean of a frame whose tiles may rest is that of one that never does."""
    scene = PosedScene(None, two_spheres(roughness=0.15, metallic=1.0), sunny_sky(sun=500.0))
    resting, always = (rendered(scene, 128, front_camera(32, 12.0), target_error=error, seed=seed) for error, seed in ((0.2, 0), (None, 1)))
    assert resting.metadata["tiles_at_rest"] > 0
    a, b = mean_and_error(resting)[0], mean_and_error(always)[0]
    assert abs(a - b) < 0.05 * b
