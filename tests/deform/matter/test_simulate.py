"""An asset in a simulation: it moves as matter does, plays from a clip, and is at rest again when the edit is undone."""

import json
from dataclasses import replace

import pytest
import torch
import trimesh

from drgs.deform.clip import frame_at, open_clip, save_clip
from drgs.deform.matter.simulate import Simulation, limit_stretch, simulate
from drgs.deform.matter.simulation_scene import make_material, parse_simulation_scene
from drgs.deform.pose_scene import pose_scene
from drgs.scene.asset import Asset
from drgs.scene.edits import parse_edits
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians, surfel_tangents
from drgs.scene.mesh import TriangleMesh, vertex_normals

CENTER = (2.0, -1.0, 5.0)
SMALL = {"particles": 400, "duration": 0.5, "fps": 20}


def ball_asset(surfels=True) -> Asset:
    """A ball of radius 0.5 far from the origin, a surfel on every face."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.5)
    vertices = torch.tensor(ball.vertices + CENTER, dtype=torch.float32)
    faces = torch.tensor(ball.faces, dtype=torch.int32)
    normals = torch.tensor(ball.vertices / 0.5, dtype=torch.float32)
    count = len(faces)
    mesh = TriangleMesh(
        vertices, faces, normals, torch.full_like(vertices, 0.5), torch.full((len(vertices),), 0.5), torch.zeros(len(vertices))
    )
    gaussians = Gaussians(
        vertices[faces.long()].mean(1), torch.full((count, 2), -3.0), torch.randn(count, 4), torch.zeros(count), torch.zeros(count, 16, 3),
        torch.full((count, 3), 0.5), torch.full((count,), 0.5), torch.zeros(count),
    )  # fmt: skip
    return Asset(gaussians if surfels else None, mesh, None, Environment(torch.ones(4, 8, 3)))


def scene(**settings):
    return parse_simulation_scene(SMALL | settings)


def test_an_object_in_free_fall_moves_rigidly_and_as_far_as_gravity_says():
    asset = ball_asset()
    simulation = Simulation(asset, scene(floor=None, spin=[0, 0, 1.0]))
    frame = simulation.at(0.2)
    fallen = frame.vertices.mean(0) - asset.mesh.vertices.mean(0)
    # The scheme updates velocities first: it falls by g t (t + dt) / 2, and so coarse a grid has long steps.
    assert torch.allclose(fallen, torch.tensor([0, 0, -0.5 * 9.81 * 0.04]), atol=8e-3)
    size = (frame.vertices - frame.vertices.mean(0)).norm(dim=-1)
    assert float((size - 0.5).abs().max()) < 5e-3  # a slow spin hardly stretches jelly
    turned = torch.atan2(*(frame.vertices - frame.vertices.mean(0)).T[[1, 0]]) - torch.atan2(
        *(asset.mesh.vertices - torch.tensor(CENTER)).T[[1, 0]]
    )
    assert float(turned[(size > 0.4)].remainder(2 * torch.pi).median()) == pytest.approx(0.2, abs=0.02)
    normals = torch.nn.functional.normalize(frame.vertices - frame.vertices.mean(0), dim=-1)
    assert float((normals * frame.normals).sum(-1).min()) > 0.99
    assert torch.allclose(frame.centers, frame.vertices[asset.mesh.faces.long()].mean(1), atol=2e-2)


@pytest.mark.slow
def test_jelly_on_the_floor_sags_under_its_weight_and_rubber_less():
    sag = {}
    for preset in ("jelly", "rubber"):
        frame = Simulation(ball_asset(surfels=False), scene(matter={"preset": preset}, damping=3.0)).at(0.5)
        sag[preset] = 5.5 - float(frame.vertices[:, 2].max())
        assert frame.centers is None and float(frame.vertices[:, 2].min()) > 4.5 - 0.11  # half a cell
    assert 0.0 < sag["rubber"] < sag["jelly"] < 0.4


def test_simulate_edits_pose_the_scene_are_computed_once_and_undo_bit_for_bit():
    asset = ball_asset()
    edit = {"op": "simulate", "scene": SMALL | {"floor": None}, "time": 0.1}
    before, moved = pose_scene(asset, []), pose_scene(asset, parse_edits([edit]))
    assert float((moved.mesh.vertices - asset.mesh.vertices)[:, 2].mean()) == pytest.approx(-0.049, abs=5e-3)
    assert moved.mesh.albedo is asset.mesh.albedo and moved.surfels.materials.albedo is asset.gaussians.albedo
    again = pose_scene(asset, parse_edits([edit, {"op": "environment", "rotation": 20.0}]))
    assert again.mesh.vertices is moved.mesh.vertices and again.surfels.tangents is moved.surfels.tangents
    undone, at_zero = pose_scene(asset, []), pose_scene(asset, parse_edits([edit | {"time": 0.0}]))
    assert undone.mesh is asset.mesh and undone.surfels.tangents is before.surfels.tangents
    assert at_zero.mesh.vertices is asset.mesh.vertices and at_zero.surfels.tangents is before.surfels.tangents
    # Another time of the same scene continues, it does not begin again; and an earlier one is still known.
    later = pose_scene(asset, parse_edits([edit | {"time": 0.15}]))
    assert float(later.mesh.vertices[:, 2].mean()) < float(moved.mesh.vertices[:, 2].mean())
    assert torch.equal(pose_scene(asset, parse_edits([edit])).mesh.vertices, moved.mesh.vertices)


def test_a_clip_on_disk_plays_what_was_simulated(tmp_path):
    asset = ball_asset()
    frames, report = simulate(asset, scene(floor=None), tmp_path / "fall")
    assert (
        report.frames == len(frames) == 11
        and json.loads((tmp_path / "fall" / "clip.json").read_text())["report"]["particles"] == report.particles
    )
    clip = open_clip(tmp_path / "fall")
    assert torch.equal(frame_at(clip, 0.25).vertices, frames[5].vertices) and torch.equal(frame_at(clip, 9.0).centers, frames[10].centers)
    between = frame_at(clip, 0.225).vertices
    assert torch.allclose(between, (frames[4].vertices + frames[5].vertices) / 2, atol=1e-6)
    posed = pose_scene(asset, parse_edits([{"op": "pose", "clip": "fall", "time": 0.25}]), base_directory=tmp_path)
    assert torch.equal(posed.mesh.vertices, frames[5].vertices) and torch.equal(posed.surfels.tangents, frames[5].tangents)
    with pytest.raises(ValueError, match="made for another object"):
        pose_scene(replace(asset, gaussians=None), parse_edits([{"op": "pose", "clip": "fall", "time": 0.25}]), base_directory=tmp_path)
    with pytest.raises(ValueError, match="outside the folder"):
        pose_scene(asset, parse_edits([{"op": "pose", "clip": "../fall", "time": 0}]), base_directory=tmp_path / "other", confine=True)


def test_damaged_and_foreign_clips_are_refused(tmp_path):
    asset = ball_asset()
    rest = Simulation(asset, scene()).frame(0)
    save_clip(tmp_path / "clip", [rest, rest], 24.0, {})
    frame = tmp_path / "clip" / "frame_00001.safetensors"
    frame.write_bytes(frame.read_bytes()[:1000])
    with pytest.raises(ValueError, match="not a readable frame"):
        frame_at(open_clip(tmp_path / "clip"), 1.0)
    manifest = json.loads((tmp_path / "clip" / "clip.json").read_text())
    (tmp_path / "clip" / "clip.json").write_text(json.dumps(manifest | {"version": 9}))
    with pytest.raises(ValueError, match="version 9"):
        open_clip(tmp_path / "clip")
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "letter.txt").write_text("dear")
    with pytest.raises(ValueError, match="is no clip"):
        save_clip(tmp_path / "other", [rest], 24.0, {})
    assert (tmp_path / "other" / "letter.txt").exists()


def test_an_object_that_nothing_moves_keeps_its_tensors():
    asset = ball_asset()
    frames, report = simulate(asset, scene(gravity=0.0))
    assert report.substeps == 0 and all(frame.vertices is asset.mesh.vertices for frame in frames)


def test_filling_an_object_asks_between_its_steps_whether_to_go_on():
    asked = []
    Simulation(ball_asset(), scene(), go_on=lambda: asked.append(1))
    assert len(asked) == 3

    def stop() -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        Simulation(ball_asset(), scene(), go_on=stop)


@pytest.mark.slow
def test_regions_hold_another_matter_and_acts_hold_parts_in_place():
    hold = {"shape": {"box": {"minimum": [1, -2, 5.2], "maximum": [3, 0, 6]}}, "effect": "sticky"}
    hanging = Simulation(ball_asset(), scene(floor=None, acts=[hold], matter={"preset": "rubber"})).at(0.3)
    assert float(hanging.vertices[:, 2].max()) > 5.45  # else it would have fallen 0.44
    region = {"shape": {"sphere": {"center": [2, -1, 5.4], "radius": 0.3}}, "matter": {"preset": "rubber"}}
    model = Simulation(ball_asset(), scene(regions=[region])).model
    assert 0 < int((model.laws == 1).sum()) < len(model.laws)
    with pytest.raises(ValueError, match="holds no part"):
        Simulation(ball_asset(), scene(regions=[region | {"shape": {"sphere": {"center": [9, 9, 9], "radius": 1}}}]))


@pytest.mark.slow
def test_pinned_vertices_stay_and_the_rest_hangs_from_them():
    asset = ball_asset()
    rest = asset.mesh.vertices
    top = torch.nonzero(rest[:, 2] > 5.3).flatten().tolist()
    frame = Simulation(asset, scene(floor=None, pins=top, particles=1500)).at(0.5)
    moved = (frame.vertices - rest).norm(dim=-1)
    assert float(moved[top].max()) < 0.02
    foot = rest[:, 2] < 4.7
    assert 0.005 < float((rest - frame.vertices)[foot, 2].mean()) < 0.3, "without pins it would have fallen by 1.2"
    with pytest.raises(ValueError, match="pins name vertex 9999; the mesh has 162"):
        Simulation(asset, scene(pins=[3, 9999]))


def test_presets_look_alike_at_every_scale():
    for preset in ("jelly", "rubber", "clay", "sand", "snow", "honey"):
        matter = parse_simulation_scene({"matter": {"preset": preset}}).matter
        small, large = make_material(matter, 0.1, 1.0), make_material(matter, 10.0, 1.0)
        in_millimetres = make_material(matter, 100.0, 1e-3)  # the small one again
        crossing = [
            m.wave_speed / (9.81 / unit * size) ** 0.5 for m, size, unit in ((small, 0.1, 1), (large, 10, 1), (in_millimetres, 100, 1e-3))
        ]
        assert crossing[0] == pytest.approx(crossing[1]) == pytest.approx(crossing[2])
    soft = make_material(parse_simulation_scene({"matter": {"preset": "jelly", "young_modulus": 5e3}}).matter, 1.0, 0.5)
    assert soft.young_modulus == pytest.approx(2.5e3)  # Pa, in kg / (half metre s^2)


@pytest.mark.parametrize(
    ("wrong", "sentence"),
    [
        ({"matter": {"preset": "lead"}}, "matter.preset"),
        ({"matter": {}}, "preset or a law"),
        ({"duration": 1e9}, "duration"),
        ({"acts": [{"shape": {}}]}, "exactly one of plane, sphere, box, mesh"),
        ({"colour": "red"}, "colour"),
        ({"pins": [-1]}, "pins"),
        ({"acts": [{"shape": {"mesh": {"file": "a.obj", "vertices": [[0, 0, 0]] * 4}}}]}, "either a file"),
    ],
)
def test_wrong_scenes_are_refused_by_the_name_of_the_field(wrong, sentence):
    with pytest.raises(ValueError, match=sentence):
        parse_simulation_scene(wrong)


def test_stretches_are_limited_for_the_picture_only_where_they_exceed_it():
    tame = torch.eye(3).expand(4, 3, 3) * 1.5
    assert limit_stretch(tame) is tame
    wild = torch.diag_embed(torch.tensor([[100.0, 1.0, 0.001]]))
    assert torch.allclose(limit_stretch(wild), torch.diag_embed(torch.tensor([[10.0, 1.0, 0.1]])))


def step_mesh():
    """A block whose top is at z = 4.5, where the ball of `ball_asset` begins."""
    block = trimesh.creation.box(bounds=[(0.5, -2.5, 4.0), (3.5, 0.5, 4.5)])
    return {"vertices": block.vertices.tolist(), "faces": block.faces.tolist()}


@pytest.mark.slow
def test_a_ball_lands_on_a_mesh_as_on_the_floor(tmp_path):
    act = {"shape": {"mesh": step_mesh()}, "effect": "separate", "friction": 0.5}
    floor = Simulation(ball_asset(surfels=False), scene()).at(0.3)
    on_mesh = Simulation(ball_asset(surfels=False), scene(floor=None, acts=[act])).at(0.3)
    assert float((floor.vertices - on_mesh.vertices).abs().max()) < 0.01  # of a cell of 0.22
    block = trimesh.creation.box(bounds=[(0.5, -2.5, 4.0), (3.5, 0.5, 4.5)])
    block.apply_translation([0, 0, -4])
    block.export(tmp_path / "block.obj")
    act["shape"] = {"mesh": {"file": "block.obj", "offset": [0, 0, 4]}}
    edit = {"op": "simulate", "scene": SMALL | {"floor": None, "acts": [act]}, "time": 0.3}
    of_file = pose_scene(ball_asset(surfels=False), parse_edits([edit]), base_directory=tmp_path)
    assert float((of_file.mesh.vertices - on_mesh.vertices).abs().max()) < 1e-4


@pytest.mark.slow
def test_a_changed_collider_is_read_again_and_strangers_name_none(tmp_path):
    asset = ball_asset(surfels=False)
    act = {"shape": {"mesh": {"file": "block.obj"}}, "effect": "sticky"}
    edits = parse_edits([{"op": "simulate", "scene": SMALL | {"floor": None, "acts": [act]}, "time": 0.1}])
    block = trimesh.creation.box(bounds=[(0.5, -2.5, 4.8), (3.5, 0.5, 6)])
    block.export(tmp_path / "block.obj")
    held = pose_scene(asset, edits, base_directory=tmp_path).mesh.vertices
    block.apply_translation([0, 0, 30])
    block.export(tmp_path / "block.obj")
    free = pose_scene(asset, edits, base_directory=tmp_path).mesh.vertices
    assert float((held - asset.mesh.vertices)[:, 2].max()) > -0.005 and float((free - asset.mesh.vertices)[:, 2].max()) < -0.04
    act["shape"]["mesh"]["file"] = "../block.obj"
    edits = parse_edits([{"op": "simulate", "scene": SMALL | {"floor": None, "acts": [act]}, "time": 0.1}])
    with pytest.raises(ValueError, match="outside the folder"):
        pose_scene(asset, edits, base_directory=tmp_path / "other", confine=True)
    with pytest.raises(ValueError, match="by its vertices and faces"):
        Simulation(asset, scene(acts=[act]))


def test_a_region_may_be_a_mesh():
    top = trimesh.creation.box(bounds=[(1, -2, 5.2), (3, 0, 6)])
    region = {"shape": {"mesh": {"vertices": top.vertices.tolist(), "faces": top.faces.tolist()}}, "matter": {"preset": "rubber"}}
    box = {"shape": {"box": {"minimum": [1, -2, 5.2], "maximum": [3, 0, 6]}}, "matter": {"preset": "rubber"}}
    models = [Simulation(ball_asset(), scene(regions=[one])).model for one in (region, box)]
    assert torch.equal(models[0].laws, models[1].laws) and int((models[0].laws == 1).sum()) > 0


@pytest.mark.slow
def test_a_body_that_came_to_rest_sleeps_until_something_acts():
    drifting = scene(floor=None, gravity=0.0, velocity=[0.05, 0, 0], damping=60.0, duration=1.0)
    frames, report = simulate(ball_asset(), drifting)
    assert 0 < report.sleeping_frames < 20 and frames[-1].vertices is frames[-2].vertices and frames[-1].tangents is frames[-2].tangents
    assert frames[1].vertices is not frames[0].vertices
    push = {"shape": {"sphere": {"center": [2, -1, 5], "radius": 2}}, "effect": "push", "velocity": [0, 0, 1], "start": 0.7, "end": 1.0}
    awake, report = simulate(ball_asset(), drifting.model_copy(update={"acts": parse_simulation_scene({"acts": [push]}).acts}))
    assert report.sleeping_frames == 0  # it is known that something will act
    assert float((awake[-1].vertices - frames[-1].vertices)[:, 2].mean()) > 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("preset", ["sand", "honey"])
def test_normals_of_matter_that_flows_are_those_of_the_surface_that_it_has_become(preset):
    frame = Simulation(ball_asset(), scene(matter={"preset": preset}, particles=800)).at(0.4)
    faces = ball_asset().mesh.faces.long()
    assert float(frame.vertices[:, 2].max()) < 5.4  # it has slumped
    a, b, c = frame.vertices[faces].unbind(1)
    flat = torch.linalg.cross(b - a, c - a)
    shading = frame.normals[faces].mean(1)
    agree = torch.nn.functional.cosine_similarity(flat, shading)
    area = flat.norm(dim=-1)
    assert float((agree > 0.9).float().mul(area).sum() / area.sum()) > 0.95
    # No surfel is drawn into a needle.
    asset_lengths = torch.linalg.svdvals(surfel_tangents(ball_asset().gaussians))
    assert float((torch.linalg.svdvals(frame.tangents) / asset_lengths).max()) < 3.01


def test_a_handle_that_will_tear_is_named_before_the_first_frame():
    body = trimesh.creation.box((1.0, 1.0, 1.0))
    handle = trimesh.creation.box((1.0, 0.1, 0.1))
    handle.apply_translation((0.5, 0.3, 0.3))
    shape = trimesh.util.concatenate([body, handle])
    vertices, faces = torch.tensor(shape.vertices + CENTER, dtype=torch.float32), torch.tensor(shape.faces, dtype=torch.int32)
    count = len(vertices)
    mesh = TriangleMesh(vertices, faces, vertex_normals(vertices, faces), torch.ones(count, 3), torch.ones(count), torch.zeros(count))
    asset = Asset(None, mesh, None, Environment(torch.ones(4, 8, 3)))
    told: list[str] = []
    _, report = simulate(asset, scene(duration=0.05), progress=lambda done, _: told.append(f"frame {done}"), warn=told.append)
    assert told[1:] == ["frame 1", "frame 2"] and report.warnings == (told[0],)
    assert "6% of the surface belongs to parts thinner than one grid cell" in told[0]
    assert "which may tear: 0.1 about (2.50, -0.70, 5.30); some 8,000 particles would give each of them a cell" in told[0]
    assert Simulation(asset, scene(particles=9000)).warnings == ()
    assert Simulation(asset, scene(matter={"preset": "honey"})).warnings == ()  # what flows does not tear
