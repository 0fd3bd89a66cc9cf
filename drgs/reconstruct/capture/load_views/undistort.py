"""Pictures through a bending lens become those that a pinhole in its place would have made.

In: a lens and the pixels of a picture taken through it. Out: the pinhole, and its pixels, all of which lie within the picture:
what would be blank is cut off (COLMAP's undistorter with blank_pixels = 0). Colour and masks go the same way, so that they stay aligned.
Pixels are interpolated bilinearly in linear, premultiplied light; nothing is averaged here, for the pinhole has the lens's magnification
in the middle. Whoever wants small pictures shrinks them afterwards.
"""

from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float64, UInt8
from numpy import ndarray

from drgs.reconstruct.capture.load_views.capture import Pinhole
from drgs.reconstruct.capture.load_views.checks import check_pinhole
from drgs.reconstruct.capture.load_views.linear_light import premultiplied, straight
from drgs.scene.lens import PARAMETER_NAMES, Lens, pixels_from_plane

WIDEST = np.radians(70.0)
"""From the axis [rad]: what a lens sees farther out is left out, for on a plane it takes more and more pixels."""
MOST_ENLARGED = 2.0
"""Sides of the undistorted picture, in those of the original: at most."""
DIRECTIONS, STEPS = 2048, 64
"""Rays of the picture's plane on which its edge is sought, a multiple of 4, and places on each."""
HALVINGS = 40
BAND_PIXELS = 1 << 20
"""Resampled at once: what a picture needs beside itself."""


def optics_of(lens: Lens, where: str) -> tuple[Pinhole, Lens | None]:
    """The camera of the picture as a build sees it, and the lens where that picture is an undistorted one.

    Raises:
        ValueError: as undistorted_pinhole.
    """
    if lens.is_pinhole:
        return Pinhole(*lens.focal_lengths, *lens.principal_point, lens.width, lens.height), None
    return undistorted_pinhole(lens, where), lens


def undistorted_pinhole(lens: Lens, where: str) -> Pinhole:
    """The camera of the undistorted picture: the lens's magnification in the middle, less where the picture would be enlarged too much.

    Raises:
        ValueError: no lens bends like this, or it folds the picture over itself. `where` begins the sentence.
    """
    if not np.isfinite(lens.parameters).all():
        raise ValueError(f"{where}: lens {_shown(lens)}, expected finite numbers.")
    (fx, fy), (cx, cy) = lens.focal_lengths, lens.principal_point
    check_pinhole(Pinhole(fx, fy, cx, cy, lens.width, lens.height), where)
    if not (0 < cx < lens.width and 0 < cy < lens.height):
        raise ValueError(
            f"{where}: principal point ({cx:.6g}, {cy:.6g}) lies outside the {lens.width}x{lens.height} image, "
            "expected inside, for the lens bends straight lines around it."
        )
    outline = _outline(lens)
    if outline is None:
        raise ValueError(
            f"{where}: lens {_shown(lens)} folds the {lens.width}x{lens.height} image over itself, "
            "expected one that leads farther out all the way to the image's edge."
        )
    left, top, right, bottom = _largest_rectangle(outline)
    magnification_x, magnification_y = _magnification(lens)
    scale = min(
        1.0,
        MOST_ENLARGED * lens.width / (magnification_x * (right - left)),
        MOST_ENLARGED * lens.height / (magnification_y * (bottom - top)),
    )
    fx, fy = magnification_x * scale, magnification_y * scale
    # Whole pixels, in the middle of what can be filled.
    width, height = max(1, int(fx * (right - left))), max(1, int(fy * (bottom - top)))
    return Pinhole(fx, fy, width / 2 - fx * (left + right) / 2, height / 2 - fy * (top + bottom) / 2, width, height)


