"""Tangents and features of surfels, and their gradients, against the float64 twin."""

import pytest
import torch

from drgs.maths.frames import rotation_from_quat_wxyz
from drgs.reconstruct.fit.surfels.surfel_features import CHANNELS, surfel_features
from drgs.reference import surfel_features as reference

CAMERA = torch.tensor([0.3, -2.5, 1.0])


def random_surfels(count: int = 300) -> dict[str, torch.Tensor]:
    generator = torch.Generator().manual_seed(4)
    sizes = {
        "centers": (3,), "quats": (4,), "log_scales": (2,), "albedo_logits": (3,), "roughness_logits": (), "metallic_logits": (), "sh_dc": (1, 3),
        "sh_rest": (15, 3),
    }  # fmt: skip
    return {name: torch.randn(count, *size, generator=generator, dtype=torch.float64) for name, size in sizes.items()}


def leaves(values: dict[str, torch.Tensor], dtype: torch.dtype, device: torch.device) -> dict[str, torch.Tensor]:
    return {name: value.to(device, dtype).requires_grad_(True) for name, value in values.items()}


@pytest.mark.parametrize("shadowed", [False, True])
@pytest.mark.parametrize("degree", [0, 1, 3])
def test_features_and_their_gradients_are_the_twins(degree: int, shadowed: bool, device: torch.device) -> None:
    surfels, generator = random_surfels(), torch.Generator().manual_seed(5)
    share = torch.rand(300, 3, generator=generator, dtype=torch.float64) if shadowed else None
    by_tangents, by_features = (torch.randn(300, *size, generator=generator, dtype=torch.float64) for size in ((3, 2), (CHANNELS,)))
    found, twin = leaves(surfels, torch.float32, device), leaves(surfels, torch.float64, torch.device("cpu"))

    tangents, features = surfel_features(found, CAMERA.to(device), degree, None if share is None else share.to(device, torch.float32))
    expected = reference.surfel_features(twin, CAMERA.double(), degree, share)
    torch.testing.assert_close(tangents.detach().cpu().double(), expected[0].detach(), atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(features.detach().cpu().double(), expected[1].detach(), atol=1e-5, rtol=1e-5)
    assert 0.1 < float((expected[1][:, :3].detach() * twin_normals(twin)).sum(-1).lt(0).double().mean()) < 0.6  # some are turned round

    ((tangents * by_tangents.to(tangents)).sum() + (features * by_features.to(features)).sum()).backward()
    ((expected[0] * by_tangents).sum() + (expected[1] * by_features).sum()).backward()
    for name, value in found.items():
        if name == "centers" or (name == "sh_rest" and degree == 0):
            assert value.grad is None, name
            continue
        assert value.grad is not None, name
        wanted = twin[name].grad
        assert wanted is not None and float(wanted.abs().max()) > 0
        torch.testing.assert_close(value.grad.cpu().double(), wanted, atol=2e-5 * float(wanted.abs().max()), rtol=1e-4)


def twin_normals(surfels: dict[str, torch.Tensor]) -> torch.Tensor:
    """Of the surfels as they lie."""
    return rotation_from_quat_wxyz(surfels["quats"].detach())[:, :, 2]


def test_no_surfels_have_no_features(device: torch.device) -> None:
    none = {name: value[:0] for name, value in leaves(random_surfels(), torch.float32, device).items()}
    tangents, features = surfel_features(none, CAMERA.to(device), 3)
    assert tangents.shape == (0, 3, 2) and features.shape == (0, CHANNELS)
