"""The torus is a workload that the rasteriser's benchmark takes."""

from pathlib import Path

import torch

from benchmarks.render.rasterize import load_workload
from benchmarks.scenes.torus_workload import MAJOR_RADIUS, MINOR_RADIUS, write_torus_workload


def test_a_torus_of_surfels_lies_on_its_surface_and_within_the_picture(tmp_path: Path):
    write_torus_workload(tmp_path / "torus.npz", 500)
    camera, surfels = load_workload(tmp_path / "torus.npz", torch.device("cpu"))
    centers = surfels.centers.detach()
    ring = MAJOR_RADIUS * torch.nn.functional.normalize(centers * torch.tensor([1.0, 1, 0]), dim=-1)
    torch.testing.assert_close((centers - ring).norm(dim=-1), torch.full((500,), MINOR_RADIUS), rtol=1e-4, atol=0)
    # Tangents lie in the surface, at right angles.
    u, v = surfels.tangents.detach().unbind(-1)
    for one, other in ((u, centers - ring), (v, centers - ring), (u, v)):
        torch.testing.assert_close((one * other).sum(-1), torch.zeros(500), rtol=0, atol=1e-6)
    inside = centers @ camera.camera_from_world[:3, :3].T + camera.camera_from_world[:3, 3]
    pixels = (inside @ camera.intrinsics.T)[:, :2] / inside[:, 2:]
    assert inside[:, 2].min() > 1 and pixels.min() > 0 and pixels.max() < camera.width
    assert torch.linalg.det(camera.camera_from_world) > 0.999
