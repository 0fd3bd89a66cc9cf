"""The learned picture of what the object stands on, which hides the surroundings behind it.

In: logits of its colours and of how much it covers, the plane they lie on, a camera. Out: sRGB behind the object; differentiable.
"""

import torch
from jaxtyping import Float
from scipy import ndimage
from torch import Tensor

from drgs.scene.camera import Camera
from drgs.scene.ground import Ground, places_on_ground

LEAST_COSINE = 0.05
"""Between ray and normal: flatter rays see the surroundings."""
COVER, FAR_COVER = 0.98, 0.5
"""Where the fit begins, near what is known of the ground and far from it."""
FAR = 0.15
"""From what is known, as a share of the picture's side: what the object hides is nearer, and the table's edge may be."""


def ground_logits(ground: Ground) -> Float[Tensor, "1 4 side side"]:
    """To begin with: sRGB as it was gathered, where it is not known that of the nearest place; and cover."""
    distance, nearest = ndimage.distance_transform_edt(ground.known[0].numpy() == 0, return_indices=True)
    row, column = torch.from_numpy(nearest).long()
    color = ground.color_srgb[:, row, column].clamp(0.02, 0.98)
    near = torch.from_numpy(distance)[None] < FAR * ground.known.shape[-1]
    return torch.logit(torch.cat([color, torch.where(near, COVER, FAR_COVER)]))[None]


def before_ground(
    logits: Float[Tensor, "1 4 side side"], ground: Ground, camera: Camera, behind: Float[Tensor, "height width 3"]
) -> Float[Tensor, "height width 3"]:
    """The ground before what is behind it."""
    places, meets = places_on_ground(ground, camera, LEAST_COSINE)
    seen = torch.sigmoid(torch.nn.functional.grid_sample(logits, places[None], padding_mode="border", align_corners=False)[0]).permute(
        1, 2, 0
    )
    cover = (seen[..., 3] * meets)[..., None]
    return cover * seen[..., :3] + (1 - cover) * behind
