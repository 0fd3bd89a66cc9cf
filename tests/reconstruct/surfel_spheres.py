"""Spheres of surfels and their meshes, shared by the tests of fitting."""

import math

import torch

from drgs.maths.frames import quat_wxyz_from_rotation, tangents_from_normal
from drgs.maths.spherical_harmonics import K00, SH_OFFSET
from drgs.scene.gaussians import Gaussians


def fibonacci_sphere(count: int) -> torch.Tensor:
    """(count, 3) nearly even unit directions."""
    k = torch.arange(count) + 0.5
    z = 1 - 2 * k / count
    azimuth = k * (math.pi * (3 - math.sqrt(5)))
    radius = (1 - z * z).sqrt()
    return torch.stack([radius * azimuth.cos(), radius * azimuth.sin(), z], -1)


def constant_sh(radiance: torch.Tensor) -> torch.Tensor:
    """(n, 16, 3) harmonics of the same radiance (n, 3) towards everywhere."""
    sh = torch.zeros(len(radiance), 16, 3)
    sh[:, 0] = (radiance - SH_OFFSET) / K00
    return sh


def surfel_sphere(
    count: int,
    radius: float = 1.0,
    center: tuple[float, float, float] = (0.0, 0.0, 0.0),
    opacity: float = 0.95,
    overlap: float = 1.0,
    radiance: tuple[float, float, float] = (0.5, 0.5, 0.5),
) -> Gaussians:
    """Surfels in a sphere's surface, `overlap` times as large (one standard deviation) as they are apart; grey plastic."""
    normals = fibonacci_sphere(count)
    quats = quat_wxyz_from_rotation(torch.stack([*tangents_from_normal(normals), normals], -1))
    size = overlap * radius * math.sqrt(4 * math.pi / count) * 0.6
    return Gaussians(
        radius * normals + torch.tensor(center),
        torch.full((count, 2), math.log(size)),
        quats,
        torch.full((count,), math.log(opacity / (1 - opacity))),
        constant_sh(torch.tensor(radiance).expand(count, 3)),
        torch.full((count, 3), 0.5),
        torch.full((count,), 0.5),
        torch.zeros(count),
    )


def joined(*parts: Gaussians) -> Gaussians:
    """All surfels of the parts, in order."""
    return Gaussians(*(torch.cat([getattr(part, name) for part in parts]) for name in Gaussians.__dataclass_fields__))
