"""Sand in a posed scene: cut faces are gone, grains wear what lay over them, and everything that takes a posed scene takes this one."""

import math
from dataclasses import replace

import pytest
import torch
import trimesh

from drgs.convert.bake_edits import bake_edits
from drgs.convert.material_variants import worn_meshes
from drgs.deform.keep_pose import save_pose
from drgs.deform.matter.show_grains import grains_of, show_grains
from drgs.deform.matter.simulate import Simulation
from drgs.deform.matter.simulation_scene import parse_simulation_scene
from drgs.deform.pose_scene import pose_scene
from drgs.maths.constants import MIN_COVERAGE
from drgs.reference.trace_spheres import trace_spheres
from drgs.render.progressive.invalidate import changed_in_scene
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.render.visible.paint_certainty import certainty_colors, paint_certainty
from drgs.scene.albedo_detail import ONE, AlbedoDetail
from drgs.scene.asset import Asset, load_asset, save_asset
from drgs.scene.binding import Binding
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.certainty import Certainty
from drgs.scene.edits import parse_edits
from tests.deform.matter.test_part_matter import SAND
from tests.deform.matter.test_simulate import ball_asset

FALL = {"op": "simulate", "scene": SAND, "time": 0.2}
"""A third of the ball still has its surface."""
SIDE = 96
"""Of a picture in which a grain of 400 particles is four pixels wide."""


@pytest.fixture(scope="module")
def asset() -> Asset:
    ball = ball_asset()
    count, vertices = len(ball.mesh.faces), ball.mesh.vertices
    paint = (vertices - vertices.amin(0)) / (vertices.amax(0) - vertices.amin(0))
    codes = torch.randint(64, 192, (count, 3, 3), generator=torch.Generator().manual_seed(9), dtype=torch.uint8)
    mesh = replace(ball.mesh, albedo=paint, roughness=paint[:, 0].contiguous(), detail=AlbedoDetail(codes))
    binding = Binding(torch.arange(count, dtype=torch.int32), torch.full((count, 3), 1 / 3), torch.zeros(count))
    known = Certainty(*(torch.rand(len(vertices), generator=torch.Generator().manual_seed(k)).half() for k in range(4)))
    return replace(ball, mesh=mesh, binding=binding, certainty=known)


@pytest.mark.slow
def test_cut_faces_are_left_out_and_grains_wear_what_is_nearest_to_them(asset):
    scene = pose_scene(asset, parse_edits([FALL]))
    count, source = len(asset.mesh.vertices), scene.vertex_source
    assert len(scene.mesh.vertices) == len(source) > count and torch.equal(source[:count], torch.arange(count))
    own = scene.mesh.faces[(scene.mesh.faces < count).all(1)]
    grains = scene.mesh.faces[(scene.mesh.faces >= count).all(1)]
    assert len(own) + len(grains) == len(scene.mesh.faces) and 0 < len(own) < len(asset.mesh.faces) and len(grains) % 20 == 0
    detail, kept = scene.mesh.detail, asset.mesh.detail
    assert kept is not None and detail is not None and detail.codes.shape == (len(scene.mesh.faces), *kept.codes.shape[1:])
    numbers = {tuple(face): number for number, face in enumerate(asset.mesh.faces.tolist())}
    assert torch.equal(detail.codes[: len(own)], kept.codes[[numbers[tuple(face)] for face in own.tolist()]]), "faces keep their pattern"
    assert torch.equal(detail.codes[len(own) :], torch.full_like(detail.codes[len(own) :], ONE)), "grains have none"
    assert torch.equal(scene.mesh.albedo, asset.mesh.albedo[source]) and torch.equal(scene.mesh.roughness, asset.mesh.roughness[source])
    assert scene.horizons is None
    # Grains are closed, and face outward.
    solid = trimesh.Trimesh(scene.mesh.vertices.double().numpy(), grains.numpy(), process=False)
    assert solid.is_watertight and solid.volume > 0
    # Where a grain stands, no surfel of the surface is seen.
    rest = pose_scene(asset, [])
    faded = scene.surfels.opacities[: len(asset.gaussians.centers)]
    assert int((faded == 0).sum()) > 0 and torch.equal(faded[faded > 0], rest.surfels.opacities[faded > 0])
    assert len(scene.surfels.centers) - len(faded) == len(scene.surfel_source) == 6 * len(grains) // 20


@pytest.mark.slow
def test_a_grain_has_the_volume_of_its_particle(asset):
    frame = Simulation(asset, parse_simulation_scene(SAND)).at(0.4)
    everything = replace(frame.parted, shown=torch.ones_like(frame.parted.shown), cut=torch.ones_like(frame.parted.cut))
    shown = grains_of(replace(asset.mesh, vertices=frame.vertices), None, everything)
    solid = trimesh.Trimesh(shown.vertices.double().numpy(), shown.faces.numpy(), process=False)
    assert solid.volume == pytest.approx(float(everything.volumes.double().sum()), rel=1e-5)
    assert solid.volume == pytest.approx(4 / 3 * math.pi * 0.5**3, rel=0.06)  # of the ball, whose mesh has 320 faces


