"""The surfels themselves: small opaque discs, each in a colour of its own, for seeing how many there are and how they lie.

In: posed surfels and a camera. Out: straight sRGB with alpha. What they carry (material, opacity) does not show; discs that are seen
edge-on are darker, so that the shape can be read.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.constants import MIN_COVERAGE
from drgs.render.visible.rasterize import RasterSettings, rasterize
from drgs.render.visible.rasterize.near_plane import near_plane_of
from drgs.scene.camera import Camera
from drgs.scene.posed_scene import PosedSurfels

GOLDEN = 0.6180339887498949
"""Of the colour circle from one surfel to the next: neighbours in the list never look alike."""
STEEPNESS = 20.0
"""Opacity in the middle of a disc, which the rasteriser caps: the Gaussian is opaque up to OPAQUE_RADIUS and then falls off at once."""
OPAQUE_RADIUS = 2.45
"""[standard deviations]; sqrt(2 ln STEEPNESS)."""
DISC_RADIUS = 1.0
"""Of a disc [standard deviations of the surfel]."""
EDGE_ON = 0.35
"""Brightness of a disc that is seen from the side, as a share."""


def draw_surfels(surfels: PosedSurfels, camera: Camera, band: slice | None = None) -> Float[Tensor, "height width 4"]:
    """sRGB with straight alpha, 0..1; the nearest disc hides those behind it.

    Args:
        band: rows of the image, from a tile's edge to a tile's edge; None: all.
    """
    count, device = len(surfels.centers), surfels.centers.device
    camera = camera.to(device)
    normals = torch.nn.functional.normalize(torch.linalg.cross(surfels.tangents[..., 0], surfels.tangents[..., 1]), dim=-1, eps=1e-20)
    towards = torch.nn.functional.normalize(surfels.centers - camera.center_world, dim=-1)
    facing = (normals * towards).sum(-1, keepdim=True).abs()
    colors = surfel_colors(count, device) * (EDGE_ON + (1 - EDGE_ON) * facing)
    maps = rasterize(
        surfels.centers,
        surfels.tangents * (DISC_RADIUS / OPAQUE_RADIUS),
        torch.full((count,), STEEPNESS, device=device),
        colors,
        camera,
        RasterSettings(near=near_plane_of(surfels.centers), depth=False),
        band=band,
    )
    mean = maps.features.permute(1, 2, 0) / maps.coverage.clamp(min=MIN_COVERAGE)[..., None]
    return torch.cat([mean, maps.coverage[..., None]], -1).clamp(0, 1)


def surfel_colors(count: int, device: torch.device | str = "cpu") -> Float[Tensor, "surfel 3"]:
    """sRGB; a hue each, fully saturated ones mixed with a quarter of white."""
    hue = (torch.arange(count, device=device, dtype=torch.float64) * GOLDEN) % 1
    offsets = torch.tensor([0.0, 2 / 3, 1 / 3], device=device, dtype=torch.float64)
    pure = (((hue[:, None] + offsets) % 1 * 6 - 3).abs() - 1).clamp(0, 1)
    return (0.25 + 0.75 * pure).float()
