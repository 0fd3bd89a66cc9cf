"""What a flat ground looks like, gathered from all pictures, and where each picture shows it.

A place of the ground has one colour in most of the pictures that see it; what stands on it hides it in some, from another side in each. Where an object
hides a place from all sides pictures may agree as well, on the object's own colour: so a place counts as known only near sparse points that lie on
the ground, for they were seen there. In: the plane, cameras, pictures. Out: a picture of the ground with how far its colours vary, and the logarithm of
how likely a camera's pixels are if they show it.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.reconstruct.capture.on_ground.agreed_colors import Agreement, agreed_colors, asked_views, color_likelihood, seen_colors
from drgs.reconstruct.capture.on_ground.ground_plane import GroundPlane
from drgs.scene.camera import Camera
from drgs.scene.ground import Ground, places_on_ground


@dataclass(frozen=True)
class GroundPictureSettings:
    extent: float = 3.0
    """Half the side of the picture, as a share of the sphere that all cameras see."""
    side: int = 256
    """[texels]"""
    most_views: int = 32
    """That are asked."""
    agreement: Agreement = field(default_factory=Agreement)
    reach: float = 3.0
    """A place is known within so many times the usual distance between neighbouring points on the ground."""
    least_cosine: float = 0.12
    """Of the view's angle to the ground's normal: flatter ones show it too small."""


@dataclass(frozen=True, eq=False)
class GroundPicture:
    """The ground, and how sure its colours are."""

    ground: Ground
    deviation: Float[Tensor, "1 side side"]
    """Standard deviation of colours that agree, of one channel [sRGB 0..1]."""


def ground_picture(
    plane: GroundPlane,
    cameras: Sequence[Camera],
    images_srgb: Sequence[UInt8[Tensor, "_height _width 3"]],
    middle: Float[Tensor, "3"],
    radius: float,
    free: Sequence[Bool[Tensor, "_height _width"]] | None = None,
    settings: GroundPictureSettings = GroundPictureSettings(),
) -> GroundPicture:
    """Gather it.

    Args:
        middle, radius: of the sphere that all cameras see.
        free: of each picture, the pixels that may show the ground; None: all.
    """
    normal = torch.from_numpy(plane.normal_world).float()
    foot = middle - (middle @ normal - plane.offset) * normal
    side = torch.eye(3)[int(normal.abs().argmin())]
    first = torch.nn.functional.normalize(side - (side @ normal) * normal, dim=0)
    axes, half = torch.stack([first, torch.linalg.cross(normal, first)]), settings.extent * radius
    steps = (2 * (torch.arange(settings.side) + 0.5) / settings.side - 1) * half
    texels = foot + steps[None, :, None] * axes[0] + steps[:, None, None] * axes[1]
    places, seen = texels.reshape(-1, 3), []
    for number in asked_views(len(cameras), settings.most_views):
        camera = cameras[number]
        pixel_from_world = (camera.intrinsics.double() @ camera.camera_from_world.double()[:3]).float()
        projected = places @ pixel_from_world[:, :3].T + pixel_from_world[:, 3]
        samples, inside = seen_colors(projected, camera, images_srgb[number], None if free is None else free[number])
        steep = torch.nn.functional.normalize(camera.center_world - places, dim=-1) @ normal > settings.least_cosine
        seen.append((torch.where(steep[:, None], samples, torch.nan), inside & steep))
    samples, looked = (torch.stack(part) for part in zip(*seen, strict=True))
    color, deviation, sure = agreed_colors(samples, looked, settings.agreement)
    points = torch.from_numpy(plane.points_world).float() - foot
    flat = (points @ axes.T).numpy()
    spacing = float(np.median(cKDTree(flat).query(flat, k=min(5, len(flat)))[0][:, -1]))
    far = cKDTree(flat).query(((texels - foot) @ axes.T).reshape(-1, 2).numpy())[0] > settings.reach * spacing
    known = (sure & ~torch.from_numpy(far)).float()
    size = (settings.side, settings.side)
    ground = Ground(foot, axes, half, color.T.reshape(3, *size), known.reshape(1, *size))
    return GroundPicture(ground, deviation.reshape(1, *size))


def ground_likelihood(
    picture: GroundPicture,
    camera: Camera,
    image_srgb: UInt8[Tensor, "height width 3"],
    settings: GroundPictureSettings = GroundPictureSettings(),
) -> tuple[Float[Tensor, "height width"], Bool[Tensor, "height width"]]:
    """Logarithm of the density of each pixel's colour (sRGB 0..1) if it shows the ground, and whether the ground there is known."""
    ground = picture.ground
    places, meets = places_on_ground(ground, camera, settings.least_cosine)
    table = torch.cat([ground.color_srgb, picture.deviation, ground.known])
    found = torch.nn.functional.grid_sample(table[None], places[None], align_corners=False)[0]
    known = (meets > 0) & (found[4] > 0.999)
    return color_likelihood(found[:3], found[3], image_srgb, settings.agreement), known
