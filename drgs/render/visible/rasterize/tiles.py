"""Which surfels each 16x16 tile must blend, in order: front to back by centre depth, ties by index."""

from dataclasses import dataclass

import torch
import warp as wp
from torch import Tensor

from drgs.warp_torch import warp_array, warp_device

TILE = 16


@dataclass(frozen=True, eq=False)
class TileLists:
    """Pairs of tile and surfel, twice: tile-major for blending, surfel-major for summing gradients."""

    starts: Tensor
    """(tile + 1,) int32: list entries of tile t are starts[t] .. starts[t + 1]."""
    list_surfel: Tensor
    """(pair,) int32."""
    list_pair: Tensor
    """(pair,) int32: the entry's place in surfel-major order."""
    offsets: Tensor
    """(surfel + 1,) int32: a surfel's pairs in surfel-major order."""


@wp.func_native("""
// On the CPU: radix sort by depth (stable, 3 passes of 11 bits), then a counting sort into tiles, which keeps that order.
const int n = counts.shape[0];
unsigned* const key = (unsigned*)scratch.data;
int* const index = scratch.data + n;
unsigned* const key_other = (unsigned*)scratch.data + 2 * n;
int* const index_other = scratch.data + 3 * n;
int seen = 0;
double nearest = 1e300, farthest = -1e300;
for (int s = 0; s < n; ++s) {
    if (counts.data[s] == 0) continue;
    index[seen++] = s;
    nearest = depths.data[s] < nearest ? depths.data[s] : nearest;
    farthest = depths.data[s] > farthest ? depths.data[s] : farthest;
}
// 32 bits over the range of depths met: finer than float32 wherever the scene is.
const double steps = farthest > nearest ? 4294967295.0 / (farthest - nearest) : 0.0;
for (int k = 0; k < seen; ++k) key[k] = (unsigned)((depths.data[index[k]] - nearest) * steps);
unsigned* from_key = key; unsigned* to_key = key_other;
int* from = index; int* to = index_other;
for (int shift = 0; shift < 33; shift += 11) {
    int histogram[2049] = {0};
    for (int k = 0; k < seen; ++k) ++histogram[((from_key[k] >> shift) & 2047) + 1];
    for (int k = 0; k < 2048; ++k) histogram[k + 1] += histogram[k];
    for (int k = 0; k < seen; ++k) {
        const int place = histogram[(from_key[k] >> shift) & 2047]++;
        to_key[place] = from_key[k];
        to[place] = from[k];
    }
    unsigned* const swap_key = from_key; from_key = to_key; to_key = swap_key;
    int* const swap_index = from; from = to; to = swap_index;
}
int* const start = starts.data;
for (int t = 0; t <= tile_count; ++t) start[t] = 0;
for (int k = 0; k < seen; ++k) {
    const int* const r = rects.data + 4 * (long)from[k];
    for (int y = r[2]; y <= r[3]; ++y) for (int x = r[0]; x <= r[1]; ++x) ++start[y * tiles_x + x + 1];
}
for (int t = 0; t < tile_count; ++t) start[t + 1] += start[t];
for (int t = 0; t < tile_count; ++t) cursor.data[t] = start[t];
for (int k = 0; k < seen; ++k) {
    const int s = from[k];
    int pair = offsets.data[s];
    const int* const r = rects.data + 4 * (long)s;
    for (int y = r[2]; y <= r[3]; ++y) for (int x = r[0]; x <= r[1]; ++x) {
        const int place = cursor.data[y * tiles_x + x]++;
        list_surfel.data[place] = s;
        list_pair.data[place] = pair++;
    }
}
""")
def _fill_lists(
    depths: wp.array[wp.float64],
    rects: wp.array2d[wp.int32],
    counts: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    tiles_x: int,
    tile_count: int,
    scratch: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    cursor: wp.array[wp.int32],
    list_surfel: wp.array[wp.int32],
    list_pair: wp.array[wp.int32],
): ...


@wp.kernel(enable_backward=False)
def fill_lists(
    depths: wp.array[wp.float64],
    rects: wp.array2d[wp.int32],
    counts: wp.array[wp.int32],
    offsets: wp.array[wp.int32],
    tiles_x: int,
    tile_count: int,
    # outputs
    scratch: wp.array[wp.int32],
    starts: wp.array[wp.int32],
    cursor: wp.array[wp.int32],
    list_surfel: wp.array[wp.int32],
    list_pair: wp.array[wp.int32],
):
    _fill_lists(depths, rects, counts, offsets, tiles_x, tile_count, scratch, starts, cursor, list_surfel, list_pair)


def build_tile_lists(
    depths: Tensor, tile_rects: Tensor, tile_counts: Tensor, tiles_x: int, tiles_y: int, first_row: int | None = None
) -> TileLists:
    """Lists from per-surfel tile rectangles (x0, x1, y0, y1 inclusive) and counts (0: unseen).

    Args:
        first_row: of the `tiles_y` rows of tiles that the lists are for; None: the image has no others. The order is that of the whole image.
    """
    device, tile_count = depths.device, tiles_x * tiles_y
    pair_counts = tile_counts
    if first_row is not None:
        tile_rects = tile_rects.clone()
        low, high = (tile_rects[:, 2] - first_row).clamp(min=0), (tile_rects[:, 3] - first_row).clamp(max=tiles_y - 1)
        tile_rects[:, 2], tile_rects[:, 3] = low, high
        rows, columns = (high - low + 1).clamp(min=0), tile_rects[:, 1] - tile_rects[:, 0] + 1
        pair_counts = torch.where(tile_counts > 0, rows * columns, 0).int()
    offsets = torch.zeros(len(depths) + 1, dtype=torch.int32, device=device)
    torch.cumsum(pair_counts, 0, dtype=torch.int32, out=offsets[1:])
    pair_count = int(offsets[-1])
    if device.type == "cpu":
        starts = torch.empty(tile_count + 1, dtype=torch.int32)
        list_surfel, list_pair = torch.empty(pair_count, dtype=torch.int32), torch.empty(pair_count, dtype=torch.int32)
        scratch = torch.empty(4 * len(depths), dtype=torch.int32)
        wp.launch(
            fill_lists, dim=1, device=warp_device(depths),
            inputs=[warp_array(depths), warp_array(tile_rects), warp_array(tile_counts), warp_array(offsets), tiles_x, tile_count],
            outputs=[warp_array(x) for x in (scratch, starts, torch.empty_like(starts), list_surfel, list_pair)],
        )  # fmt: skip
        return TileLists(starts, list_surfel, list_pair, offsets)
    seen = tile_counts.nonzero().squeeze(1)
    order = seen[torch.sort(depths[seen], stable=True).indices]
    # CUDA: expand pairs in depth order, then one stable sort by tile.
    counts = pair_counts[order].long()
    surfel = torch.repeat_interleave(order, counts)
    local = torch.arange(len(surfel), device=device) - torch.repeat_interleave(torch.cumsum(counts, 0) - counts, counts)
    rect = tile_rects[surfel].long()
    columns = rect[:, 1] - rect[:, 0] + 1
    tile = (rect[:, 2] + local // columns) * tiles_x + rect[:, 0] + local % columns
    by_tile = torch.sort(tile, stable=True)
    starts = torch.searchsorted(by_tile.values, torch.arange(tile_count + 1, device=device)).to(torch.int32)
    pair = offsets[surfel].long() + local
    return TileLists(starts, surfel[by_tile.indices].to(torch.int32), pair[by_tile.indices].to(torch.int32), offsets)
