"""Which masks carve away what the others need.

A visual hull believes each mask alone, and should: what one view alone sees to be empty is empty, and most hollows between parts are seen through by few.
But one mask that leaves out a part of the object bores through the hull. Then other masks show it: pixels of theirs lie behind nothing that is left. So
silhouettes of the hull are compared with the masks it came from, and a view is left out where what it carves is needed by several times as many others.
Source: Landabaso, Pardàs, Casas 2008, "Shape from inconsistent silhouette" (docs/sources.md: landabaso2008), who ask so of each place; here views
answer for all that they carve, for what bores a hole through the middle of an object uncovers pixels only where it passes its thin parts.
"""

from dataclasses import dataclass, replace

import torch
import warp as wp
from jaxtyping import Bool, Float, Int32
from scipy import ndimage
from torch import Tensor

from drgs.reconstruct.capture.mask_stack import HALF_SIDE, MaskStack, seen_at
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

MOST_CARVERS = 3
"""A place that more views carve away is empty, whoever needs it. The kernel keeps their numbers in a wp.vec3i."""
NEEDED = 4
"""By how many times as many views a place must be needed as carve it away."""
LEAST_CARVED = 0.0003
"""Share of the object's volume that a wrong mask must have carved away where it is needed, each place shared among those who carve it."""
SLACK = 1
"""[pixels] around a silhouette in which a mask is not uncovered."""


@dataclass(frozen=True, eq=False)
class Carved:
    """Of each cell of space, which masks carve it away."""

    carvers: Int32[Tensor, "cell"]
    """How many views see past the object everywhere in the cell; counted up to MOST_CARVERS + 1."""
    whose: Int32[Tensor, "cell 3"]
    """The numbers of the first of them, -1 where there are fewer."""
    seen: Int32[Tensor, "cell"]
    """How many views see the cell, as long as carvers were counted."""


@wp.kernel
def find_carvers(
    first: int,
    points: wp.array[wp.vec3],
    projections: wp.array[wp.vec4],
    sizes: wp.array[wp.vec2i],
    widened: wp.array3d[wp.uint8],
    trusted: wp.array[wp.int32],
    level: float,
    # outputs
    count: wp.array[wp.int32],
    carvers: wp.array[wp.vec3i],
    seen_by: wp.array[wp.int32],
):
    """One thread a cell: how many trusted views see it, and how many and which of them see past the object there; counted up to MOST_CARVERS + 1."""
    i = first + wp.tid()
    found = wp.vec3i(-1, -1, -1)
    many = int(0)  # Warp: a variable that a loop changes must not be a constant
    seen = int(0)
    for view in range(widened.shape[0]):
        if trusted[view] != 0 and many <= 3:
            place = seen_at(projections, sizes, view, points[i])
            if place[2] > 0.0:
                seen += 1
                if float(widened[view, int(place[1]), int(place[0])]) <= level * 255.0:
                    if many < 3:
                        found[many] = view
                    many += 1
    count[i] = many
    carvers[i] = found
    seen_by[i] = seen


@wp.kernel
def draw_cells(
    first: int,
    points: wp.array[wp.vec3],
    projections: wp.array[wp.vec4],
    sizes: wp.array[wp.vec2i],
    # outputs
    drawn: wp.array3d[wp.uint8],
):
    """One thread a cell that is left: the pixel of its middle in every picture. Threads that meet write the same."""
    i = first + wp.tid()
    for view in range(drawn.shape[0]):
        place = seen_at(projections, sizes, view, points[i])
        if place[2] > 0.0:
            drawn[view, int(place[1]), int(place[0])] = wp.uint8(255)


@wp.kernel
def count_marked(
    first: int,
    points: wp.array[wp.vec3],
    projections: wp.array[wp.vec4],
    sizes: wp.array[wp.vec2i],
    marked: wp.array3d[wp.uint8],
    # outputs
    count: wp.array[wp.int32],
):
    """One thread a cell: in how many pictures its middle lies on a pixel that is marked by 1, and not by 0."""
    i = first + wp.tid()
    many = int(0)
    for view in range(marked.shape[0]):
        place = seen_at(projections, sizes, view, points[i])
        if place[2] > 0.0:
            many += int(marked[view, int(place[1]), int(place[0])])
    count[i] = many


