"""The character that dances in the paper's evidence: its surface, its skin, its file and its dance."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from benchmarks.paper.character.body import LAYERS, MATTERS, PARTS, Body, cone_distance, distances, model_body
from benchmarks.paper.character.dance import DURATION, FPS, STEP_HEIGHT, dance_pose, world_joints
from benchmarks.paper.character.rigged_glb import CLIP, write_character
from benchmarks.paper.character.skeleton import INDEX, JOINTS, PARENTS, rest_positions
from benchmarks.paper.character.skin_weights import SkinWeights, skin_weights
from drgs.convert.import_mesh import import_mesh
from drgs.deform.rig.skeleton import pose_rig
from drgs.exchange.gltf_rig import read_gltf_rig
from drgs.exchange.rig import Rig

CELL = 0.025
WORLD_FROM_FILE = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])


@pytest.fixture(scope="module")
def body() -> Body:
    return model_body(CELL)


@pytest.fixture(scope="module")
def skin(body: Body) -> SkinWeights:
    return skin_weights(body)


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("character") / "character.glb"
    write_character(path, CELL)
    return path


def test_the_surface_is_one_closed_manifold_that_looks_outward(body: Body):
    surface = trimesh.Trimesh(body.mesh.vertices.numpy(), body.mesh.faces.numpy(), process=False)
    assert surface.is_watertight and surface.is_winding_consistent and surface.body_count == 1
    assert surface.euler_number == 2, "a sphere with limbs"
    assert 0.07 < surface.volume < 0.1
    assert np.abs(distances(surface.vertices)[0]).max() < 0.1 * CELL
    assert np.linalg.norm(surface.vertices, axis=1).max() < 0.9, "with its arms up it stays in the unit sphere"
    assert (surface.vertex_normals * body.mesh.normals.numpy()).sum(1).mean() > 0.97
    mirrored = surface.vertices * [-1, 1, 1]
    assert np.abs(distances(mirrored)[0]).max() < 0.1 * CELL


def test_every_matter_and_every_joint_has_some_of_the_surface(body: Body):
    albedo = body.mesh.albedo.numpy()
    for name, matter in MATTERS.items():
        assert (np.abs(albedo - matter.albedo).max(1) < 0.02).any(), name
    assert set(np.unique(body.joint)) == {INDEX[layer.joint] for layer in LAYERS} == set(range(len(JOINTS)))
    metal = body.mesh.metallic.numpy() > 0.5
    assert 0.05 < metal.mean() < 0.3


def test_a_cone_of_one_radius_is_as_far_away_as_a_capsule():
    arm = replace(next(part for part in PARTS if part.joint == "left_forearm"), radii=(0.05, 0.05))
    start, end = np.array(arm.start), np.array(arm.end)
    across = np.array([0.0, 1.0, 0.0])
    points = np.stack([0.5 * (start + end) + 0.3 * across, start + (start - end), 0.5 * (start + end)])
    assert cone_distance(points, arm) == pytest.approx([0.25, np.linalg.norm(end - start) - 0.05, -0.05])


def test_cells_that_would_lose_thin_parts_are_refused():
    with pytest.raises(ValueError, match=r"the cells are 0\.05 wide; expected at most 0\.03"):
        model_body(0.05)


def test_weights_sum_to_one_and_stay_with_their_limbs(body: Body, skin: SkinWeights):
    assert skin.weights.shape == skin.joints.shape == (len(body.mesh.vertices), 4)
    assert skin.weights.min() >= 0 and np.allclose(skin.weights.sum(1), 1)
    whole = np.zeros((len(skin.weights), len(JOINTS)))
    np.put_along_axis(whole, skin.joints, skin.weights, 1)
    left = [joint for joint, name in enumerate(INDEX) if name.startswith("left_")]
    right = [joint for joint, name in enumerate(INDEX) if name.startswith("right_")]
    x, _, z = body.mesh.vertices.numpy().T
    limbs = (z < -0.3) | (np.abs(x) > 0.2)
    assert whole[limbs & (x > 0)][:, right].max() < 0.03 and whole[limbs & (x < 0)][:, left].max() < 0.03
    helmet = (body.mesh.metallic.numpy() > 0.5) & (z > 0.6)
    assert helmet.sum() > 20 and whole[helmet, INDEX["head"]].min() > 0.95
    elbow = np.abs(body.mesh.vertices.numpy() - JOINTS[INDEX["left_forearm"]].at).sum(1) < 0.1
    shared = whole[elbow][:, [INDEX["left_upper_arm"], INDEX["left_forearm"]]]
    assert (shared.sum(1) > 0.95).all() and (shared.min(1) > 0.2).any(), "both bones hold the elbow"


def test_the_file_holds_the_character_bit_for_bit(file: Path, body: Body, skin: SkinWeights):
    rig, asset = read_gltf_rig(file), import_mesh(file)
    (mesh,), (rigging,) = rig.meshes, rig.skins
    for name in ("vertices", "faces", "albedo", "roughness", "metallic"):
        assert np.array_equal(getattr(asset.mesh, name).numpy(), getattr(body.mesh, name).numpy()), name
    assert np.abs(asset.mesh.normals.numpy() - body.mesh.normals.numpy()).max() < 1e-6
    assert mesh.joints is not None and mesh.weights is not None
    assert np.array_equal(np.where(mesh.weights > 0, mesh.joints, 0), np.where(skin.weights.astype(np.float32) > 0, skin.joints, 0))
    assert np.abs(mesh.weights - skin.weights).max() < 1e-6
    assert [node.name for node in rig.nodes] == [joint.name for joint in JOINTS] + ["character"]
    assert [node.parent for node in rig.nodes][:-1] == list(PARENTS)
    assert np.allclose(-rigging.joint_from_mesh[:, :3, 3] @ WORLD_FROM_FILE.T, rest_positions(), atol=1e-6)
    (animation,) = rig.animations
    assert (animation.name, animation.duration) == (CLIP, DURATION)


def test_a_rigid_motion_of_the_root_moves_the_whole_skin_rigidly(file: Path):
    rig = read_gltf_rig(file)
    turn, shift = Rotation.from_rotvec([0.3, -1.1, 0.7]), np.array([0.2, -0.1, 0.4])
    root = replace(rig.nodes[0], quat_xyzw=turn.as_quat(), translation=shift)
    assert np.array_equal(rig.nodes[0].translation, [0, 0, 0]), "it turns about the origin"
    moved = pose_rig(replace(rig, nodes=(root, *rig.nodes[1:]))).vertices.numpy()
    assert np.abs(moved - (turn.apply(pose_rig(rig).vertices.numpy()) + shift)).max() < 1e-6


def skinned(rig: Rig, seconds: float) -> np.ndarray:
    """By the formulas of the dance, not by the file's keys; world."""
    places, turned = world_joints(dance_pose(seconds))
    mesh, rest = rig.meshes[0], rest_positions()
    vertices, total = mesh.vertices @ WORLD_FROM_FILE.T, 0.0
    assert mesh.joints is not None and mesh.weights is not None
    for joint, weight in zip(mesh.joints.T, mesh.weights.T, strict=True):
        total = total + weight[:, None] * (turned[joint].apply(vertices - rest[joint]) + places[joint])
    return np.asarray(total)


