"""Masks moved to where their photographs show the object to end.

Masks of photographs are drawn by hand, or by programs that see coarser pictures: their outlines wander by a pixel or two, and what they hold too much of
shows the surroundings. A surface fitted to them lies as far off. So each place of an outline asks the photograph along its normal: colours just inside
and just outside, of some pixels along the outline, are two normal distributions (each with a share for colours that nobody expected), and the outline lies
where what is inside of it looks most like the one and what is outside most like the other; then, to a part of a pixel, where the colours mixed at the edge say.
Where both sides look alike nothing is moved, nor in pictures in which they mostly do: what is found there is texture.

Masks that are right would be made worse by a fifth of a pixel, so a capture whose outlines differ from the edges by less than LEAST_OFF keeps its own; so do
pictures that were cut out, for beyond the mask they show nothing.
Source of the two sides' distributions around a contour: lankton2008; docs/sources.md.

In: Views with masks. Out: Views, with masks that cover part of a pixel where the edge passes through it, and there with the object's colours alone.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8, UInt16
from numpy import ndarray
from PIL import Image
from scipy.ndimage import gaussian_filter1d, map_coordinates, median_filter, uniform_filter1d
from scipy.spatial import cKDTree
from torch import Tensor

from drgs.maths.color_numpy import linear_from_srgb, srgb_from_linear
from drgs.reconstruct.geometry.closed_outlines import ClosedOutline, closed_outlines
from drgs.scene.views import Views
from drgs.warp_torch import by_pool

REACH_SHARE, LEAST_REACH, MOST_REACH = 0.02, 4.0, 8.0
"""How far an edge is looked for: of the side of a square as large as the object, and in pixels."""
LOOK_SIDE = 1024
"""Largest side of a photograph that is looked at [pixels]; larger ones are shrunk for it."""
LEAST_OFF = 0.6
"""[pixels] Root mean square over all outlines of a capture. Right masks of teapot, bunny and still_life before a plain room differ by 0.23, 0.21 and 0.47 from the
edges that are found, ones that are off by 1.0 and 0.7 too wide by 0.9."""
STEP = 0.5
"""[pixels] along a normal."""
BAND = 5.0
"""[pixels] on each side of an outline whose colours are looked at."""
ALONG = 15
"""Places of an outline, some two thirds of a pixel apart, whose colours are one distribution."""
DEVIATION = 0.008
"""Least one of a channel [sRGB, 0..1]: that of two of 255 values."""
UNEXPECTED_INSIDE, UNEXPECTED_OUTSIDE = 0.2, 0.02
"""Shares of colours that are in no distribution: an object's rim may turn dark within a pixel, surroundings seldom change there."""
MOST_SURE = 4.0
"""Logarithm of one place's likelihood ratio, at most."""
HELD = 0.02
"""By how much the square of an outline's move counts against it [1 / pixels^2 per pixel]."""
ROUNDS = 4
MIXED = 2.5
"""[pixels] on either side of an edge within which colours may be mixed."""
NEAR_INSIDE, NEAR_OUTSIDE = (-2.0, -0.75), (1.5, 4.0)
"""[pixels] Where the colours lie that are mixed at an edge: rims turn dark, so those inside are taken near it."""
LEAST_CONTRAST = 0.003
"""Squared difference of linear colours, below which mixing says nothing."""
LEAST_SURE = 0.75
"""Of the most that two sides can be told apart: from there to all of it a place counts more and more. All but a twentieth of the places of objects before rooms have 0.93
and more, of four of the tankard's photographs 0.75 and more; the middle half of an outline laid through wood 0.3 to 0.99, through a soft checkerboard 0.55 to 0.95."""
LEAST_SURE_PLACES = 0.6
"""Of a picture's outlines, that count by a quarter at least: where there are fewer, texture is taken for edges (wood 0.39, checkerboard 0.47; edges of objects 0.94 to 1)."""
UNSURE = 0.03
"""Weight of staying, where the most sure move has 1."""
CUT_OUT = 0.99
"""Share of the pixels around an object that have one colour, from which the picture was cut out."""
RIM = 1.25
"""[pixels] from the edge inwards: nearer, colours are taken from there."""


def sharpen_masks(views: Views) -> Views:
    """The views with their masks moved; the very views where outlines and edges differ by less than LEAST_OFF. Photographs must show what is beyond their
    masks, as those do not that were shrunk with masks: read_pictures moves those before."""
    cpu, every = torch.device("cpu"), range(len(views.cameras) + 1)
    looks = by_pool(lambda k, _: MaskLook.at(views.images_srgb[k].numpy(), views.coverage[k].numpy()), every, cpu)
    off = outlines_off(looks)
    if off < LEAST_OFF:
        return views

    def moved(k: int, _: int) -> tuple[Tensor, Tensor]:
        look, image, mask = looks[k], views.images_srgb[k], views.coverage[k]
        if look is None:
            return image, mask
        color, alpha = look.moved(image.numpy(), mask.numpy())
        return torch.from_numpy(color), torch.from_numpy(alpha)

    images, masks = zip(*by_pool(moved, every, cpu), strict=True)
    return replace(views, images_srgb=images, coverage=masks, masks_moved=off)


