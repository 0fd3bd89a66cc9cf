"""Captures without masks of an object that stands on a table: where the object may be, and what it stands on.

The sparse points tell the plane, all pictures together what it looks like (ground_picture). Where a picture shows the ground, no place between it and the
camera is the object's: so the pictures vote on the volume above the ground. What that hides is then not asked what the ground looks like, and the vote
is taken anew. The volume errs to be too large: which of it is the object is for the fit to find out, which has the ground's picture behind its surfels.
Once a quick fit has found masks they are asked once more: what only they hide is looked at again, shadows among it, where the pictures may agree on what
the ground looks like between the object's parts and around its feet.

In: Views with sparse points. Out: the same Views with the ground, and as coverage where each picture may show the object; none where no ground is found,
or nothing on it.
"""

from collections.abc import Callable, Sequence
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
from drgs.reconstruct.capture.on_ground.far_picture import far_likelihood, far_picture
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
    """a side, of"""
    fine_views: int = 32
    """so many pictures."""
    size: float = 1.6
    """Half the side of what is looked at, and half its height above the ground, as a share of the sphere that all cameras see."""
    cells: int = 64
    """Of the volumes, along the longest side."""
    against: float = 0.15
    """Share of the pictures that know, of which more may not say that they see the ground through a place."""
    again_side: int = 256
    again_cells: int = 128
    again_against: float = 0.12
    """The same three with masks."""
    inside: float = 0.02
    """With masks the ground is looked for all around them, and this far inside, as a share of the picture's longer side."""
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
    small = smaller_views(views, settings.side)
    table = _table(views, small, seed)
    if table is None:
        return None
    volume: Volume | None = None
    for _ in range(settings.looks):
        if should_stop():
            return None
        free = _free(volume, small, settings)
        volume = _volume_above(table, _looked_at(table, small, free, GroundPictureSettings()), small, free, settings)
        if volume is None:
            return None
    assert volume is not None
    if should_stop():
        return None
    fine = smaller_views(views, settings.fine_side)
    return _standing(views, small, volume, _looked_at(table, fine, _free(volume, fine, settings), _finer(settings)), settings)


def look_again(
    views: Views,
    masks: Sequence[UInt8[Tensor, "_height _width"]],
    seed: int,
    should_stop: Callable[[], bool] = lambda: False,
    settings: OnGroundSettings = OnGroundSettings(),
) -> tuple[Views, list[UInt8[Tensor, "_height _width"]]] | None:
    """As stands_on_ground, with the masks that a quick fit found before that, and those of them that are still the object's.

    Args:
        views: of stands_on_ground, with sparse points. masks: of each, 255 where it may be the object.
    """
    masked = replace(views, coverage=tuple(masks))
    small = smaller_views(masked, settings.again_side)
    table = _table(views, small, seed)
    if table is None or should_stop():
        return None
    free = _around_masks(small, settings)
    finer = replace(settings, cells=settings.again_cells, against=settings.again_against)
    picture = _looked_at(table, small, free, _finer(settings))
    volume = _volume_above(table, picture, small, free, finer, settings.cells)
    if volume is None or should_stop():
        return None
    if max(max(camera.width, camera.height) for camera in views.cameras) > settings.again_side:
        fine = smaller_views(masked, settings.fine_side)
        picture = _looked_at(table, fine, _around_masks(fine, settings), _finer(settings))
    found = _standing(views, small, volume, picture, settings)
    shown = [
        _sized(torch.from_numpy(silhouette(volume, shrunk).covers), camera)
        for shrunk, camera in zip(small.cameras, views.cameras, strict=True)
    ]
    return found, [torch.where(may, mask, 0) for may, mask in zip(shown, masks, strict=True)]


@dataclass(frozen=True, eq=False)
class _Table:
    """Final. What the sparse points tell."""

    plane: GroundPlane
    center: Float[ndarray, "3"]
    """Of the sphere that all cameras see."""
    radius: float


def _table(views: Views, small: Views, seed: int) -> _Table | None:
    if views.points_world is None or len(views.points_world) == 0:
        return None
    center, radius = seen_by_all(small)
    centers = torch.stack([camera.center_world for camera in small.cameras]).double().numpy()
    plane = ground_plane(views.points_world.double().numpy(), centers, center, radius, seed)
    return None if plane is None else _Table(plane, center, radius)


def _standing(views: Views, small: Views, volume: Volume, picture: GroundPicture, settings: OnGroundSettings) -> Views:
    coverage = tuple(
        _may_show(camera, small_camera, volume, settings) for camera, small_camera in zip(views.cameras, small.cameras, strict=True)
    )
    return replace(views, coverage=coverage, ground=picture.ground)


def _finer(settings: OnGroundSettings) -> GroundPictureSettings:
    return GroundPictureSettings(side=settings.fine_texels, most_views=settings.fine_views)


def _looked_at(
    table: _Table,
    views: Views,
    free: list[Bool[Tensor, "_height _width"]] | None,
    settings: GroundPictureSettings,
) -> GroundPicture:
    """What the ground looks like where few cameras are hindered."""
    return ground_picture(
        table.plane, views.cameras, views.images_srgb, torch.from_numpy(table.center).float(), table.radius, free, settings
    )


def _free(volume: Volume | None, views: Views, settings: OnGroundSettings) -> list[Bool[Tensor, "_height _width"]] | None:
    """Of each picture, the pixels that the volume does not hide."""
    return None if volume is None else [torch.from_numpy(~_near(volume, camera, settings.margin)) for camera in views.cameras]


def _around_masks(masked: Views, settings: OnGroundSettings) -> list[Bool[Tensor, "_height _width"]]:
    """Of each picture, the pixels that are not deep inside its mask."""
    depths = (ndimage.distance_transform_edt(mask.numpy() > 127) for mask in masked.coverage)
    return [torch.from_numpy(depth <= settings.inside * max(depth.shape)) for depth in depths]


def _near(volume: Volume, camera: Camera, share: float) -> Bool[ndarray, "height width"]:
    """Pixels in the volume's silhouette or near it, by a share of the picture's longer side."""
    return ndimage.distance_transform_edt(~silhouette(volume, camera).covers) <= share * max(camera.width, camera.height)


def _volume_above(
    table: _Table,
    picture: GroundPicture,
    small: Views,
    free: list[Bool[Tensor, "_height _width"]] | None,
    settings: OnGroundSettings,
    first_cells: int | None = None,
) -> Volume | None:
    """Of what is above the ground, where few pictures see the ground or what is far through it.

    Args:
        first_cells: of the volume that is looked at first, to find its box; None: as many.
    """
    plane, far = table.plane, far_picture(small.cameras, small.images_srgb, free)
    foot = table.center - plane.heights(table.center[None])[0] * plane.normal_world
    half = settings.size * table.radius
    top = foot + 2 * half * plane.normal_world
    region = Region(np.minimum(foot, top) - half, np.maximum(foot, top) + half, first_cells or settings.cells)
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
        volume = None if volume is None else standing_parts(volume, picture.ground, settings.floats * table.radius)
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
    return 255 * _sized(torch.from_numpy(_near(volume, small, settings.spread)), camera).to(torch.uint8)


def _sized(mask: Bool[Tensor, "_height _width"], camera: Camera) -> Bool[Tensor, "height width"]:
    """As large as the camera's picture."""
    size = (camera.height, camera.width)
    return torch.nn.functional.interpolate(mask[None, None].float(), size=size, mode="bilinear", align_corners=False)[0, 0] > 0.5
