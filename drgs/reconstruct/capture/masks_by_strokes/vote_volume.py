"""Which places in the world are the object's, when every picture has said which of its pixels are.

In: cameras and a mask of each. Out: a volume, cells in a box, and from it silhouettes. A place is the object's where few enough of the pictures that see it
say that it is not: unlike a visual hull's, whose every mask is to be trusted, this share is the caller's.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Float64
from numpy import ndarray
from scipy import ndimage
from torch import Tensor

from drgs.scene.camera import Camera

SEEN_SHARE = 0.5
"""Of the pictures that see the best seen place, how many must see all others."""
LEAST_ASKED = 0.1
"""Of the pictures: where fewer may vote on a place, they count as so many, so that one alone does not decide."""
SMALLEST_PART = 0.05
"""Of the largest part of a volume: smaller ones are not the object."""
RIM = 2
"""Cells around a volume, into which it may grow."""


@dataclass(frozen=True)
class Region:
    """A box in the world, and how finely it is divided."""

    low: Float64[ndarray, "3"]
    """[world units], this and the next."""
    high: Float64[ndarray, "3"]
    cells: int
    """Along the longest side."""

    @property
    def cell(self) -> float:
        """[world units]"""
        return float((self.high - self.low).max()) / self.cells

    def centers(self) -> Float[Tensor, "x y z 3"]:
        """Of the cells."""
        counts = np.maximum(1, np.ceil((self.high - self.low) / self.cell - 1e-6)).astype(int)
        axes = [torch.from_numpy(self.low[axis] + (np.arange(counts[axis]) + 0.5) * self.cell).float() for axis in range(3)]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), -1)


@dataclass(frozen=True, eq=False)
class Volume:
    """Cells that are the object's."""

    centers: Float[Tensor, "cell 3"]
    cell: float
    """Edge [world units]."""
    low: Float64[ndarray, "3"]
    """Of the box around them with a rim; this and the next."""
    high: Float64[ndarray, "3"]

    @property
    def size(self) -> float:
        """[cubic world units]"""
        return len(self.centers) * self.cell**3

    def around(self, cells: int) -> Region:
        """Its box, divided anew."""
        return Region(self.low, self.high, cells)


@dataclass(frozen=True, eq=False)
class Silhouette:
    """What a volume covers of a picture."""

    covers: Bool[ndarray, "height width"]
    cell_pixels: int
    """How wide its cells are there, about."""


def vote_volume(
    region: Region,
    cameras: Sequence[Camera],
    masks: Sequence[Float[Tensor, "_height _width"]],
    against: float,
    least_size: float = 0.0,
    most_against: float = 1.0,
    known: Sequence[Bool[Tensor, "_height _width"]] | None = None,
    possible: Callable[[Float[Tensor, "cell 3"]], Bool[Tensor, "cell"]] | None = None,
) -> Volume | None:
    """What of the region is the object's; None where nothing is.

    Args:
        masks: 1 object, 0 not. against: share of the pictures that see a place, of which more may not say that it is not the object's.
        known: pixels that may vote at all; None: all. possible: places that may be the object's; None: all.
        least_size: [cubic world units] if the volume were smaller, as many more may speak against it as make it that large, but no more than `most_against`.
    """
    centers = region.centers()
    points = centers.reshape(-1, 3)
    says_no, seen, asked = torch.zeros(len(points)), torch.zeros(len(points)), torch.zeros(len(points))
    for number, (camera, mask) in enumerate(zip(cameras, masks, strict=True)):
        pixels, depth = _projected(points, camera)
        size = pixels.new_tensor([camera.width, camera.height])
        inside = (depth > 0) & (pixels >= 0).all(-1) & (pixels < size).all(-1)
        places = (2 * pixels / size - 1)[None, None]
        found = torch.nn.functional.grid_sample(mask[None, None], places, align_corners=False, padding_mode="border")[0, 0, 0]
        votes = inside
        if known is not None:
            votes = inside & (
                torch.nn.functional.grid_sample(known[number].float()[None, None], places, align_corners=False)[0, 0, 0] > 0.5
            )
        says_no += torch.where(votes, 1 - found, 0.0)
        asked += votes
        seen += inside
    least_asked = 1.0 if known is None else max(1.0, LEAST_ASKED * len(cameras))
    share = torch.where(seen >= max(1.0, SEEN_SHARE * float(seen.max())), says_no / asked.clamp_min(least_asked), torch.inf)
    if possible is not None:
        share = torch.where(possible(points), share, torch.inf)
    wanted = min(int(least_size / region.cell**3), int(share.isfinite().sum()) - 1)
    if wanted > int((share <= against).sum()):
        against = max(against, min(most_against, float(share.kthvalue(wanted + 1).values)))
    return _volume((share <= against).reshape(centers.shape[:3]).numpy(), region, centers)


def _volume(held: Bool[ndarray, "x y z"], region: Region, centers: Float[Tensor, "x y z 3"]) -> Volume | None:
    """The large parts of what is held."""
    parts, count = ndimage.label(held)
    if count == 0:
        return None
    sizes = np.bincount(parts.reshape(-1), minlength=count + 1)
    sizes[0] = 0
    held = (sizes >= SMALLEST_PART * sizes.max())[parts]
    indices = np.argwhere(held)
    low, high = (region.low + (corner * region.cell) for corner in (indices.min(0) - RIM, indices.max(0) + 1 + RIM))
    return Volume(centers[torch.from_numpy(held)], region.cell, low, high)


def silhouette(volume: Volume, camera: Camera) -> Silhouette:
    """The pixels behind which the volume lies, to about a cell."""
    pixels, depth = _projected(volume.centers, camera)
    middle = max(float(depth.median()), volume.cell)
    stride = max(1, int(np.ceil(volume.cell * float(camera.intrinsics[0, 0]) / middle)))
    rows, columns = -(-camera.height // stride), -(-camera.width // stride)
    column, row = (pixels / stride).nan_to_num(-1, -1, -1).clamp(-1, max(rows, columns)).floor().long().unbind(-1)
    inside = (depth > 0) & (column >= 0) & (row >= 0) & (column < columns) & (row < rows)
    drawn = torch.zeros(rows, columns, dtype=torch.bool)
    drawn[row[inside], column[inside]] = True
    # Centres of neighbouring cells may leave one empty between them.
    closed = ndimage.binary_closing(np.pad(drawn.numpy(), 2), np.ones((3, 3)))[2:-2, 2:-2]
    smooth = torch.nn.functional.interpolate(
        torch.from_numpy(closed).float()[None, None], size=(rows * stride, columns * stride), mode="bilinear", align_corners=False
    )
    return Silhouette((smooth[0, 0, : camera.height, : camera.width] >= 0.5).numpy(), stride)


def _projected(points: Float[Tensor, "point 3"], camera: Camera) -> tuple[Float[Tensor, "point 2"], Float[Tensor, "point"]]:
    """Pixels, and depth along the axis [world units]; behind the camera pixels say nothing."""
    pixel_from_world = (camera.intrinsics.double() @ camera.camera_from_world.double()[:3]).float()
    projected = points @ pixel_from_world[:, :3].T + pixel_from_world[:, 3]
    depth = projected[:, 2]
    return projected[:, :2] / torch.where(depth > 0, depth, 1.0)[:, None], depth