def undistort(
    color_srgb: UInt8[ndarray, "rows columns 3"], alpha: UInt8[ndarray, "rows columns"], lens: Lens, pinhole: Pinhole
) -> tuple[UInt8[ndarray, "height width 3"], UInt8[ndarray, "height width"]]:
    """Colour and alpha as `pinhole` sees them, from those of a picture through `lens`.

    Args:
        pinhole: of lens; see undistorted_pinhole.
    """
    new_color = np.empty((pinhole.height, pinhole.width, 3), np.uint8)
    new_alpha = np.empty((pinhole.height, pinhole.width), np.uint8)
    plane_x = (np.arange(pinhole.width) + 0.5 - pinhole.cx) / pinhole.fx
    band = max(1, BAND_PIXELS // pinhole.width)
    for first in range(0, pinhole.height, band):
        plane_y = (np.arange(first, min(first + band, pinhole.height)) + 0.5 - pinhole.cy) / pinhole.fy
        places = pixels_from_plane(lens, np.stack(np.meshgrid(plane_x, plane_y), -1))
        rows = slice(first, first + len(plane_y))
        new_color[rows], new_alpha[rows] = _sampled(color_srgb, alpha, places)
    return new_color, new_alpha


def _sampled(
    color_srgb: UInt8[ndarray, "rows columns 3"], alpha: UInt8[ndarray, "rows columns"], places: Float64[ndarray, "height width 2"]
) -> tuple[UInt8[ndarray, "height width 3"], UInt8[ndarray, "height width"]]:
    """Colour and alpha at `places` of the picture [pixels; centres at + 0.5]."""
    # Only the rows that are needed become linear light.
    top = int(np.clip(np.floor(places[..., 1].min() - 1), 0, len(alpha) - 1))
    bottom = int(np.clip(np.ceil(places[..., 1].max() + 1), top + 1, len(alpha)))
    share = alpha[top:bottom].astype(np.float32) / 255
    light = np.stack([*(premultiplied(color_srgb[top:bottom, :, channel], share) for channel in range(3)), share])
    # grid_sample's places run from -1 to 1 between the picture's edges.
    grid = (places - (0, top)) * (2 / alpha.shape[1], 2 / (bottom - top)) - 1
    sampled = torch.nn.functional.grid_sample(
        torch.from_numpy(light)[None], torch.from_numpy(grid.astype(np.float32))[None], padding_mode="border", align_corners=False
    )
    light = sampled[0].permute(1, 2, 0).numpy()
    return straight(light[..., :3], light[..., 3]), np.round(np.clip(light[..., 3], 0, 1) * 255).astype(np.uint8)


def _shown(lens: Lens) -> str:
    """The model and what bends, for a sentence."""
    names = PARAMETER_NAMES[lens.model][-len(lens.coefficients) :] if lens.coefficients else ()
    numbers = ", ".join(f"{name} = {value:.6g}" for name, value in zip(names, lens.coefficients, strict=True))
    return f"{lens.model}{f' ({numbers})' if numbers else ''}"


def _magnification(lens: Lens) -> tuple[float, float]:
    """Pixels by which the picture goes on when the direction (x, y, 1) does by 1, in the middle."""
    step = 1e-4
    around = pixels_from_plane(lens, step * np.array([[1.0, 0], [-1, 0], [0, 1], [0, -1]]))
    return float(around[0, 0] - around[1, 0]) / (2 * step), float(around[2, 1] - around[3, 1]) / (2 * step)


@lru_cache(maxsize=16)
def _outline(lens: Lens) -> Float64[ndarray, "direction 2"] | None:
    """Where rays of the plane at distance 1, from its middle, leave the picture, or WIDEST; None where a ray turns back before."""
    around = np.arange(DIRECTIONS) * (2 * np.pi / DIRECTIONS)
    rays = np.stack([np.cos(around), np.sin(around)], -1)
    fx, fy = lens.focal_lengths
    toward = rays * (fx, fy) / np.hypot(fx * rays[:, :1], fy * rays[:, 1:])

    def places(distances: Float64[ndarray, "direction step"]) -> Float64[ndarray, "direction step 2"]:
        return pixels_from_plane(lens, distances[..., None] * rays[:, None])

    def inside(place: Float64[ndarray, "direction step 2"]) -> Bool[ndarray, "direction step"]:
        return np.all((place >= 0) & (place <= (lens.width, lens.height)), axis=-1)

    # Equal angles: a lens bends most far out.
    distances = np.tan(np.linspace(0, WIDEST, STEPS + 1))[None].repeat(DIRECTIONS, 0)
    along = places(distances)
    # How far out along the ray: negative steps are folds, NaN is where the model's formula ends.
    grows = np.diff(((along - lens.principal_point) * toward[:, None]).sum(-1), axis=1) > 0
    seen = inside(along)
    # A step counts until the ray has left the picture: one that begins outside does not.
    before = np.logical_and.accumulate(seen, axis=1)
    if not (grows | ~before[:, :-1]).all():
        return None
    last = before.sum(1) - 1  # before[:, 0] is the principal point, which is inside
    low = distances[np.arange(DIRECTIONS), last]
    high = distances[np.arange(DIRECTIONS), np.minimum(last + 1, STEPS)]
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        within = inside(places(middle[:, None]))[:, 0]
        low, high = np.where(within, middle, low), np.where(within, high, middle)
    return low[:, None] * rays


def _largest_rectangle(outline: Float64[ndarray, "direction 2"]) -> tuple[float, float, float, float]:
    """(left, top, right, bottom) within a closed outline about the origin.

    All four sides are shares of how far the outline reaches on its axis, the same share for opposite ones: what is cut off
    left and right is in proportion, and the principal point stays about where it was.
    """
    quarter = DIRECTIONS // 4
    right, bottom, left, top = (float(np.abs(outline[k * quarter]).max()) for k in range(4))
    x, y = outline.T
    shares = np.stack([np.where(x > 0, x / right, -x / left), np.where(y > 0, y / bottom, -y / top)], -1)
    # Each piece of the outline keeps away rectangles that reach farther than its nearer end in both.
    pieces = np.minimum(shares, np.roll(shares, -1, axis=0))
    pieces = np.minimum(pieces[np.argsort(pieces[:, 0])], 1)
    # As wide as up to a piece, a rectangle is as high as the pieces before it leave room for.
    heights = np.minimum.accumulate(np.concatenate([[1.0], pieces[:-1, 1]]))
    best = int(np.argmax(pieces[:, 0] * heights))
    share_x, share_y = float(pieces[best, 0]), float(heights[best])
    return -left * share_x, -top * share_y, right * share_x, bottom * share_y