def outlines_off(looks: Sequence["MaskLook | None"]) -> float:
    """[pixels of MaskLook] Root mean square of how far all outlines lie from edges; 0 where none was compared with one."""
    offsets = [look.offsets for look in looks if look is not None]
    return float(np.sqrt(np.square(np.concatenate(offsets)).mean())) if offsets else 0.0


@dataclass(frozen=True, eq=False)
class MaskLook:
    """Outlines of one mask and how far from them the photograph has its edges, in pixels of the photograph shrunk to LOOK_SIDE."""

    points: Float[ndarray, "point 2"]
    """Of the outlines [pixels; column and row, centres of pixels at 0]."""
    normals: Float[ndarray, "point 2"]
    """Unit, outwards."""
    offsets: Float[ndarray, "point"]
    """[pixels] outwards."""
    reach: float
    """[pixels]"""
    scale: float
    """The photograph's pixels over these."""

    @classmethod
    def at(cls, image: UInt8[ndarray, "height width 3"], mask: UInt8[ndarray, "height width"]) -> "MaskLook | None":
        """None where there is no outline, or the picture was cut out."""
        scale = max(1.0, max(mask.shape) / LOOK_SIDE)
        if scale > 1:
            size = (round(mask.shape[1] / scale), round(mask.shape[0] / scale))
            image, mask = _shrunk(image, size), np.asarray(Image.fromarray(mask).resize(size, Image.Resampling.BOX))
        inside = mask > 127
        reach = float(np.clip(REACH_SHARE * np.sqrt(inside.sum()), LEAST_REACH, MOST_REACH))
        if not inside.any() or _is_cut_out(image, inside, reach):
            return None
        colors, alpha = image.astype(np.float32) / 255, mask.astype(np.float32) / 255
        outlines = list(_smooth_outlines(mask))
        if not outlines:
            return None
        found = [_edge_offsets(colors, alpha, outline, reach) for outline in outlines]
        offsets, weights = (np.concatenate(values) for values in zip(*found, strict=True))
        if (weights > 0.25).mean() < LEAST_SURE_PLACES:
            return None
        points, normals = (np.concatenate([getattr(outline, name) for outline in outlines]) for name in ("points", "normals"))
        return cls(points - 0.5, normals, offsets, reach, scale)

    def moved(
        self, image: UInt8[ndarray, "height width 3"], mask: UInt8[ndarray, "height width"]
    ) -> tuple[UInt8[ndarray, "height width 3"], UInt8[ndarray, "height width"]]:
        """The photograph and its mask, whose outline is moved."""
        alpha, inside = mask.copy(), mask > 127
        most = self.scale * (self.reach + MIXED)
        box = _box_around(inside, most)
        near = np.where(inside[box], _squared_distance(~inside[box], most), _squared_distance(inside[box], most)) <= most**2
        pixels = (np.argwhere(near) + [side.start for side in box])[:, ::-1]
        places = self.scale * (self.points + self.offsets[:, None] * self.normals + 0.5) - 0.5
        distance, place = cKDTree(places).query(pixels)
        own = distance <= self.scale * (2 * self.reach + MIXED)  # others are of specks, which were not looked at
        pixels, distance, place = pixels[own], distance[own], place[own]
        outside = np.einsum("ni,ni->n", pixels - places[place], self.normals[place])
        # Beside a corner the nearest place's normal tells the side alone.
        outside = np.where(np.abs(outside) < self.scale, outside, np.sign(outside) * distance)
        alpha[pixels[:, 1], pixels[:, 0]] = (255 * np.clip(0.5 - outside, 0, 1) + 0.5).astype(np.uint8)
        depth = RIM * self.scale
        rim = (outside > -depth) & (outside < 0.5)
        column, row = pixels[rim].T
        sources = (pixels[rim] - (depth + outside[rim])[:, None] * self.normals[place[rim]]).T[::-1]
        cleaned = image.copy()
        for channel in range(3):
            cleaned[row, column, channel] = map_coordinates(image[..., channel].astype(np.float32), sources, order=1, mode="nearest") + 0.5
        return cleaned, alpha


