"""Angles in kernels against the library's, at the seams too."""

import math

import torch
import warp as wp

from drgs.maths.angles_warp import arc_cosine, azimuth
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


@wp.kernel
def angles(first: int, x: wp.array[float], y: wp.array[float], arc: wp.array[float], around: wp.array[float]):
    i = first + wp.tid()
    arc[i] = arc_cosine(x[i])
    around[i] = azimuth(x[i], y[i])


def test_angles_are_those_of_the_library(device: str):
    line = torch.linspace(-1, 1, 201)
    x, y = (values.flatten().contiguous().to(device) for values in torch.meshgrid(line, line, indexing="ij"))
    found = [torch.empty_like(x) for _ in range(2)]
    launch(angles, len(x), [warp_array(x), warp_array(y)], [warp_array(values) for values in found], warp_device(x))
    assert float((found[0] - torch.arccos(x)).abs().max()) < 1e-6
    error = (found[1] - torch.atan2(y, x)).abs()
    assert float(torch.minimum(error, 2 * math.pi - error).max()) < 1e-6
