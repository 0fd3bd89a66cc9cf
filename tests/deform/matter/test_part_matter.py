"""Matter that comes apart: the faces across a gap go, grains come, and what hangs together stays to the bit as it was."""

import dataclasses
import math

import pytest
import safetensors.torch
import torch
import trimesh

from drgs.deform.clip import ClipFrame, Parted, blend_frames, frame_at, open_clip, save_clip
from drgs.deform.matter import part_matter as step
from drgs.deform.matter.fill_particles import SPACINGS_A_CELL, FillSettings, fill_particles
from drgs.deform.matter.mpm import GridSettings, Material, make_model
from drgs.deform.matter.part_matter import bonds_at_rest, part_matter
from drgs.deform.matter.simulate import Simulation, simulate
from drgs.deform.matter.simulation_scene import parse_simulation_scene
from tests.deform.matter.test_simulate import SMALL, ball_asset

SAND = SMALL | {"particles": 1200, "matter": {"preset": "sand"}, "velocity": [0, 0, -3.0], "duration": 0.4}
"""A ball of sand thrown at the floor."""
HERE = torch.zeros(3)
PLANE = 0.03
"""Where boxes are torn (x); no vertex lies on it."""


def bonds_of(solid: trimesh.Trimesh, law="drucker_prager", particles=600):
    """A solid of one law: its bonds, its particles at rest, its mesh, and the particles' spacing."""
    vertices, faces = torch.tensor(solid.vertices, dtype=torch.float32), torch.tensor(solid.faces, dtype=torch.int32)
    filled = fill_particles(vertices, faces, FillSettings(particles))
    grid = GridSettings((-9, -9, -9), (9, 9, 9), SPACINGS_A_CELL * filled.spacing)
    model = make_model(filled.positions, filled.volumes, (Material(law),), torch.zeros(len(filled.positions), dtype=torch.int64), grid)
    return bonds_at_rest(model, filled.interior, vertices, faces, vertices), model, vertices, faces.long(), filled.spacing


def box(times: int) -> trimesh.Trimesh:
    solid = trimesh.creation.box((2.0, 1.0, 1.0))
    for _ in range(times):
        solid = solid.subdivide()
    return solid


def halves_apart(points, gap):
    """Everything right of the plane moved by the gap."""
    return points + (points[:, :1] > PLANE) * torch.tensor([[gap, 0.0, 0.0]])


@pytest.mark.parametrize("law", ["drucker_prager", "snow", "fixed_corotated", "von_mises", "fluid"])
def test_rigid_motion_and_gentle_strain_part_nothing(law):
    bonds, model, vertices, *_ = bonds_of(box(3), law)
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -2.0, 0.5], [2.0, 0.0, 0.3], [-0.5, -0.3, 0.0]]))
    for move in (torch.eye(3), turn, torch.diag(torch.tensor([1.3, 0.9, 0.9]))):
        assert part_matter(bonds, model.rest @ move.T + 40.0, vertices @ move.T + 40.0, HERE) is None


