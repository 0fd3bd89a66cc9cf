"""Pixels picked from blended maps: kernels against operations in float64."""

from dataclasses import replace

import pytest
import torch

from drgs.reconstruct.fit.surfels.covered_pixels import LEAST_COVERAGE, covered_pixels
from drgs.reference.covered_pixels import covered_pixels as specified
from tests.render.closed_form_scenes import front_camera


@pytest.mark.parametrize("covered", ["some", "none"])
def test_values_and_gradients_are_those_of_operations_on_whole_maps(device, covered):
    camera = replace(front_camera(), width=29, height=17)
    coverage = torch.rand(17, 29)
    coverage[:3], coverage[3:5] = 0.0, LEAST_COVERAGE * 1.2
    features = torch.randn(13, 17, 29) * coverage  # half of the normals look away
    pixels = (coverage.flatten() > (LEAST_COVERAGE if covered == "some" else 2)).nonzero().squeeze(1)
    pixels = torch.cat([pixels, torch.arange(29)[: len(pixels)]])  # and some that are hardly covered
    results = []
    for of, dtype in ((covered_pixels, torch.float32), (specified, torch.float64)):
        leaves = [x.to(device, dtype).clone().requires_grad_(True) for x in (features, coverage)]
        found = of(*leaves, pixels.to(device), camera.to(device))
        weights = [
            torch.randn(x.shape, generator=torch.Generator().manual_seed(k), dtype=torch.float64).to(x) for k, x in enumerate(found[:5])
        ]
        torch.stack([(x * w).sum() for x, w in zip(found[:5], weights, strict=True)]).sum().backward()
        results.append([x.detach().double().cpu() for x in (*found, *(leaf.grad for leaf in leaves))])
    assert len(results[0][0]) == len(pixels) > (100 if covered == "some" else -1)
    for one, other in zip(*results, strict=True):
        scale = float(other.abs().max()) if other.numel() else 0.0
        torch.testing.assert_close(one, other, atol=3e-6 * max(1.0, scale), rtol=1e-4)
