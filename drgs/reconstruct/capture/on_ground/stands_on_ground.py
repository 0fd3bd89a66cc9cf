"""Captures without masks of an object that stands on a table: where the object may be, and what it stands on.

The sparse points tell the plane, all pictures together what it looks like (ground_picture). Where a picture shows the ground, no place between it and the
camera is the object's: so the pictures vote on the volume above the ground. What that hides is then not asked what the ground looks like, and the vote
is taken anew. The volume errs to be too large: which of it is the object is for the fit to find out, which has the ground's picture behind its surfels.

In: Views with sparse points. Out: the same Views with the ground, and as coverage where each picture may show the object; none where no ground is found,
or nothing on it.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy import ndarray
from scipy import ndimage
from torch import Tensor

from drgs.reconstruct.capture.find_masks import smaller_views
from drgs.reconstruct.capture.initial_points import seen_by_all
from drgs.reconstruct.capture.masks_by_strokes.vote_volume import Region, Volume, silhouette, vote_volume
from drgs.reconstruct.capture.on_ground.far_picture import FarPicture, far_likelihood, far_picture
from drgs.reconstruct.capture.on_ground.ground_picture import GroundPicture, GroundPictureSettings, ground_likelihood, ground_picture
from drgs.reconstruct.capture.on_ground.ground_plane import GroundPlane, ground_plane
from drgs.scene.camera import Camera
from drgs.scene.ground import Ground
from drgs.scene.views import Views


@dataclass(frozen=True)
class OnGroundSettings:
    side: int = 192
    """Pictures are looked at in this size [pixels], and for the last picture of the ground in"""
    fine_side: int = 512
    """this, which has"""
    fine_texels: int = 512
    """a side."""
    size: float = 1.6
    """Half the side of what is looked at, and half its height above the ground, as a share of the sphere that all cameras see."""
    cells: int = 64
    """Of the volumes, along the longest side."""
    against: float = 0.15
    """Share of the pictures that know, of which more may not say that they see the ground through a place."""
    around: int = 1
    """Neighbours on each side that are asked with a pixel [pixels of `side`]: where"""
    by_chance: float = 0.7
    """this share or fewer have the ground's colours it is not the ground, and where"""
    all_alike: float = 0.95
    """this share or more, it is."""
    looks: int = 3
    """How often the ground is looked at, each time without what the volume so far hides."""
    margin: float = 0.015
    """Around the volume's silhouette nobody is asked for the ground, as a share of the picture's longer side."""
    floats: float = 0.25
    """Parts of the volume of which nothing is this near the ground are not the object's, as a share of the sphere that all cameras see."""
    spread: float = 0.01
    """How far outside the silhouette a picture may show the object, the same way."""


def stands_on_ground(
    views: Views,
    seed: int,
    should_stop: Callable[[], bool] = lambda: False,
    settings: OnGroundSettings = OnGroundSettings(),
) -> Views | None:
    """The capture with the ground; None where there is none with something on it, or should_stop() said so."""
    if views.points_world is None or len(views.points_world) == 0:
        return None
    small = smaller_views(views, settings.side)
    center, radius = seen_by_all(small)
    centers = torch.stack([camera.center_world for camera in small.cameras]).double().numpy()
    plane = ground_plane(views.points_world.double().numpy(), centers, center, radius, seed)
    if plane is None:
        return None
    volume: Volume | None = None
    for _ in range(settings.looks):
        if should_stop():
            return None
        picture = _looked_at(plane, small, center, radius, volume, settings, GroundPictureSettings())
        far = far_picture(small.cameras, small.images_srgb, _free(volume, small, settings))
        volume = _volume_above(plane, picture, far, small, center, radius, settings)
        if volume is None:
            return None
    assert volume is not None
    if should_stop():
        return None
    finer = GroundPictureSettings(side=settings.fine_texels, most_views=16)
    fine = smaller_views(views, settings.fine_side)
    ground = _looked_at(plane, fine, center, radius, volume, settings, finer).ground
    coverage = tuple(
        _may_show(camera, small_camera, volume, settings) for camera, small_camera in zip(views.cameras, small.cameras, strict=True)
    )
    return replace(views, coverage=coverage, ground=ground)