@pytest.mark.parametrize("law", ["drucker_prager", "fixed_corotated"])
@pytest.mark.parametrize("times", [0, 1, 4])
def test_between_two_halves_pulled_apart_no_face_is_left(law, times):
    bonds, model, vertices, faces, spacing = bonds_of(box(times), law)
    apart = part_matter(bonds, halves_apart(model.rest, 8 * spacing), halves_apart(vertices, 8 * spacing), HERE)
    right = vertices[faces][..., 0] > PLANE
    across = right.any(1) & ~right.all(1)
    assert bool(across.any()) and bool(apart.cut[across].all())
    # Away from the plane, and from faces that reached across it, the mesh is as it was; grains stand at the torn faces only.
    x = (model.rest[bonds.particle, 0] - PLANE).abs()
    shown = apart.shown.reshape(len(x), -1).all(1)
    far = (vertices[faces][..., 0] - PLANE).abs().amin(1) > 4 * spacing
    if times == 4:
        assert bool(far.any()) and not bool(apart.cut[far].any()) and not bool(shown[x > 4 * spacing].any())
    assert float(shown[x < 0.5 * spacing].float().mean()) > 0.95
    assert torch.equal(apart.gone, shown[bonds.under_surfel])
    again = part_matter(bonds, halves_apart(model.rest, 8 * spacing), halves_apart(vertices, 8 * spacing), HERE)
    assert all(torch.equal(a, b) for a, b in zip(vars(apart).values(), vars(again).values(), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("times", [0, 3])
def test_jelly_may_stretch_to_thrice_its_length_and_honey_never_parts(times):
    stretch = torch.tensor([3.0, 0.6, 0.6])
    for law, parts in (("fixed_corotated", False), ("fluid", False), ("drucker_prager", True)):
        bonds, model, vertices, *_ = bonds_of(box(times), law)
        assert (part_matter(bonds, model.rest * stretch, vertices * stretch, HERE) is not None) == parts
    bonds, model, vertices, _, spacing = bonds_of(box(times), "fluid")
    assert part_matter(bonds, halves_apart(model.rest, 20 * spacing), halves_apart(vertices, 20 * spacing), HERE) is None


def test_a_surface_that_its_matter_has_left_is_cut():
    bonds, model, vertices, faces, spacing = bonds_of(box(4), "fixed_corotated")
    strand = vertices + (vertices[:, :1] > 0.8) * torch.tensor([[8 * spacing, 0.0, 0.0]])
    parted = part_matter(bonds, model.rest, strand, HERE)
    assert torch.equal(parted.cut, (vertices[faces][..., 0] > 0.8).any(1)) and bool(parted.shown.any())


@pytest.mark.parametrize("most", [50_000, 250])
def test_grains_have_the_volume_of_the_matter_and_are_no_more_than_their_bound(most, monkeypatch):
    monkeypatch.setattr(step, "MOST_GRAINS", most)
    bonds, model, vertices, *_ = bonds_of(box(3))
    scattered = part_matter(bonds, 5 * model.rest, 5 * vertices, HERE)
    assert bool(scattered.shown.all()) and bool(scattered.cut.all()) and len(scattered.shown) <= most
    assert float(scattered.volumes.sum()) == pytest.approx(2.0, rel=0.02)  # the box's, as well as the lattice tells it


@pytest.fixture(scope="module")
def asset():
    return ball_asset()


@pytest.fixture(scope="module")
def fallen(asset) -> ClipFrame:
    return Simulation(asset, parse_simulation_scene(SAND)).at(0.4)


@pytest.mark.slow
def test_a_fall_of_sand_says_how_many_faces_it_cut_and_free_fall_cuts_none(asset):
    simulation = Simulation(asset, parse_simulation_scene(SAND))
    last = simulation.at(0.4)
    report = simulation.report
    assert report.cut_faces == int(last.parted.cut.sum()) > 0 and report.grains == int(last.parted.shown.sum()) > 0
    assert simulation.frame_bytes > sum(values.nbytes for values in vars(last.parted).values())
    free = Simulation(asset, parse_simulation_scene(SAND | {"floor": None, "spin": [0, 0, 2.0]}))
    assert free.at(0.4).parted is None and free.report.cut_faces == free.report.grains == 0


def test_between_two_frames_grains_move_and_stay_what_they_are(fallen):
    later = dataclasses.replace(fallen.parted, centers=fallen.parted.centers + 1, cut=~fallen.parted.cut)
    between = blend_frames(fallen, dataclasses.replace(fallen, parted=later), 0.25).parted
    assert torch.allclose(between.centers, fallen.parted.centers + 0.25) and bool(between.cut.all())
    whole = dataclasses.replace(fallen, parted=None)
    assert blend_frames(whole, fallen, 0.5).parted is None and blend_frames(fallen, fallen, 0.5).parted is fallen.parted


def test_a_clip_keeps_what_has_parted_and_refuses_what_is_damaged(asset, fallen, tmp_path):
    save_clip(tmp_path / "heap", [fallen, fallen], 24.0, {})
    read = frame_at(open_clip(tmp_path / "heap"), 1.0)
    assert all(torch.equal(a, b) for a, b in zip(vars(read.parted).values(), vars(fallen.parted).values(), strict=True))
    assert isinstance(read.parted, Parted)
    file = tmp_path / "heap" / "frame_00001.safetensors"
    whole = safetensors.torch.load_file(file)
    wrong = [
        ({"vertex": fallen.parted.vertex + 9999}, "names vertices"),
        ({"centers": fallen.parted.centers * math.inf}, "not finite"),
        ({"shown": fallen.parted.shown[1:].clone()}, "parted.shown is"),
        ({"gone": fallen.parted.gone.float()}, "parted.gone is"),
        ({"cut": fallen.parted.cut.float()}, "parted.cut"),
    ]
    for change, sentence in wrong:
        safetensors.torch.save_file(whole | {f"parted.{name}": values for name, values in change.items()}, file)
        with pytest.raises(ValueError, match=sentence):
            frame_at(open_clip(tmp_path / "heap"), 1.0)


@pytest.mark.slow
def test_a_simulation_of_sand_goes_on_from_its_checkpoint_with_its_grains(asset, tmp_path):
    sand = parse_simulation_scene(SAND)
    whole, _ = simulate(asset, sand, tmp_path / "whole")

    def stop(done, total):
        if done == 8:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        simulate(asset, sand, None, stop, checkpoint=tmp_path / "kept")
    simulate(asset, sand, tmp_path / "resumed", checkpoint=tmp_path / "kept")
    assert whole[-1].parted is not None
    for file in sorted((tmp_path / "whole").iterdir()):
        assert file.read_bytes() == (tmp_path / "resumed" / file.name).read_bytes()