def test_the_file_dances_as_the_formulas_say_and_begins_and_ends_at_rest(file: Path):
    rig = read_gltf_rig(file)
    rest = pose_rig(rig).vertices.numpy()
    for seconds in (0.0, DURATION):
        assert np.abs(pose_rig(rig, rig.animations[0], seconds).vertices.numpy() - rest).max() < 1e-6
    for seconds in (1 / FPS, 31 / FPS, 82 / FPS):
        moved = pose_rig(rig, rig.animations[0], seconds).vertices.numpy() @ WORLD_FROM_FILE.T
        assert np.abs(moved - skinned(rig, seconds)).max() < 1e-5
    assert np.abs(skinned(rig, 31 / FPS) - rest @ WORLD_FROM_FILE.T).max() > 0.3


def test_legs_reach_their_feet_which_stand_still_or_are_lifted():
    rest, feet = rest_positions(), [INDEX["left_foot"], INDEX["right_foot"]]
    heights = []
    for seconds in np.arange(0, DURATION, 1 / FPS):
        places, turned = world_joints(dance_pose(seconds))
        assert np.isfinite(places).all() and np.isfinite(turned.as_quat()).all()
        lift = places[feet] - rest[feet]
        assert (lift[:, 2] > -1e-9).all() and (lift[:, 2] < STEP_HEIGHT + 1e-9).all()
        standing = lift[:, 2] < 1e-9
        assert standing.any() and np.abs(lift[standing]).max() < 1e-9, "one foot at least stands where it stood"
        heights.append(lift[:, 2])
    assert (np.max(heights, axis=0) > 0.8 * STEP_HEIGHT).all(), "both feet step"