def find_carved(
    masks: MaskStack, points: Float[Tensor, "cell 3"], cell: float, level: float, trusted: Int32[Tensor, "view"] | None = None
) -> Carved:
    """Args:
    points: middles of cells that are `cell` wide. level: of a mask, 0..1, above which it is object. trusted: 0 where a view does not count.
    """
    points, number = points.float().contiguous(), len(points)
    trusted = torch.ones(len(masks.masks), dtype=torch.int32) if trusted is None else trusted
    carvers, seen = (torch.zeros(number, dtype=torch.int32) for _ in range(2))
    whose = torch.zeros(number, MOST_CARVERS, dtype=torch.int32)
    inputs = [
        *masks.widened(ndimage.maximum_filter, masks.reach(points.mean(0), cell, HALF_SIDE)).inputs(points),
        warp_array(trusted),
        level,
    ]
    outputs = [warp_array(carvers), warp_array(whose, wp.vec3i), warp_array(seen)]
    launch(find_carvers, number, inputs=inputs, outputs=outputs, device=warp_device(points))
    return Carved(carvers, whose, seen)


def wrong_masks(masks: MaskStack, points: Float[Tensor, "cell 3"], cell: float, level: float, fewest_seen: int, most: int) -> list[int]:
    """Numbers of at most so many views, the worst first.

    Args:
        points, cell, level: as find_carved takes them. fewest_seen: views that must see a place of the object.
    """
    trusted, wrong = torch.ones(len(masks.masks), dtype=torch.int32), list[int]()
    while len(wrong) < most:
        carved = find_carved(masks, points, cell, level, trusted)
        possible = (carved.carvers <= MOST_CARVERS) & (carved.seen >= fewest_seen)
        left, doubted = ((possible & of).nonzero().squeeze(1) for of in (carved.carvers == 0, carved.carvers > 0))
        uncovered = _uncovered(masks, points[left], max(masks.reach(points.mean(0), cell, HALF_SIDE)))
        if len(doubted) == 0 or not bool(uncovered.masks.any()):
            break
        needed, carvers = _marked(uncovered, points[doubted]), carved.carvers[doubted]
        share = ((needed >= NEEDED * carvers) / carvers)[:, None].expand(-1, MOST_CARVERS)
        whose = carved.whose[doubted]
        blame = torch.zeros(len(trusted)).index_add_(0, whose[whose >= 0], share[whose >= 0])
        worst = int(blame.argmax())
        if float(blame[worst]) < LEAST_CARVED * int(possible.sum()):
            break
        trusted[worst] = 0
        wrong.append(worst)
    return wrong


def _uncovered(masks: MaskStack, points: Float[Tensor, "cell 3"], reach: int) -> MaskStack:
    """1 where a mask is object for more than a pixel around and no cell lies near."""
    points, drawn = points.float().contiguous(), replace(masks, masks=torch.zeros_like(masks.masks))
    launch(draw_cells, len(points), inputs=drawn.inputs(points)[:3], outputs=[drawn.inputs(points)[3]], device=warp_device(points))
    uncovered = (masks.masks > 127) & ~_grown(drawn.masks > 0, reach + SLACK)
    return replace(masks, masks=(~_grown(~uncovered, 1)).to(torch.uint8).contiguous())


def _grown(marked: Bool[Tensor, "view height width"], by: int) -> Bool[Tensor, "view height width"]:
    """By so many pixels on all sides."""
    return torch.nn.functional.max_pool2d(marked.float(), 2 * by + 1, 1, by) > 0


def _marked(masks: MaskStack, points: Float[Tensor, "cell 3"]) -> Int32[Tensor, "cell"]:
    """In how many pictures a cell's middle lies on what is not 0."""
    points, count = points.float().contiguous(), torch.zeros(len(points), dtype=torch.int32)
    launch(count_marked, len(points), inputs=masks.inputs(points), outputs=[warp_array(count)], device=warp_device(points))
    return count
