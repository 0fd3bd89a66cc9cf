"""What an object stands on: a flat picture in the world, of which parts are known.

In: a camera. Out: what it sees of the ground, and how much of each pixel that covers.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.scene.camera import Camera, pixel_rays_world


@dataclass(frozen=True, eq=False)
class Ground:
    """A square on a plane. Row and column of its picture go along the second and the first axis."""

    middle: Float[Tensor, "3"]
    """[world units], as all lengths here."""
    axes: Float[Tensor, "2 3"]
    """Unit; their cross product points to where things stand."""
    half: float
    """Half a side."""
    color_srgb: Float[Tensor, "3 side side"]
    """0..1."""
    known: Float[Tensor, "1 side side"]
    """1 where pictures tell what it looks like, else 0."""

    @property
    def normal(self) -> Float[Tensor, "3"]:
        """Unit."""
        return torch.linalg.cross(self.axes[0], self.axes[1])

    def heights(self, points_world: Float[Tensor, "*n 3"]) -> Float[Tensor, "*n"]:
        """Above the plane."""
        return (points_world - self.middle.to(points_world.device)) @ self.normal.to(points_world.device)


def places_on_ground(
    ground: Ground, camera: Camera, least_cosine: float
) -> tuple[Float[Tensor, "height width 2"], Float[Tensor, "height width"]]:
    """Where each pixel's ray meets the plane, as grid_sample takes places on its picture, and whether it does (1 or 0).

    Args:
        least_cosine: between ray and normal; flatter rays do not count.
    """
    device = camera.intrinsics.device
    normal, axes, middle = (value.to(device) for value in (ground.normal, ground.axes, ground.middle))
    origin, directions = pixel_rays_world(camera)
    falls = -(directions @ normal)
    meets = falls > least_cosine
    reach = (origin - middle) @ normal / torch.where(meets, falls, 1.0)
    places = (origin - middle + reach[..., None] * directions) @ axes.T / ground.half
    return places, (meets & (places.abs() < 1).all(-1)).to(places.dtype)