def _looked_at(
    plane: GroundPlane,
    views: Views,
    center: Float[ndarray, "3"],
    radius: float,
    volume: Volume | None,
    settings: OnGroundSettings,
    picture_settings: GroundPictureSettings,
) -> GroundPicture:
    """What the ground looks like where the volume hides it from few cameras."""
    middle, free = torch.from_numpy(center).float(), _free(volume, views, settings)
    return ground_picture(plane, views.cameras, views.images_srgb, middle, radius, free, picture_settings)


def _free(volume: Volume | None, views: Views, settings: OnGroundSettings) -> list[Bool[Tensor, "_height _width"]] | None:
    """Of each picture, the pixels that the volume does not hide."""
    return None if volume is None else [torch.from_numpy(~_near(volume, camera, settings.margin)) for camera in views.cameras]


def _near(volume: Volume, camera: Camera, share: float) -> Bool[ndarray, "height width"]:
    """Pixels in the volume's silhouette or near it, by a share of the picture's longer side."""
    return ndimage.distance_transform_edt(~silhouette(volume, camera).covers) <= share * max(camera.width, camera.height)


def _volume_above(
    plane: GroundPlane,
    picture: GroundPicture,
    far: FarPicture,
    small: Views,
    center: Float[ndarray, "3"],
    radius: float,
    settings: OnGroundSettings,
) -> Volume | None:
    """Of what is above the ground, where few pictures see the ground or what is far through it."""
    foot = center - plane.heights(center[None])[0] * plane.normal_world
    half = settings.size * radius
    top = foot + 2 * half * plane.normal_world
    region = Region(np.minimum(foot, top) - half, np.maximum(foot, top) + half, settings.cells)
    shown = []
    for camera, image in zip(small.cameras, small.images_srgb, strict=True):
        (on_ground, known), (far_off, far_known) = ground_likelihood(picture, camera, image), far_likelihood(far, camera, image)
        shown.append((torch.where(known, on_ground, far_off), known | far_known))
    masks = [_stands_there(likely, told, settings) for likely, told in shown]
    may_vote = [told for _, told in shown]

    def above(points_world: Float[Tensor, "cell 3"]) -> Bool[Tensor, "cell"]:
        return picture.ground.heights(points_world) > 0

    volume: Volume | None = None
    for _ in range(2):
        volume = vote_volume(region, small.cameras, masks, settings.against, known=may_vote, possible=above)
        volume = None if volume is None else standing_parts(volume, picture.ground, settings.floats * radius)
        if volume is None:
            return None
        region = volume.around(settings.cells)
    return volume


def standing_parts(volume: Volume, ground: Ground, floats: float) -> Volume | None:
    """What of a volume hangs together with what is near the ground; None where nothing does.

    Args:
        floats: a part of which nothing is lower than this floats [world units]: surroundings that no picture sees past it.
    """
    cells = torch.round((volume.centers.double() - torch.from_numpy(volume.low)) / volume.cell - 0.5).long().numpy()
    grid = np.zeros(cells.max(0) + 1, bool)
    grid[tuple(cells.T)] = True
    parts = ndimage.label(grid)[0][tuple(cells.T)]
    lowest = ndimage.minimum(ground.heights(volume.centers).numpy(), parts, np.arange(1, parts.max() + 1))
    stands = torch.from_numpy((lowest < floats)[parts - 1])
    return replace(volume, centers=volume.centers[stands]) if stands.any() else None


def _stands_there(
    likely: Float[Tensor, "height width"], known: Bool[Tensor, "height width"], settings: OnGroundSettings
) -> Float[Tensor, "height width"]:
    """1 where something hides the ground, 0 where pixel and neighbours show it: of what stands there one colour is as likely as another, so some pixels
    have the ground's by chance, but seldom all around."""
    counted = torch.stack([known.float(), (known & (likely > 0)).float()])[:, None]
    told, alike = torch.nn.functional.avg_pool2d(counted, 2 * settings.around + 1, 1, settings.around)[:, 0]
    share = alike / told.clamp_min(1e-6)
    return ((settings.all_alike - share) / (settings.all_alike - settings.by_chance)).clamp(0, 1)


def _may_show(camera: Camera, small: Camera, volume: Volume, settings: OnGroundSettings) -> UInt8[Tensor, "height width"]:
    """255 where a picture may show the object."""
    near = torch.from_numpy(_near(volume, small, settings.spread)).float()
    sized = torch.nn.functional.interpolate(near[None, None], size=(camera.height, camera.width), mode="bilinear", align_corners=False)[
        0, 0
    ]
    return (255 * (sized > 0.5)).to(torch.uint8)