def test_edits_around_a_fall_change_what_they_name_and_nothing_else(asset):
    gold = {"op": "material", "select": {"all": True}, "set": {"albedo": [0.9, 0.6, 0.2]}, "mode": "absolute"}
    fallen, same = pose_scene(asset, parse_edits([FALL])), pose_scene(asset, parse_edits([FALL]))
    assert changed_in_scene(fallen, same) == frozenset()
    golden = pose_scene(asset, parse_edits([FALL, gold]))
    assert changed_in_scene(fallen, golden) == {"materials"} and torch.allclose(golden.mesh.albedo, torch.tensor([0.9, 0.6, 0.2]))
    # What comes after moves grains along with the rest; what says where everything is makes the object whole.
    stretched = pose_scene(asset, parse_edits([FALL, {"op": "deform", "map": {"type": "stretch", "factor": 1.5}}]))
    count = len(asset.mesh.vertices)
    middles = [scene.mesh.vertices[count:].reshape(-1, 12, 3).mean(1) for scene in (fallen, stretched)]
    assert torch.allclose(middles[1][:, 2], 1.5 * middles[0][:, 2], atol=1e-5)
    handles = {"drag": [{"point": [2, -1, 5.5], "radius": 0.2, "target": [2, -1, 6.0]}], "pin": [{"point": [2, -1, 4.5], "radius": 0.2}]}
    dragged = pose_scene(asset, parse_edits([FALL, {"op": "deform", "handles": handles}]))
    assert len(dragged.mesh.vertices) == len(fallen.mesh.vertices) and bool(dragged.mesh.vertices.isfinite().all())
    at_rest = pose_scene(asset, parse_edits([FALL, FALL | {"time": 0.0}]))
    assert at_rest.mesh.faces is asset.mesh.faces and at_rest.vertex_source is None


def test_a_fall_is_kept_as_a_version_that_opens_again(asset, tmp_path):
    edits = parse_edits([FALL])
    scene, made = pose_scene(asset, edits), bake_edits(asset, edits, tmp_path, 2)
    assert torch.equal(made.mesh.vertices, scene.mesh.vertices) and len(made.certainty.shape) == len(scene.mesh.vertices)
    assert len(made.gaussians.centers) == int((scene.surfels.opacities > 0).sum()) == len(made.binding.face)
    assert float(made.gaussians.opacity_logits[-1].sigmoid()) == pytest.approx(0.95)
    save_asset(made, tmp_path / "heap")
    assert len(load_asset(tmp_path / "heap").mesh.faces) == len(scene.mesh.faces)
    red = parse_edits([{"op": "material", "select": {"all": True}, "set": {"albedo": [0.6, 0, 0]}, "mode": "absolute"}])
    worn = worn_meshes(asset, made.mesh, {"Red": red}, tmp_path, scene.vertex_source)["Red"]
    assert len(worn.albedo) == len(made.mesh.vertices) and torch.allclose(worn.albedo, torch.tensor([0.6, 0.0, 0.0]))
    assert not save_pose(asset, edits, tmp_path / "kept")


def test_certainty_of_a_grain_is_that_of_the_surface_over_it(asset):
    scene = pose_scene(asset, parse_edits([FALL]))
    painted, colors = paint_certainty(scene, asset.mesh.faces, asset.certainty, asset.binding), certainty_colors(asset.certainty)
    assert torch.equal(painted.mesh.albedo, colors[scene.vertex_source])
    own = len(asset.gaussians.centers)
    assert torch.allclose(painted.surfels.materials.albedo[:own], colors[asset.mesh.faces.long()].mean(1), atol=1e-3)
    assert torch.equal(painted.surfels.materials.albedo[own:], colors[scene.surfel_source])


@pytest.mark.slow
@pytest.mark.parametrize(("primary", "least", "radius"), [("mesh", 0.95, 0.15), ("gaussians", 0.85, 0.75)])
def test_a_picture_of_a_heap_is_that_of_balls_of_the_grains_volume(asset, primary, least, radius):
    frame = Simulation(asset, parse_simulation_scene(SAND | {"particles": 400})).at(0.4)
    parted = frame.parted
    everything = replace(parted, shown=torch.ones_like(parted.shown), cut=torch.ones_like(parted.cut))
    scene = pose_scene(asset, parse_edits([FALL]))
    moved = replace(scene, vertex_source=None)
    moved_surfels = None
    if primary == "gaussians":
        rest = pose_scene(asset, []).surfels
        moved_surfels = replace(rest, opacities=torch.zeros_like(rest.opacities))
        everything = replace(everything, gone=torch.ones_like(parted.gone))
    whole = replace(moved, mesh=replace(asset.mesh, vertices=frame.vertices, normals=frame.normals), surfels=moved_surfels)
    heap = show_grains(whole, grains_of(whole.mesh, whole.surfels, everything))
    camera = looking_down(frame.parted.centers.mean(0), SIDE)
    seen = render_frame(heap, camera, RenderSettings(samples_per_pixel=16, bounces=0, primary=primary)).gbuffer
    origin, directions = pixel_rays_world(camera)
    radii = (parted.volumes.double() * 3 / (4 * math.pi)) ** (1 / 3)
    depth, ball, _ = trace_spheres(parted.centers, radii, origin, directions.reshape(-1, 3))
    hit, shown = (ball >= 0).reshape(SIDE, SIDE), seen.coverage > max(0.5, MIN_COVERAGE)
    assert float((hit & shown).sum() / (hit | shown).sum()) > least
    along = (depth.reshape(SIDE, SIDE) * (directions.double() @ camera.camera_from_world[2, :3].double())).float()
    both = hit & shown
    # An icosahedron of a ball's volume lies within a sixth of its surface; its surfels are flat, and blend with what lies behind.
    assert float((seen.depth - along)[both].abs().median()) < radius * float(radii.mean())


def looking_down(target: torch.Tensor, size: int) -> Camera:
    """From two units away, along x and down."""
    back = torch.nn.functional.normalize(torch.tensor([1.0, 0.0, 1.0]), dim=0)
    right = torch.tensor([0.0, 1.0, 0.0])
    rotation = torch.stack([right, torch.linalg.cross(-back, right), -back])
    world = torch.eye(4)
    world[:3, :3], world[:3, 3] = rotation, -rotation @ (target + 2 * back)
    k = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]])
    return Camera(world, k, size, size)
