"""What heights of columns leave between the views: whole trials side by side.

find_pit tries thousands, of eight thousand rays each; as torch's operations one took three times as long, most of it sorting. On the CPU each thread takes
its share of the trials whole. Formulas: drgs/reference/column_trials.py.

In: rays through a lid, heights of the columns below it. Out: what each trial leaves.
"""

from dataclasses import dataclass
from functools import cached_property

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.reconstruct.capture.hull_rays import seen_from_elsewhere
from drgs.warp_torch import launch, thread_count, warp_array, warp_device

CELLS_AWAY = wp.constant(1 << 14)
"""A place is numbered by its cell along three axes, each less far from where rays enter: 45 bits, which leave 18 for a view. The object is some hundred
cells long."""


@wp.func
def meets_columns(
    origin: wp.vec3, direction: wp.vec3, start: float, end: float, heights: wp.array3d[float], trial: int, width: float, step: float
) -> float:
    """Along a ray, by the columns' axes, to the first place that is in a column or beside all of them; -1 where there is none before the end."""
    t = start
    found = float(-1.0)
    while t < end and found < 0.0:
        place = origin + t * direction
        u = int(wp.floor(place[0] / width))
        v = int(wp.floor(place[1] / width))
        if u < 0 or v < 0 or u >= heights.shape[1] or v >= heights.shape[2] or place[2] <= heights[trial, u, v]:
            found = t
        t += step
    return found


@wp.kernel(enable_backward=False, module="unique")
def meet_columns(
    first: int,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    start: wp.array[float],
    end: wp.array[float],
    heights: wp.array3d[float],
    width: float,
    step: float,
    # outputs
    distance: wp.array[float],
):
    """meets_columns of the first trial, a thread a ray."""
    i = first + wp.tid()
    distance[i] = meets_columns(origin[i], direction[i], start[i], end[i], heights, 0, width, step)


@wp.func
def _slot(keys: wp.array3d[wp.int64], part: int, table: int, key: wp.int64) -> int:
    """Of a table: the key's own, or the free one that is to be its."""
    slots = keys.shape[2]
    # The fractional part of multiples of the golden ratio lies evenly (Knuth, multiplicative hashing).
    mixed = wp.uint64(key) * wp.uint64(11400714819323198485)
    at = int(mixed >> wp.uint64(32)) & (slots - 1)
    while keys[part, table, at] != key and keys[part, table, at] >= wp.int64(0):
        at = (at + 1) & (slots - 1)
    return at


@wp.kernel(enable_backward=False, module="unique")
def leave_between_views(
    first: int,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    start: wp.array[float],
    end: wp.array[float],
    returns: wp.array[float],
    colors: wp.array[wp.vec3],
    view: wp.array[int],
    views: int,
    heights: wp.array3d[float],
    box: wp.vec4i,
    otherwise: wp.array[float],
    width: float,
    cell: float,
    first_cell: wp.vec3i,
    most: float,
    # outputs
    keys: wp.array3d[wp.int64],
    sums: wp.array3d[wp.vec4],
    slots: wp.array3d[int],
    left: wp.array[float],
):
    """Of each keys.shape[0]-th trial, the mean difference of its rays from what other views see where they end, which is `otherwise` for those that pass by
    all columns of the box (first u, v, last u, v). `keys`, `sums` (part, table, slot) and `slots` (part, table, ray) are scratch: of places, and of places
    by views.

    Many arguments because a struct of them would be filled anew, array by array, for each launch.
    """
    part = first + wp.tid()
    rays = origin.shape[0]
    away = wp.int64(CELLS_AWAY)
    for trial in range(part, heights.shape[0], keys.shape[0]):
        for table in range(2):
            for slot in range(keys.shape[2]):
                keys[part, table, slot] = wp.int64(-1)
        for ray in range(rays):
            distance = otherwise[ray]
            a = (origin[ray] + start[ray] * direction[ray]) / width
            b = (origin[ray] + end[ray] * direction[ray]) / width
            aside = wp.max(a[0], b[0]) < float(box[0]) or wp.min(a[0], b[0]) >= float(box[2] + 1)
            beyond = wp.max(a[1], b[1]) < float(box[1]) or wp.min(a[1], b[1]) >= float(box[3] + 1)
            if not (aside or beyond):
                distance = meets_columns(origin[ray], direction[ray], start[ray], end[ray], heights, trial, width, 0.5 * width)
                if distance < 0.0:
                    distance = returns[ray]
            slots[part, 0, ray] = -1
            if distance >= 0.0:
                place = (origin[ray] + distance * direction[ray]) / cell
                x = wp.int64(int(wp.floor(place[0])) - first_cell[0]) + away
                y = wp.int64(int(wp.floor(place[1])) - first_cell[1]) + away
                z = wp.int64(int(wp.floor(place[2])) - first_cell[2]) + away
                key = (x * (away + away) + y) * (away + away) + z
                color = wp.vec4(colors[ray][0], colors[ray][1], colors[ray][2], 1.0)
                for table in range(2):
                    own = wp.where(table == 0, key, key * wp.int64(views) + wp.int64(view[ray]))
                    slot = _slot(keys, part, table, own)
                    if keys[part, table, slot] < wp.int64(0):
                        keys[part, table, slot] = own
                        sums[part, table, slot] = wp.vec4(0.0, 0.0, 0.0, 0.0)
                    sums[part, table, slot] = sums[part, table, slot] + color
                    slots[part, table, ray] = slot
        total = wp.float64(0.0)
        count = int(0)
        for ray in range(rays):
            if slots[part, 0, ray] < 0:
                total += wp.float64(most)
                count += 1
            else:
                others = sums[part, 0, slots[part, 0, ray]] - sums[part, 1, slots[part, 1, ray]]
                if others[3] > 0.5:
                    off = float(0.0)
                    for channel in range(3):
                        off += wp.abs(colors[ray][channel] - others[channel] / others[3]) / 3.0
                    total += wp.float64(wp.min(off, most))
                    count += 1
        left[trial] = wp.where(count > 0, float(total / wp.float64(wp.max(count, 1))), most)


