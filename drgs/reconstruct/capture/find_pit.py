"""What lies below a lid of the hull that is no plain vessel: the bed of a toy truck, with walls of several widths, blocks that stand in it and studs on its rim.

Seen along the lid's direction the object is a height a column, at most the hull's. Whole floors with walls are tried first, then blocks of columns at other
depths, large ones before small ones; what is kept leaves the least difference between the colour of a ray and what other views see where it ends, the mean
over all rays through the lid. A convex mirror shows things behind itself, as pits do, and such heights explain it well. But a pit has a rim: all around, most
of the lid is where the hull is. What mirrors show has none, it lies deep up to the lid's border, wherever that is. And a mirror that stands in a pit is
explained better by what it shows than by itself, but not well: columns at which views still differ by as much as they never do on paint are left full.

In: a lid of the hull and rays through it. Out: the depth of the object below it, a column.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy import ndarray
from scipy import ndimage
from torch import Tensor

from drgs.reconstruct.capture.column_trials import ColumnTrials
from drgs.reconstruct.capture.hull_rays import SolidRays
from drgs.render.intersect.trace_rays import trace_rays
from drgs.render.intersect.tracer import AbstractTracer

BEYOND = 1e-3
"""Of the radius: from where a ray enters or leaves the hull to where it is followed on."""
FAR = 1e6
"""Height of columns that are not below the lid: what comes there has met a wall."""
MOST_DIFFERENCE = 0.3
"""Display values; what leaves the object counts as much."""


@dataclass(frozen=True)
class PitSettings:
    """Lengths are shares of half of the hull's longest side."""

    least_lid: float = 0.03
    """Share of the hull's vertices that a lid has, at least. 1: no pits are looked for."""
    column: float = 0.025
    """Width."""
    walls: tuple[float, ...] = (0.0, 0.05, 0.1, 0.15, 0.2, 0.25, 0.3)
    """Of floors that are tried at first: so far inside the lid's border."""
    depths: tuple[float, ...] = (0.05, 0.1, 0.15, 0.2, 0.3, 0.4, 0.55, 0.7, 0.9)
    blocks: tuple[float, ...] = (0.4, 0.2, 0.1)
    """Widths."""
    promising: tuple[float, float] = (0.9, 0.7)
    """Shares of the lid's difference that may be left, at most: by one floor and wall, and after the first blocks. Beds and pots leave 0.53 to 0.71 and 0.53 to 0.6."""
    rays: int = 8_000
    """Through the lid, at most: so few that one thread is as fast as all, and tries one depth while others try theirs."""
    shallow: float = 0.04
    """What is less deep is rim."""
    rim: float = 0.25
    """Share of the lid's border that is so, at least."""
    border: int = 2
    """Its width, in columns."""
    better: float = 0.55
    """Share of the lid's difference that may be left without the third that differ most: many heights explain more than one wall and one depth."""
    least: int = 16
    """Columns that hang together."""
    unlike: float = 0.055
    """Mean difference (display values) of the rays that enter around a column, from which it is left full. Columns that are rightly empty have 0.03 to 0.04 in the
    median and 0.06 to 0.08 at most in nine of ten (things on a plate, a plant's pot), those dug into metal 0.07 to 0.08 and 0.05 at least in nine of ten."""
    around: int = 5
    """Columns, each way, over which that is averaged."""


@dataclass(frozen=True, eq=False)
class Pit:
    """Depths of columns below a lid [world units]."""

    axes: Float[ndarray, "3 3"]
    """Unit: the two directions of columns' rows, and the lid's outward direction."""
    low: Float[ndarray, "2"]
    """Where the first column begins, along the first two."""
    width: float
    lid: Float[ndarray, "u v"]
    """Height of the hull."""
    depth: Float[ndarray, "u v"]
    """0: nothing is empty there."""
    alike: Bool[ndarray, "u v"]
    """Where that deserves belief by itself, and not only because the rest of the pit does."""

    def where_alike(self) -> "Pit":
        """Less deep nowhere, and full where views do not agree."""
        return replace(self, depth=np.where(self.alike, self.depth, 0.0))

    def holds(self, places: Float[ndarray, "x y z 3"], above: float) -> Bool[ndarray, "x y z"]:
        """What is empty, and up to `above` over the lid."""
        across = places @ self.axes.T
        column = np.floor((across[..., :2] - self.low) / self.width).astype(int)
        known = ((column >= 0) & (column < self.depth.shape)).all(-1)
        u, v = np.where(known[..., None], column, 0).transpose(3, 0, 1, 2)
        height, lid, depth = across[..., 2], self.lid[u, v], self.depth[u, v]
        return known & (depth > 0) & (height > lid - depth) & (height < lid + above)


