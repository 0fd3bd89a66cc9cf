"""How well the normals that surfels show agree with those of the surface that they draw: value and gradient in two kernels.

As operations on whole maps, which autograd doubles, it took a fifteenth of stage 1. Source: docs/sources.md: huang2024, eq. 14.

In: maps of one view. Out: a number. Specified by drgs/reference/normal_consistency.py.
"""

from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.scene.camera import Camera
from drgs.warp_torch import launch, warp_array, warp_device

SOLID = wp.constant(0.5)
"""Coverage above which a pixel counts, where all around it have it, too."""


@wp.struct
class DepthView:
    """How a depth map lies in the world."""

    height: int
    width: int
    fx: float
    fy: float
    cx: float
    cy: float
    camera_from_world: wp.mat33
    """The rotation alone."""


@wp.func
def between(at: int, last: int):
    """The pixel whose two neighbours tell the slope at `at`: itself, at the border the next one within."""
    return wp.clamp(at, 1, last - 1)


@wp.kernel(enable_backward=False, module="unique")
def compare_normals(
    first: int,
    view: DepthView,
    normal_world: wp.array[wp.vec3],
    depth: wp.array[float],
    coverage: wp.array[float],
    # outputs
    disagreement: wp.array[float],
    counted: wp.array[float],
    by_normal: wp.array[wp.vec3],
    by_slopes: wp.array[wp.vec3],
):
    """Of each pixel 1 - n . n_depth and its derivatives by n and by the depth's slopes along x and y and the depth itself; 0 where it does not count."""
    p = first + wp.tid()
    width = view.width
    height = view.height
    row = p // width
    column = p % width
    disagreement[p] = 0.0
    counted[p] = 0.0
    by_normal[p] = wp.vec3()
    by_slopes[p] = wp.vec3()
    for y in range(wp.max(row - 1, 0), wp.min(row + 2, height)):
        for x in range(wp.max(column - 1, 0), wp.min(column + 2, width)):
            if not coverage[y * width + x] > SOLID:
                return
    here = row * width + between(column, width - 1)
    above = between(row, height - 1) * width + column
    slope_x = (depth[here + 1] - depth[here - 1]) * 0.5 * view.fx
    slope_y = (depth[above + width] - depth[above - width]) * 0.5 * view.fy
    across_x = (float(column) + 0.5 - view.cx) / view.fx
    across_y = (float(row) + 0.5 - view.cy) / view.fy
    # With P = z (x, y, 1), the cross product of P_x and P_y, divided by z.
    normal = wp.vec3(slope_x, slope_y, -(depth[p] + across_x * slope_x + across_y * slope_y))
    length = wp.max(wp.length(normal), 1.0e-12)
    drawn = normal / length
    shown = view.camera_from_world * normal_world[p]
    agreement = wp.dot(drawn, shown)
    disagreement[p] = 1.0 - agreement
    counted[p] = 1.0
    by_normal[p] = -(wp.transpose(view.camera_from_world) * drawn)
    turned = (agreement * drawn - shown) / length
    by_slopes[p] = wp.vec3(turned[0] - across_x * turned[2], turned[1] - across_y * turned[2], -turned[2])


@wp.func
def slope_gradient(slopes: wp.array[wp.vec3], line: int, step: int, axis: int, at: int, last: int):
    """Of what is told by the two neighbours of pixel `at` of a line: of it, and of the border beside it."""
    if at < 1 or at > last - 1:
        return 0.0
    total = slopes[line + at * step][axis]
    if at == 1:
        total += slopes[line][axis]
    if at == last - 1:
        total += slopes[line + last * step][axis]
    return total


@wp.kernel(enable_backward=False, module="unique")
def depth_gradient(
    first: int,
    view: DepthView,
    by_slopes: wp.array[wp.vec3],
    # outputs
    by_depth: wp.array[float],
):
    """What compare_normals' slopes say of each pixel's depth."""
    p = first + wp.tid()
    width = view.width
    height = view.height
    row = p // width
    column = p % width
    line = row * width
    along_x = slope_gradient(by_slopes, line, 1, 0, column - 1, width - 1) - slope_gradient(by_slopes, line, 1, 0, column + 1, width - 1)
    along_y = slope_gradient(by_slopes, column, width, 1, row - 1, height - 1) - slope_gradient(
        by_slopes, column, width, 1, row + 1, height - 1
    )
    by_depth[p] = by_slopes[p][2] + 0.5 * view.fx * along_x + 0.5 * view.fy * along_y


def _view(camera: Camera) -> Any:
    view = DepthView()
    view.height, view.width = camera.height, camera.width
    k = camera.intrinsics
    view.fx, view.fy, view.cx, view.cy = float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])
    view.camera_from_world = wp.mat33(*camera.camera_from_world[:3, :3].flatten().tolist())
    return view


class _NormalConsistency(torch.autograd.Function):
    """The mean over the pixels that count."""

    @staticmethod
    def forward(ctx: Any, normal_world: Tensor, depth: Tensor, coverage: Tensor, camera: Camera) -> Tensor:
        count, device = depth.numel(), depth.device
        per_pixel = torch.empty(2, count, device=device)
        slopes = torch.empty(2, count, 3, device=device)
        inputs = [_view(camera), warp_array(normal_world.view(-1, 3), wp.vec3), *(warp_array(x.reshape(-1)) for x in (depth, coverage))]
        outputs = [warp_array(per_pixel[0]), warp_array(per_pixel[1]), warp_array(slopes[0], wp.vec3), warp_array(slopes[1], wp.vec3)]
        launch(compare_normals, count, inputs, outputs, warp_device(depth))
        total, counted = per_pixel.sum(1)
        share = 1 / counted.clamp(min=1)
        ctx.save_for_backward(slopes, share)
        ctx.camera = camera
        return total * share

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, Tensor, None, None]:
        slopes, share = ctx.saved_tensors
        camera = ctx.camera
        by_depth = torch.empty(camera.height, camera.width, device=slopes.device)
        inputs = [_view(camera), warp_array(slopes[1], wp.vec3)]
        launch(depth_gradient, by_depth.numel(), inputs, [warp_array(by_depth.view(-1))], warp_device(slopes))
        factor = gradients[0] * share
        return (factor * slopes[0]).view(camera.height, camera.width, 3), factor * by_depth, None, None


def normal_consistency(
    normal_world: Float[Tensor, "height width 3"],
    depth: Float[Tensor, "height width"],
    coverage: Float[Tensor, "height width"],
    camera: Camera,
) -> Float[Tensor, ""]:
    """Scalar mean over solid pixels, among solid ones, of 1 - n . n_depth: surfels lie in the surface that they draw; differentiable in normals and depth.

    Args:
        camera: of at least 3 pixels a side.
    """
    return _NormalConsistency.apply(normal_world.contiguous(), depth.contiguous(), coverage.detach(), camera)
