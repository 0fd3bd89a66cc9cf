"""The environment out of focus, for standing behind an object; what lights the object stays sharp.

In: an environment of any size. Out: a small table, blurred on the sphere by a von Mises-Fisher lobe (Fisher 1953), the sphere's Gaussian. The
viewer's local picture blurs by the same formula and the same constants (web/src/stage/blur_environment.ts).
"""

import math
from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor

from drgs.render.integrate.environment_table import EnvironmentTable, build_environment_table, environment_light
from drgs.scene.environment import Environment

HEIGHT = 64
"""Rows of the blurred table."""
BLUR_DEGREES = 7.0
"""Standard deviation of the lobe."""


def blur_environment(environment: Environment) -> Environment:
    """(HEIGHT, 2 HEIGHT, 3) of an environment."""
    small = _shrink(environment.radiance.double())
    polar = (torch.arange(HEIGHT, device=small.device, dtype=small.dtype) + 0.5) * (math.pi / HEIGHT)
    azimuth = torch.arange(2 * HEIGHT, device=small.device, dtype=small.dtype) * (math.pi / HEIGHT)
    across = torch.sin(polar)[:, None, None] * torch.sin(polar)[None, :, None] * torch.cos(azimuth)
    along = torch.cos(polar)[:, None, None] * torch.cos(polar)[None, :, None]
    lobe = torch.exp((across + along - 1) / math.radians(BLUR_DEGREES) ** 2) * torch.sin(polar)[None, :, None]
    lobe = lobe / lobe.sum((1, 2), keepdim=True)
    # Rows are circles, so the sum over each source row is a convolution along it.
    turned = torch.einsum("ijf,jfc->ifc", torch.fft.rfft(lobe), torch.fft.rfft(small, dim=1))
    blurred = torch.fft.irfft(turned, n=2 * HEIGHT, dim=1).clamp(min=0)
    return Environment(blurred.to(environment.radiance))


def _shrink(radiance: Tensor) -> Tensor:
    """(HEIGHT, 2 HEIGHT, 3) means over the texels that each small texel touches, rows weighed by the sine of their polar angle."""
    height = radiance.shape[0]
    weight = torch.sin((torch.arange(height, device=radiance.device, dtype=radiance.dtype) + 0.5) * (math.pi / height))[:, None, None]
    pool = torch.nn.AdaptiveAvgPool2d((HEIGHT, 2 * HEIGHT))
    small = pool((radiance * weight).permute(2, 0, 1)) / pool(weight.expand(height, 2 * height, 1).permute(2, 0, 1))
    return small.permute(1, 2, 0)


_blurred: WeakKeyDictionary[Environment, EnvironmentTable] = WeakKeyDictionary()
"""Of environments that live."""


def blurred_light(environment: Environment, rotation_degrees: float, intensity: float) -> Any:
    """EnvironmentLight struct of the blurred environment, for looking up; blurred once for each environment."""
    if environment not in _blurred:
        _blurred[environment] = build_environment_table(blur_environment(environment))
    return environment_light(_blurred[environment], rotation_degrees, intensity)