def find_pit(
    lid: Bool[Tensor, "vertex"],
    direction: Float[Tensor, "3"],
    looks: SolidRays,
    outer: AbstractTracer,
    radius: float,
    cell: float,
    settings: PitSettings,
) -> Pit | None:
    """None where nothing explains more.

    Args:
        lid: of the hull's vertices.
        direction: the lid's, outward.
        looks: through the lid.
        outer: the hull.
        cell: side of what counts as one place [world units].
    """
    columns = _Columns.below(lid, direction, outer, radius, settings)
    if int(columns.inside.sum()) < settings.least:
        return None
    search = _Search(columns, _rays_of(looks, columns, outer, radius, cell, settings), radius, settings)
    depth = search.best()
    if depth is None:
        return None
    depth = ndimage.median_filter(np.minimum(depth, columns.most), 3) * columns.inside
    patch, count = ndimage.label(depth >= settings.shallow * radius)
    large = np.flatnonzero(np.bincount(patch.ravel(), minlength=count + 1) >= settings.least)
    depth = np.where(np.isin(patch, large[large > 0]), depth, 0.0)
    if not bool((depth > 0).any()):
        return None
    return Pit(columns.axes, columns.low, columns.width, columns.lid, depth, search.alike(depth))


@dataclass(frozen=True, eq=False)
class _Columns:
    """The object's place below a lid, cut along the lid's direction."""

    axes: Float[ndarray, "3 3"]
    low: Float[ndarray, "2"]
    width: float
    lid: Float[ndarray, "u v"]
    inside: Bool[ndarray, "u v"]
    """Those that the lid covers."""
    most: Float[ndarray, "u v"]
    """Depth above a floor as thick as what counts as rim."""

    @classmethod
    def below(
        cls, lid: Bool[Tensor, "vertex"], direction: Float[Tensor, "3"], outer: AbstractTracer, radius: float, settings: PitSettings
    ) -> "_Columns":
        out = direction.cpu().double().numpy()
        first = np.cross(out, np.eye(3)[int(np.abs(out).argmin())])
        first /= np.linalg.norm(first)
        axes = np.stack([first, np.cross(out, first), out])
        vertices = outer.mesh.vertices.cpu().double().numpy() @ axes.T
        chosen, width = vertices[lid.cpu().numpy()], settings.column * radius
        low = chosen[:, :2].min(0) - 2 * width
        shape = np.ceil((chosen[:, :2].max(0) - low) / width).astype(int) + 2
        top = chosen[:, 2].max() + 0.1 * radius
        middles = [start + (np.arange(count) + 0.5) * width for start, count in zip(low, shape, strict=True)]
        above = np.stack([*(along.ravel() for along in np.meshgrid(*middles, indexing="ij")), np.full(shape.prod(), top)], -1) @ axes
        start = torch.from_numpy(above).to(direction)
        down = trace_rays(start, (-direction).expand_as(start).contiguous(), outer)
        of_lid = lid[outer.mesh.faces.long()].sum(1) >= 2
        inside = down.hit & of_lid[torch.where(down.hit, down.face, torch.zeros_like(down.face)).long()]
        height = top - torch.where(down.hit, down.distance, torch.zeros_like(down.distance)).cpu().double().numpy()
        # Where the lid is bumpy its steep places are not of it, and would stand as pillars.
        covered = ndimage.binary_fill_holes(ndimage.binary_closing(inside.cpu().numpy().reshape(shape)))
        covered &= down.hit.cpu().numpy().reshape(shape)
        entered = torch.where(down.hit, down.distance, torch.zeros_like(down.distance)) + BEYOND * radius
        below = trace_rays((start - entered[:, None] * direction).contiguous(), (-direction).expand_as(start).contiguous(), outer)
        thick = torch.where(below.hit, below.distance, torch.zeros_like(entered)).cpu().double().numpy().reshape(shape)
        return cls(axes, low, width, height.reshape(shape), covered, np.maximum(thick - settings.shallow * radius, 0))