def _shrunk(image: UInt8[ndarray, "rows columns 3"], size: tuple[int, int]) -> UInt8[ndarray, "height width 3"]:
    """To `size` (columns, rows), by means of light."""
    light = linear_from_srgb(np.arange(256) / 255).astype(np.float32)[image]
    channels = [Image.fromarray(light[..., channel]).resize(size, Image.Resampling.BOX) for channel in range(3)]
    return (255 * srgb_from_linear(np.stack([np.asarray(channel) for channel in channels], -1)) + 0.5).astype(np.uint8)


def _is_cut_out(image: UInt8[ndarray, "height width 3"], inside: Bool[ndarray, "height width"], reach: float) -> bool:
    """Whether all around the object has one colour, as pictures have that were cut out."""
    box = _box_around(inside, reach + BAND)
    away = _squared_distance(inside[box], reach + BAND)
    around = image[box][(away > 4) & (away <= (reach + BAND) ** 2)]
    if len(around) == 0:
        return True
    return bool((around == np.median(around, axis=0).astype(np.uint8)).all(1).mean() > CUT_OUT)


def _box_around(inside: Bool[ndarray, "height width"], most: float) -> tuple[slice, slice]:
    """Rows and columns of all pixels that are at most so far from some inside [pixels], of which there are any."""
    margin = int(most) + 1
    ends = [np.flatnonzero(inside.any(axis))[[0, -1]] for axis in (1, 0)]
    return slice(max(0, ends[0][0] - margin), ends[0][1] + margin + 1), slice(max(0, ends[1][0] - margin), ends[1][1] + margin + 1)


def _squared_distance(there: Bool[ndarray, "height width"], most: float) -> UInt16[ndarray, "height width"]:
    """To the nearest pixel that is `there` [pixels^2]; more than most^2 where it is farther. A distance transform, which knows all distances, takes six times as long."""
    cap = int(most) + 1
    along = np.where(there, 0, cap).astype(np.uint8)
    for _ in range(cap):
        np.minimum(along[:, 1:], along[:, :-1] + np.uint8(1), out=along[:, 1:])
        np.minimum(along[:, :-1], along[:, 1:] + np.uint8(1), out=along[:, :-1])
    squared = np.square(along.astype(np.uint16))
    nearest = squared.copy()
    for rows in range(1, cap):
        np.minimum(nearest[rows:], squared[:-rows] + np.uint16(rows * rows), out=nearest[rows:])
        np.minimum(nearest[:-rows], squared[rows:] + np.uint16(rows * rows), out=nearest[:-rows])
    return nearest


def _smooth_outlines(mask: UInt8[ndarray, "height width"]) -> Iterator[ClosedOutline]:
    """With normals that do not turn from pixel to pixel."""
    for outline in closed_outlines(mask.astype(np.float64) / 255):
        if len(outline.points) < ALONG:
            continue
        normals = gaussian_filter1d(outline.normals, 4.0, axis=0, mode="wrap")
        yield replace(outline, normals=normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9))


def _edge_offsets(
    colors: Float[ndarray, "height width 3"], alpha: Float[ndarray, "height width"], outline: ClosedOutline, reach: float
) -> tuple[Float[ndarray, "point"], Float[ndarray, "point"]]:
    """How far outside each place of an outline the photograph's edge lies [pixels], and how sure that is, 0..1."""
    profiles = _Profiles.along(colors, alpha, outline, reach)
    offsets = np.zeros(len(outline.points))
    within = np.abs(profiles.at) <= reach + 1e-9
    candidates = profiles.at[within]
    sure = np.zeros(len(offsets))
    for _ in range(ROUNDS):
        ratio, sure = profiles.likelihood_ratio(offsets)
        score = np.cumsum(ratio[:, within], 1) * STEP - HELD * np.square(candidates)
        best = gaussian_filter1d(score, 2.0, axis=0, mode="wrap").argmax(1)
        offsets = median_filter(candidates[best] + STEP / 2, 9, mode="wrap")
    offsets = profiles.mixed_at(offsets)
    sure = np.clip((sure / (2 * MOST_SURE) - LEAST_SURE) / (1 - LEAST_SURE), 0, 1)
    weight = np.where(profiles.in_picture, sure**2, 0.0)
    pulled, held = (gaussian_filter1d(values, 2.0, mode="wrap") for values in (weight * offsets, weight))
    return pulled / (held + UNSURE), weight