@dataclass(frozen=True, eq=False)
class ColumnTrials:
    """Rays through a lid, by the columns' axes, from where the first column begins; what they would leave if columns were so high."""

    origin: Float[Tensor, "ray 3"]
    direction: Float[Tensor, "ray 3"]
    enters: Float[Tensor, "ray"]
    """The hull; a little later."""
    leaves: Float[Tensor, "ray"]
    returns: Float[Tensor, "ray"]
    """Where it meets the hull once more; -1: nowhere."""
    colors: Float[Tensor, "ray 3"]
    view: Int[Tensor, "ray"]
    """From 0."""
    width: float
    """Of a column [world units]."""
    cell: float
    """Side of what counts as one place [world units]."""
    most: float
    """Difference that counts, at most, and that of rays which leave the object."""

    def at(self, distance: Float[Tensor, "ray"]) -> Float[Tensor, "ray 3"]:
        return self.origin + distance[:, None] * self.direction

    def ends(self, heights: Float[Tensor, "u v"]) -> Float[Tensor, "ray"]:
        """Distances to where rays meet columns of these heights, or the hull once more; -1: they leave the object."""
        found = torch.empty_like(self.enters)
        inputs = [*self._along, warp_array(heights[None]), self.width, 0.5 * self.width]
        launch(meet_columns, len(found), inputs, [warp_array(found)], warp_device(found))
        return torch.where(found < 0, self.returns, found)

    def differences(self, heights: Float[Tensor, "u v"]) -> tuple[Float[Tensor, "ray"], Bool[Tensor, "ray"]]:
        """Of rays from what other views see where they end, and whether anything is seen there."""
        distance = self.ends(heights)
        ended = distance >= 0
        mean, seen = seen_from_elsewhere(self.at(distance), ended, self.colors, self.view, self.cell)
        difference = (self.colors - mean).abs().mean(1).clamp(max=self.most)
        return torch.where(ended, difference, torch.full_like(difference, self.most)), seen | ~ended

    def left(self, heights: Float[Tensor, "trial u v"], near: Float[Tensor, "u v"]) -> Float[Tensor, "trial"]:
        """The mean of `differences` of each trial, where anything is seen; `most` where nothing is.

        Args:
            near: heights that the trials' do not differ much from: only rays that pass where they differ are followed for each.
        """
        if self.origin.device.type != "cpu":  # where one thread for all rays of a trial is slow, and a sort is not
            return torch.stack([self._mean_of(*self.differences(height)) for height in heights])
        changed = (heights != near).any(0).nonzero()
        box = wp.vec4i(*changed.amin(0).tolist(), *changed.amax(0).tolist()) if len(changed) else wp.vec4i(0, 0, -1, -1)
        otherwise = self.ends(near)
        found = self.origin.new_empty(len(heights))
        keys, sums, slots = self._tables
        given = [
            *self._along,
            *(warp_array(part, kind) for part, kind in ((self.returns, None), (self.colors, wp.vec3), (self.view.int(), None))),
        ]
        inputs = [
            *given,
            int(self.view.max()) + 1,
            warp_array(heights),
            box,
            warp_array(otherwise),
            self.width,
            self.cell,
            self._first_cell,
            self.most,
        ]
        scratch = [warp_array(keys), warp_array(sums, wp.vec4), warp_array(slots)]
        launch(leave_between_views, min(len(keys), len(heights)), inputs, [*scratch, warp_array(found)], warp_device(found))
        return found

    def _mean_of(self, difference: Float[Tensor, "ray"], known: Bool[Tensor, "ray"]) -> Float[Tensor, ""]:
        count = known.sum()
        return torch.where(count > 0, (difference * known).sum() / count.clamp(min=1), self.most)

    @cached_property
    def _along(self) -> list[wp.array]:
        """What of the rays both kernels take."""
        parts = ((self.origin, wp.vec3), (self.direction, wp.vec3), (self.enters, None), (self.leaves, None))
        return [warp_array(part, kind) for part, kind in parts]

    @cached_property
    def _first_cell(self) -> wp.vec3i:
        """Of where rays enter: the world's own middle may be far from the object."""
        return wp.vec3i(*torch.floor(self.at(self.enters).amin(0) / self.cell).int().tolist())

    @cached_property
    def _tables(self) -> tuple[Tensor, Tensor, Tensor]:
        """Keys, sums and slots of leave_between_views, of each thread: half empty at least, so that searches in them are short."""
        rays = len(self.origin)
        slots = 1 << (2 * rays - 1).bit_length()
        size = (thread_count(), 2)
        keys = torch.empty(*size, slots, dtype=torch.int64)
        return keys, torch.empty(*size, slots, 4), torch.empty(*size, rays, dtype=torch.int32)
