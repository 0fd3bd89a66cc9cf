"""Patches of a surface looked up in photographs, against the same as operations on whole tensors in float64."""

import torch
from torch import Tensor

from drgs.reconstruct.fit.evidence.matched_texture import PATCH, smooth_patches
from drgs.reconstruct.fit.evidence.patch_kernels import PackedPictures, patterns_of_patches
from drgs.scene.camera import Camera
from tests.reconstruct.fit.evidence.test_matched_texture import cameras_above

FAINT = 0.07


def patterns_twin(
    vertices: Tensor,
    normals: Tensor,
    depths: Tensor,
    across: Tensor,
    view: Tensor,
    counts: Tensor,
    cameras: list[Camera],
    pictures: list[Tensor],
    smooth: Tensor,
) -> Tensor:
    """The specification."""
    patterns = torch.zeros(len(vertices), len(depths), view.shape[1], across.shape[1], dtype=torch.float64)
    for i, slot in counts.nonzero().tolist():
        camera, picture = cameras[int(view[i, slot])], pictures[int(view[i, slot])].double()
        transform, intrinsics = camera.camera_from_world.double(), camera.intrinsics.double()
        at = vertices[i].double() + depths.double()[:, None, None] * normals[i].double() + across[i].double()
        seen = (at @ transform[:3, :3].T + transform[:3, 3]) @ intrinsics.T
        grid = 2 * (seen[..., :2] / seen[..., 2:]) / torch.tensor([camera.width, camera.height]) - 1
        shown = torch.nn.functional.grid_sample(picture[None, None], grid[None], padding_mode="border", align_corners=False)[0, 0]
        shown = shown - torch.linalg.lstsq(smooth.double().T, shown.T).solution.T @ smooth.double()
        patterns[i, :, slot] = shown / (shown.norm(dim=-1, keepdim=True) + FAINT)
    return patterns


def made_patches(generator: torch.Generator) -> tuple[list[Camera], list[Tensor], tuple[Tensor, ...]]:
    """Six vertices in three of four views of different sizes; two patches reach beyond a picture's border, one pair does not count."""
    cameras, pictures = [], []
    for number, camera in enumerate(cameras_above(4)):
        width, height = 128 - 7 * number, 128 - 11 * number
        cameras.append(Camera(camera.camera_from_world, camera.intrinsics, width, height, camera.name))
        pictures.append(torch.rand(height, width, generator=generator))
    vertices = 0.4 * torch.randn(6, 3, generator=generator) * torch.tensor([1.0, 1.0, 0.2])
    vertices[:2] = torch.tensor([[1.04, 0.1, 0.0], [-0.2, -1.05, 0.05]])
    normals = torch.nn.functional.normalize(torch.randn(6, 3, generator=generator), dim=-1)
    across = 0.05 * torch.randn(6, 49, 3, generator=generator)
    view = torch.stack([torch.randperm(4, generator=generator)[:3] for _ in range(6)])
    counts = torch.ones(6, 3, dtype=torch.bool)
    counts[4, 1] = False
    return cameras, pictures, (vertices, normals, torch.linspace(-0.1, 0.06, 5), across, view, counts)


def test_patterns_are_those_of_whole_tensors(device: str) -> None:
    smooth = smooth_patches(torch.device("cpu"))
    cameras, pictures, patches = made_patches(torch.Generator().manual_seed(3))
    expected = patterns_twin(*patches, cameras, pictures, smooth)
    moved = [camera.to(torch.device(device)) for camera in cameras]
    packed = PackedPictures(moved, [picture.to(device) for picture in pictures])
    found = patterns_of_patches(*(x.to(device) for x in patches), packed, smooth.to(device), FAINT).cpu().double()
    torch.testing.assert_close(found, expected, atol=2e-5, rtol=0)
    assert not found[4, :, 1].any()


def test_faint_patches_keep_their_digits() -> None:
    smooth = smooth_patches(torch.device("cpu"))
    cameras, pictures, patches = made_patches(torch.Generator().manual_seed(4))
    bright = [0.9 + 1e-4 * picture for picture in pictures]
    found = patterns_of_patches(*patches, PackedPictures(cameras, bright), smooth, FAINT)
    torch.testing.assert_close(found.double(), patterns_twin(*patches, cameras, bright, smooth), atol=2e-5, rtol=0)


def test_smooth_patches_are_all_polynomials_of_degree_two():
    smooth = smooth_patches(torch.device("cpu")).double()
    torch.testing.assert_close(smooth @ smooth.T, torch.eye(6, dtype=torch.float64), atol=1e-6, rtol=0)
    x, y = torch.cartesian_prod(*(2 * [torch.linspace(-1, 1, PATCH, dtype=torch.float64)])).unbind(-1)
    made = 0.3 + 0.5 * x - 0.2 * y + 0.7 * x * x - 0.4 * x * y + 0.9 * y * y
    torch.testing.assert_close((made @ smooth.T) @ smooth, made, atol=1e-6, rtol=0)
