"""An object that is moved rigidly, under a light and before a camera that move with it, gives the picture that it gave."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.render.records import RenderSettings
from drgs.render.render_frame import render_frame
from drgs.scene.camera import camera_from_opengl
from drgs.scene.environment import Environment
from tests.deform.displace.test_hold_handles import handles
from tests.deform.matter.test_simulate import ball_asset
from tests.deform.test_pose_scene import plate_asset, pose

DEGREES = 40.0
TURN = rotation_from_quat_wxyz(torch.tensor([math.cos(math.radians(DEGREES / 2)), 0, 0, math.sin(math.radians(DEGREES / 2))]))
SHIFT = torch.tensor([0.5, -1.0, 0.3])


def soft_sky() -> Environment:
    """Brighter above and to one side, without an edge: the pictures' own noise stays below what is asked."""
    v, u = torch.meshgrid(torch.linspace(0, math.pi, 32), torch.linspace(0, 2 * math.pi, 64), indexing="ij")
    light = 1 + 0.4 * torch.cos(v) + 0.3 * torch.sin(v) * torch.cos(u)
    return Environment(torch.stack([light, 0.9 * light, 0.8 * light], -1))


def by_vertices(asset, folder):
    np.savez(folder / "pose.npz", vertices=(asset.mesh.vertices @ TURN.T + SHIFT).numpy())
    return {"op": "deform", "vertices": "pose.npz"}


def by_handles(asset, folder):
    rest = asset.mesh.vertices
    everywhere = list(range(len(rest)))
    target = rest.mean(0) @ TURN.T + SHIFT
    return handles({"vertices": everywhere, "target": target.tolist(), "turn": [0, 0, DEGREES]})


@pytest.mark.slow
@pytest.mark.parametrize("driver", [by_vertices, by_handles])
@pytest.mark.parametrize("primary", ["gaussians", "mesh"])
def test_a_rigid_motion_of_object_light_and_camera_changes_no_picture(driver, primary, tmp_path):
    asset = replace(plate_asset(), environment=soft_sky())
    # Each surfel at a depth of its own: which of two at the same depth comes first is rounding's to say.
    steps = 5e-4 * torch.arange(len(asset.gaussians.centers))[:, None] * torch.tensor([0, 0, 1.0])
    asset = replace(asset, gaussians=replace(asset.gaussians, centers=asset.gaussians.centers + steps))
    eye = torch.eye(4, dtype=torch.float64)
    eye[2, 3] = 3.0  # from above, looking down
    camera = camera_from_opengl(eye, torch.tensor([[48.0, 0, 24], [0, 48, 24], [0, 0, 1]]), 48, 48)
    motion = torch.eye(4, dtype=torch.float64)
    motion[:3, :3], motion[:3, 3] = TURN.double(), SHIFT.double()
    moved_camera = camera_from_opengl(motion @ eye, camera.intrinsics, 48, 48)
    light = {"op": "environment", "rotation": DEGREES}
    settings = RenderSettings(samples_per_pixel=4096, bounces=0, primary=primary)
    before = render_frame(pose(asset), camera, settings)
    after = render_frame(pose(asset, driver(asset, tmp_path), light, base_directory=tmp_path), moved_camera, settings)
    covered = before.gbuffer.coverage > 0.01
    assert float(covered.float().mean()) > 0.2
    for name in ("coverage", "albedo", "roughness", "metallic"):
        torch.testing.assert_close(getattr(after.gbuffer, name)[covered], getattr(before.gbuffer, name)[covered], atol=1e-3, rtol=0)
    torch.testing.assert_close(after.gbuffer.depth[covered], before.gbuffer.depth[covered], atol=1e-3, rtol=0)
    torch.testing.assert_close(after.gbuffer.normal_world[covered], before.gbuffer.normal_world[covered] @ TURN.T, atol=1e-3, rtol=0)
    difference = (after.rgba_srgb - before.rgba_srgb)[covered].abs()
    assert float(difference.mean()) < 1e-3, f"mean {float(difference.mean()):.1e}, largest {float(difference.max()):.1e}"


@pytest.mark.slow
def test_a_free_fall_before_a_camera_that_falls_along_changes_no_picture():
    """Particles carry the surfels: how far they fell is the scheme's, that nothing else happened is asked here."""
    asset = replace(ball_asset(), environment=soft_sky())
    scene = pose(asset, {"op": "simulate", "scene": {"particles": 400, "duration": 0.5, "fps": 20, "floor": None}, "time": 0.2})
    fallen = (scene.mesh.vertices - asset.mesh.vertices).mean(0)
    assert float(fallen[2]) < -0.1
    eye = torch.eye(4, dtype=torch.float64)
    eye[:3, 3] = torch.tensor([2.0, -1.0, 8.0])
    intrinsics = torch.tensor([[100.0, 0, 24], [0, 100, 24], [0, 0, 1]])
    settings = RenderSettings(samples_per_pixel=512, bounces=0, primary="mesh")
    before = render_frame(pose(asset), camera_from_opengl(eye, intrinsics, 48, 48), settings)
    eye[:3, 3] += fallen
    after = render_frame(scene, camera_from_opengl(eye, intrinsics, 48, 48), settings)
    covered = (before.gbuffer.coverage == 1) & (after.gbuffer.coverage == 1)
    assert float(covered.float().mean()) > 0.2
    torch.testing.assert_close(after.gbuffer.normal_world[covered], before.gbuffer.normal_world[covered], atol=1e-2, rtol=0)
    assert float((after.rgba_srgb - before.rgba_srgb)[covered].abs().mean()) < 1e-3