@dataclass(frozen=True, eq=False)
class _Profiles:
    """Colours of a photograph along the normals of an outline."""

    at: Float[ndarray, "k"]
    """[pixels] outside."""
    colors: Float[ndarray, "point k 3"]
    """SRGB."""
    good: Bool[ndarray, "point k"]
    """What lies between there and the outline is all object, or all surroundings, in the picture."""

    @classmethod
    def along(
        cls, colors: Float[ndarray, "height width 3"], alpha: Float[ndarray, "height width"], outline: ClosedOutline, reach: float
    ) -> "_Profiles":
        count = round((reach + BAND) / STEP)
        at = STEP * np.arange(-count, count + 1, dtype=np.float32)
        places = np.moveaxis((outline.points - 0.5)[:, None] + at[:, None] * outline.normals[:, None], -1, 0)[::-1]
        looked = np.stack([map_coordinates(colors[..., channel], places, order=1, mode="nearest") for channel in range(3)], -1)
        object_there = map_coordinates(alpha, places, order=1, mode="constant") > 0.5
        good = np.where(at < -0.75, object_there, np.where(at > 0.75, ~object_there, True))
        good[:, : count + 1] = np.minimum.accumulate(good[:, count::-1], axis=1)[:, ::-1]
        good[:, count:] = np.minimum.accumulate(good[:, count:], axis=1)
        row, column = places
        good &= (row >= 0) & (row <= alpha.shape[0] - 1) & (column >= 0) & (column <= alpha.shape[1] - 1)
        return cls(at, looked, good)

    @property
    def in_picture(self) -> Bool[ndarray, "point"]:
        """Whether there are two pixels of the photograph on either side of an outline's place."""
        middle = len(self.at) // 2
        return self.good[:, middle - round(2 / STEP)] & self.good[:, middle + round(2 / STEP)]

    def likelihood_ratio(self, offsets: Float[ndarray, "point"]) -> tuple[Float[ndarray, "point k"], Float[ndarray, "point"]]:
        """Logarithms of how much more likely each colour is inside than outside, 0 where it is not good, and how well these tell the sides of the edge at `offsets`
        apart."""
        from_edge = self.at - offsets[:, None].astype(np.float32)
        inner, outer = self.good & (from_edge < -1) & (from_edge >= -BAND), self.good & (from_edge > 1) & (from_edge <= BAND)
        inside = np.logaddexp(self._log_density(inner), np.log(UNEXPECTED_INSIDE))
        outside = np.logaddexp(self._log_density(outer), np.log(UNEXPECTED_OUTSIDE))
        ratio = np.where(self.good, np.clip(inside - outside, -MOST_SURE, MOST_SURE), 0)
        sides = [(ratio * side).sum(1) / np.maximum(side.sum(1), 1) for side in (inner, outer)]
        return ratio, sides[0] - sides[1]

    def _log_density(self, counted: Bool[ndarray, "point k"]) -> Float[ndarray, "point k"]:
        """Of each colour in the normal distribution of those that are counted, of the places around."""
        some = counted[..., None] * self.colors
        share = np.maximum(_along(counted.sum(1).astype(np.float32)), 1e-6)
        mean = _along(some.sum(1)) / share[:, None]
        spread = _along(some.swapaxes(1, 2) @ self.colors) / share[:, None, None] - mean[:, :, None] * mean[:, None]
        spread = spread.astype(np.float64) + DEVIATION**2 * np.eye(3)
        away = (self.colors - mean[:, None]).astype(np.float64)
        squared = np.einsum("pki,pki->pk", away @ np.linalg.inv(spread), away)
        return -0.5 * (squared + np.linalg.slogdet(spread)[1][:, None] + 3 * np.log(2 * np.pi))

    def mixed_at(self, offsets: Float[ndarray, "point"]) -> Float[ndarray, "point"]:
        """Where an edge in the middle of the colours mixed around `offsets` lies; those offsets where there is no contrast."""
        light = linear_from_srgb(self.colors)
        from_edge = self.at - offsets[:, None]

        def mean(between: tuple[float, float]) -> Float[ndarray, "point 3"]:
            there = self.good & (from_edge >= between[0]) & (from_edge <= between[1])
            total, count = (there[..., None] * light).sum(1), there.sum(1).astype(np.float32)
            total, count = (gaussian_filter1d(values, 1.5, axis=0, mode="wrap") for values in (total, count))
            return total / np.maximum(count, 1e-6)[:, None]

        inside, outside = mean(NEAR_INSIDE), mean(NEAR_OUTSIDE)
        apart = inside - outside
        contrast = np.square(apart).sum(1)
        share = ((light - outside[:, None]) * apart[:, None]).sum(-1) / np.maximum(contrast, 1e-6)[:, None]
        share = gaussian_filter1d(np.clip(share, 0, 1), 1.0, axis=0, mode="wrap")
        found = offsets - MIXED + STEP * (share * (np.abs(from_edge) <= MIXED)).sum(1)
        return np.where((contrast > LEAST_CONTRAST) & (np.abs(found - offsets) < 1.5), found, offsets)


def _along(values: Float[ndarray, "point *rest"]) -> Float[ndarray, "point *rest"]:
    """Means over ALONG places of an outline."""
    return uniform_filter1d(values, ALONG, axis=0, mode="wrap")
