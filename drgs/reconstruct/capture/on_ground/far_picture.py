"""What lies far behind the object, by direction alone, and where each picture shows it.

From around the object a direction is seen past it by most cameras that see it at all. Where surroundings are near, pictures disagree, and nothing is
known. In: cameras, pictures. Out: colours by direction, and the logarithm of how likely a camera's pixels are if they show them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from drgs.reconstruct.capture.on_ground.agreed_colors import Agreement, agreed_colors, asked_views, color_likelihood, seen_colors
from drgs.scene.camera import Camera, pixel_rays_world
from drgs.scene.environment import direction_from_uv, uv_from_direction

ROWS = 128
MOST_VIEWS = 150
"""That are asked: each direction is in the picture of few."""
AGREEMENT = Agreement(agreeing=0.5)
"""More than for the ground: no sparse points tell where an object hides a direction from all."""


@dataclass(frozen=True, eq=False)
class FarPicture:
    """In the environment's layout."""

    table: Float[Tensor, "5 rows columns"]
    """Colour [sRGB 0..1], standard deviation of one channel, and 1 where known."""


def far_picture(
    cameras: Sequence[Camera],
    images_srgb: Sequence[UInt8[Tensor, "_height _width 3"]],
    free: Sequence[Bool[Tensor, "_height _width"]] | None,
) -> FarPicture:
    """Gather it.

    Args:
        free: of each picture, the pixels that may show what is far; None: all.
    """
    v, u = torch.meshgrid((torch.arange(ROWS) + 0.5) / ROWS, (torch.arange(2 * ROWS) + 0.5) / (2 * ROWS), indexing="ij")
    directions = direction_from_uv(torch.stack([u, v], -1)).reshape(-1, 3)
    seen = []
    for number in asked_views(len(cameras), MOST_VIEWS):
        camera = cameras[number]
        projected = directions @ (camera.intrinsics @ camera.camera_from_world[:3, :3]).T
        seen.append(seen_colors(projected, camera, images_srgb[number], None if free is None else free[number]))
    samples, inside = (torch.stack(part) for part in zip(*seen, strict=True))
    color, deviation, sure = agreed_colors(samples, inside, AGREEMENT)
    return FarPicture(torch.cat([color, deviation[:, None], sure[:, None].float()], 1).T.reshape(5, ROWS, 2 * ROWS))


def far_likelihood(
    far: FarPicture, camera: Camera, image_srgb: UInt8[Tensor, "height width 3"]
) -> tuple[Float[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """As ground_likelihood."""
    table = torch.cat([far.table[..., -1:], far.table, far.table[..., :1]], -1)
    uv, columns = uv_from_direction(pixel_rays_world(camera)[1]), table.shape[-1]
    x = (uv[..., 0] * (columns - 2) + 1) / columns
    places = torch.stack([2 * x - 1, 2 * uv[..., 1] - 1], -1)
    found = torch.nn.functional.grid_sample(table[None], places[None], padding_mode="border", align_corners=False)[0]
    return color_likelihood(found[:3], found[3], image_srgb, AGREEMENT), found[4] > 0.999
