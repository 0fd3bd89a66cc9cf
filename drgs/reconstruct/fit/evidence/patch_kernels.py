"""Kernel of matched_texture.py: patches of a surface at several depths, looked up in photographs; without gradient."""

from collections.abc import Sequence

import torch
import warp as wp
from jaxtyping import Bool, Float, Int
from torch import Tensor

from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_argument, warp_device

wp.set_module_options({"enable_backward": False})


class PackedPictures:
    """Final. Pictures of one channel with their cameras, one after the other in memory."""

    def __init__(self, cameras: Sequence[Camera], pictures: Sequence[Float[Tensor, "_height _width"]]) -> None:
        device = pictures[0].device
        self.values = torch.cat([picture.flatten() for picture in pictures])
        counts = [picture.numel() for picture in pictures]
        sizes = [(camera.width, camera.height, sum(counts[:number])) for number, camera in enumerate(cameras)]
        self.sizes = torch.tensor(sizes, dtype=torch.int32, device=device)
        """(view, 3): width, height, and where its picture begins."""
        transforms = torch.stack([camera.camera_from_world for camera in cameras])
        intrinsics = torch.stack([camera.intrinsics for camera in cameras])
        self.turns = (intrinsics @ transforms[:, :3, :3]).contiguous()
        self.shifts = (intrinsics @ transforms[:, :3, 3:]).squeeze(-1).contiguous()
        """Of homogeneous pixels: turns @ place + shifts."""


@wp.kernel
def pattern_kernel(
    first: int,
    vertices: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    depths: wp.array[float],
    across: wp.array2d[wp.vec3],
    view: wp.array2d[wp.int64],
    counts: wp.array2d[wp.bool],
    turns: wp.array[wp.mat33],
    shifts: wp.array[wp.vec3],
    sizes: wp.array[wp.vec3i],
    pictures: wp.array[float],
    smooth: wp.array2d[float],
    faint: float,
    # outputs
    patterns: wp.array2d[float],
):
    """One vertex in one of its views, at all depths.

    Many arguments because a struct of them would be filled anew, array by array, for each launch.
    """
    tid = first + wp.tid()
    i = tid // view.shape[1]
    slot = tid % view.shape[1]
    if not counts[i, slot]:
        return
    number = int(view[i, slot])
    turn = turns[number]
    start = turn * vertices[i] + shifts[number]
    along = turn * normals[i]
    size = sizes[number]
    for d in range(depths.shape[0]):
        middle = start + depths[d] * along
        row = (i * depths.shape[0] + d) * view.shape[1] + slot
        begun = float(0.0)
        for s in range(across.shape[1]):
            at = middle + turn * across[i, s]
            # Pixels' middles lie at halves.
            nearness = 1.0 / wp.max(at[2], 1.0e-9)
            x = wp.clamp(at[0] * nearness - 0.5, 0.0, float(size[0] - 1))
            y = wp.clamp(at[1] * nearness - 0.5, 0.0, float(size[1] - 1))
            column = wp.min(int(x), size[0] - 2)
            line = wp.min(int(y), size[1] - 2)
            right = x - float(column)
            below = y - float(line)
            k = size[2] + line * size[0] + column
            upper = pictures[k] + right * (pictures[k + 1] - pictures[k])
            k += size[0]
            lower = pictures[k] + right * (pictures[k + 1] - pictures[k])
            value = upper + below * (lower - upper)
            # What differs from the first: of whole values sums would lose the digits of faint patterns.
            if s == 0:
                begun = value
            patterns[row, s] = value - begun
        for term in range(smooth.shape[0]):
            share = float(0.0)
            for s in range(across.shape[1]):
                share += smooth[term, s] * patterns[row, s]
            for s in range(across.shape[1]):
                patterns[row, s] -= share * smooth[term, s]
        square = float(0.0)
        for s in range(across.shape[1]):
            square += patterns[row, s] * patterns[row, s]
        scale = 1.0 / (wp.sqrt(square) + faint)
        for s in range(across.shape[1]):
            patterns[row, s] *= scale


def patterns_of_patches(
    vertices: Float[Tensor, "asked 3"],
    normals: Float[Tensor, "asked 3"],
    depths: Float[Tensor, "depth"],
    across: Float[Tensor, "asked sample 3"],
    view: Int[Tensor, "asked chosen"],
    counts: Bool[Tensor, "asked chosen"],
    pictures: PackedPictures,
    smooth: Float[Tensor, "term sample"],
    faint: float,
) -> Float[Tensor, "asked depth chosen sample"]:
    """Patches of length 1 without what is `smooth` in them, at each depth and in each of the chosen views; 0 where these do not count.

    Args:
        depths: along the normals [world units]. counts: only in views that are wider and higher than a pixel. across: from each vertex to the samples of its patch [world units]. smooth: rows of length 1, perpendicular to each other, that are taken out of each patch.
        faint: length of a patch that is noise.
    """
    patterns = vertices.new_zeros(len(vertices), len(depths), view.shape[1], across.shape[1])
    inputs = [
        warp_argument(vertices, wp.vec3), warp_argument(normals, wp.vec3), warp_argument(depths),
        warp_argument(across, wp.vec3), warp_argument(view), warp_argument(counts, wp.bool),
        warp_argument(pictures.turns, wp.mat33), warp_argument(pictures.shifts, wp.vec3), warp_argument(pictures.sizes, wp.vec3i),
        warp_argument(pictures.values), warp_argument(smooth), faint,
    ]  # fmt: skip
    launch(pattern_kernel, view.numel(), inputs, [warp_argument(patterns.view(-1, across.shape[1]))], warp_device(patterns))
    return patterns