def _rays_of(looks: SolidRays, columns: _Columns, outer: AbstractTracer, radius: float, cell: float, settings: PitSettings) -> ColumnTrials:
    """Some of the looks, followed through the hull."""
    drawn = torch.randperm(len(looks), generator=torch.Generator().manual_seed(0))[: settings.rays].sort().values
    kept = torch.zeros(len(looks), dtype=torch.bool)
    kept[drawn] = True
    looks = looks[kept.to(looks.view.device)]
    origin, direction = looks.rays.origin, looks.rays.direction
    axes = torch.from_numpy(columns.axes).to(origin)

    def next_hit(start: Float[Tensor, "ray"]) -> tuple[Float[Tensor, "ray"], Bool[Tensor, "ray"]]:
        hits = trace_rays((origin + start[:, None] * direction).contiguous(), direction, outer)
        return start + torch.where(hits.hit, hits.distance, torch.zeros_like(start)), hits.hit

    enters, _ = next_hit(torch.zeros_like(origin[:, 0]))
    leaves, _ = next_hit(enters + 0.2 * BEYOND * radius)
    again, returns = next_hit(leaves + BEYOND * radius)
    low = torch.from_numpy(np.append(columns.low, 0.0)).to(origin)
    return ColumnTrials(
        (origin @ axes.T - low).contiguous(), (direction @ axes.T).contiguous(), enters + BEYOND * radius, leaves,
        torch.where(returns, again, torch.full_like(again, -1.0)), looks.colors, torch.unique(looks.view, return_inverse=True)[1],
        columns.width, cell, MOST_DIFFERENCE,
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Search:
    """Of the depths that leave least."""

    columns: _Columns
    rays: ColumnTrials
    radius: float
    settings: PitSettings

    def best(self) -> Float[ndarray, "u v"] | None:
        """None where one floor or large blocks leave too much already, and where there is no rim."""
        settings, inside = self.settings, self.columns.inside
        depth = np.zeros(inside.shape)
        (whole,) = self._left_by([depth], depth)
        within = ndimage.distance_transform_edt(inside) * self.columns.width
        floors = ((within > wall * self.radius) * deep * self.radius for wall in settings.walls for deep in settings.depths)
        least, depth = self._least(whole, depth, list(floors))
        if least > settings.promising[0] * whole:
            return None
        for number, width in enumerate(settings.blocks):
            for block in self._blocks(max(1, round(width / settings.column))):
                trials = []
                for deep in self._depths_to_try(depth, block) if number else (0.0, *settings.depths):
                    trials.append(depth.copy())
                    trials[-1][block] = deep * self.radius
                least, depth = self._least(least, depth, trials)
            if (number == 0 and least > settings.promising[1] * whole) or not self._has_rim(depth):
                return None
        return depth

    def _has_rim(self, depth: Float[ndarray, "u v"]) -> bool:
        inside = self.columns.inside
        border = inside & ~ndimage.binary_erosion(inside, iterations=self.settings.border)
        return float((depth[border] < self.settings.shallow * self.radius).mean()) >= self.settings.rim

    def _depths_to_try(self, depth: Float[ndarray, "u v"], block: tuple[slice, slice]) -> list[float]:
        """In a block whose larger one was tried at all depths: those in it and around it, and the next ones to its own."""
        steps = np.array([0.0, *self.settings.depths])
        side = [part.stop - part.start for part in block]
        around = tuple(slice(max(part.start - more, 0), part.stop + more) for part, more in zip(block, side, strict=True))
        found = np.unique(np.abs(depth[around] / self.radius - steps[:, None, None]).argmin(0))
        own = int(np.abs(np.median(depth[block]) / self.radius - steps).argmin())
        return [float(steps[k]) for k in sorted({*found.tolist(), max(own - 1, 0), min(own + 1, len(steps) - 1)})]

    def _blocks(self, side: int) -> Iterator[tuple[slice, slice]]:
        """Of that many columns each way, then once more half a block aside."""
        rows, across = self.columns.inside.shape
        for aside in (0, side // 2):
            for u in range(-aside, rows, side):
                for v in range(-aside, across, side):
                    block = slice(max(u, 0), u + side), slice(max(v, 0), v + side)
                    if self.columns.inside[block].any():
                        yield block

    def _least(
        self, least: float, depth: Float[ndarray, "u v"], trials: list[Float[ndarray, "u v"]]
    ) -> tuple[float, Float[ndarray, "u v"]]:
        """What is left by the depth or the trial that leaves least, the first of them, and which that is."""
        return min([(least, depth), *zip(self._left_by(trials, depth), trials, strict=True)], key=lambda pair: pair[0])

    def _left_by(self, trials: list[Float[ndarray, "u v"]], depth: Float[ndarray, "u v"]) -> list[float]:
        """By each trial's depths, much like `depth`, the mean difference of rays from what other views see where they end."""
        return self.rays.left(self._heights(np.stack(trials)), self._heights(depth)).tolist()

    def _heights(self, depth: Float[ndarray, "*trial u v"]) -> Float[Tensor, "*trial u v"]:
        heights = np.where(self.columns.inside, self.columns.lid - np.minimum(depth, self.columns.most), FAR)
        return torch.from_numpy(heights.astype(np.float32)).to(self.rays.origin.device)

    def alike(self, depth: Float[ndarray, "u v"]) -> Bool[ndarray, "u v"]:
        """Columns at which views agree about what is below; asked twice, for what is left full hides what was seen across it."""
        alike = depth > 0
        place = self.rays.at(self.rays.enters) / self.columns.width
        column = tuple(place[:, axis].long().clamp(0, size - 1).cpu().numpy() for axis, size in enumerate(depth.shape))
        for _ in range(2):
            difference, known = (values.cpu().double().numpy() for values in self.rays.differences(self._heights(depth * alike)))
            total, count = np.zeros(depth.shape), np.zeros(depth.shape)
            np.add.at(total, column, difference * known)
            np.add.at(count, column, known)
            total, count = (ndimage.uniform_filter(values, self.settings.around) for values in (total, count))
            alike &= total <= self.settings.unlike * count
        return ndimage.median_filter(alike, 3)
