"""What is compared pixel by pixel: kernels against operations on whole images in float64."""

from collections.abc import Callable

import pytest
import torch
from torch import Tensor

from drgs.reconstruct.fit import losses
from drgs.reference import image_terms as specified

HEIGHT, WIDTH = 23, 31


def values_and_gradients(of: Callable[..., Tensor], given: list[Tensor], fixed: list[Tensor | float], dtype: torch.dtype) -> list[Tensor]:
    leaves = [x.to(dtype).clone().requires_grad_(True) for x in given]
    value = of(*leaves, *(x.to(dtype) if isinstance(x, Tensor) else x for x in fixed))
    weights = torch.rand(value.shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64).to(value)
    (value * weights).sum().backward()
    return [x.double().cpu() for x in (value.detach(), *(leaf.grad for leaf in leaves))]


def check(name: str, given: list[Tensor], fixed: list[Tensor | float]) -> list[Tensor]:
    """Both agree; what was found."""
    found = values_and_gradients(getattr(losses, name), given, fixed, torch.float32)
    expected = values_and_gradients(getattr(specified, name), given, fixed, torch.float64)
    for one, other in zip(found, expected, strict=True):
        torch.testing.assert_close(one, other, atol=2e-6 * max(1.0, float(other.abs().max())), rtol=2e-5)
    return found


@pytest.mark.parametrize("ceiling", [1.0, 0.8])
def test_images_and_their_gradients_are_those_of_the_display_s_curve(device, ceiling):
    radiance = torch.rand(HEIGHT, WIDTH, 3) ** 3 * 2
    radiance[::7] = 0.0
    radiance[1::7] = 1e-3  # where the curve is a line
    photo = torch.rand(HEIGHT, WIDTH, 3)
    photo[:, ::4] = 1.0
    coverage = torch.rand(HEIGHT, WIDTH)
    coverage[::7] = 0.0
    given = [x.to(device) for x in (radiance, coverage)]
    _, by_radiance, _ = check("display_image", given, [photo.to(device), ceiling])
    beyond = (radiance > 1) & (photo >= 254 / 255 * ceiling)
    assert beyond.any() and float(by_radiance[beyond].abs().max()) == 0


def test_maps_that_are_parts_of_larger_ones_are_shown_as_copies_of_them_are(device):
    whole, photo = torch.rand(40, 50, 3, device=device), torch.rand(HEIGHT, WIDTH, 3, device=device)
    part = whole[5 : 5 + HEIGHT, 7 : 7 + WIDTH]
    coverage = torch.rand(40, 50, device=device)[5 : 5 + HEIGHT, 7 : 7 + WIDTH]
    assert not part.is_contiguous()
    torch.testing.assert_close(
        losses.display_image(part, coverage, photo), losses.display_image(part.contiguous(), coverage.contiguous(), photo), atol=0, rtol=0
    )


def test_no_pixels_are_an_empty_image(device):
    none = torch.zeros(0, 3, device=device, requires_grad=True)
    shown = losses.display_image(none, torch.zeros(0, device=device), torch.zeros(0, 3, device=device))
    shown.sum().backward()
    assert shown.shape == (0, 3) and none.grad is not None and none.grad.shape == (0, 3)


def test_masks_cost_their_cross_entropy_and_nothing_pulls_beyond_its_ends(device):
    coverage, mask = torch.rand(HEIGHT, WIDTH), torch.rand(HEIGHT, WIDTH)
    mask[:5], mask[5:9] = 0.0, 1.0
    coverage[::3], coverage[1::3] = 0.0, 1.0
    _, slope = check("mask_loss", [coverage.to(device)], [mask.to(device)])
    assert float(slope[::3].abs().max()) == float(slope[1::3].abs().max()) == 0


def test_what_is_no_number_is_none_in_the_cost_of_masks(device):
    coverage = torch.full((HEIGHT, WIDTH), 0.5, device=device)
    coverage[3, 4] = torch.nan
    assert torch.isnan(losses.mask_loss(coverage, torch.ones_like(coverage)))


@pytest.mark.parametrize("channels", [1, 3, 5])
@pytest.mark.parametrize("solid", ["some", "none"])
def test_smoothness_is_that_of_solid_neighbours(device, channels, solid):
    maps, photo = torch.rand(HEIGHT, WIDTH, channels), torch.rand(HEIGHT, WIDTH, 3) * 0.2
    maps[:4] = 0.5  # no step
    coverage = torch.zeros(HEIGHT, WIDTH)
    if solid == "some":
        coverage[2:20, 3:] = 0.8 + 0.2 * torch.rand(18, WIDTH - 3)
    value, slope = check("edge_aware_smoothness", [maps.to(device)], [photo.to(device), coverage.to(device)])
    assert (float(value) > 0) == (float(slope.abs().max()) > 0) == (solid == "some")
