"""Kernel of solve_albedo.py: what a photograph says of places on the faces, added to their sums; without gradient."""

import warp as wp
from jaxtyping import Float, Int32
from torch import Tensor

from drgs.maths.constants import SRGB_ENCODED_END, SRGB_GAMMA, SRGB_OFFSET, SRGB_SCALE, SRGB_SLOPE
from drgs.reconstruct.fit.evidence.metal_evidence import DARK
from drgs.reconstruct.fit.evidence.seen_vertices import SOLID
from drgs.reconstruct.fit.image_terms import SATURATED
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.face_samples import FaceSamples
from drgs.warp_torch import launch, warp_argument, warp_device

wp.set_module_options({"enable_backward": False})


@wp.func
def _linear(encoded: float) -> float:
    """As drgs.maths.color.linear_from_srgb."""
    return wp.where(
        encoded <= SRGB_ENCODED_END,
        encoded / SRGB_SLOPE,
        wp.pow((wp.max(encoded, SRGB_ENCODED_END) + SRGB_OFFSET) / SRGB_SCALE, SRGB_GAMMA),
    )


@wp.func
def _shown_at(picture: wp.array2d[wp.vec3], x: float, y: float) -> wp.vec3:
    """Linear between the middles of pixels, which lie at halves; not within half a pixel of the border."""
    column = int(x - 0.5)
    row = int(y - 0.5)
    right = x - 0.5 - float(column)
    below = y - 0.5 - float(row)
    upper = (1.0 - right) * picture[row, column] + right * picture[row, column + 1]
    lower = (1.0 - right) * picture[row + 1, column] + right * picture[row + 1, column + 1]
    return (1.0 - below) * upper + below * lower


@wp.kernel
def sums_kernel(
    first: int,
    corners: wp.array2d[wp.int64],
    weights: wp.array[wp.vec3],
    vertices: wp.array[wp.vec3],
    side: wp.array[int],
    black: wp.array[wp.vec3],
    slope: wp.array[wp.vec3],
    cosine: wp.array[float],
    turn: wp.mat33,
    shift: wp.vec3,
    mask: wp.array2d[float],
    picture: wp.array2d[wp.vec3],
    clipped: float,
    dark: float,
    solid: float,
    # outputs
    explained: wp.array2d[wp.vec3],
    trusted: wp.array2d[wp.vec3],
):
    """One sample.

    Many arguments because a struct of them would be filled anew, array by array, for each launch.
    """
    i = first + wp.tid()
    w = weights[i]
    nearest = int(0)
    most = float(-1.0)
    at = wp.vec3(0.0, 0.0, 0.0)
    b = wp.vec3(0.0, 0.0, 0.0)
    a = wp.vec3(0.0, 0.0, 0.0)
    facing = float(0.0)
    for k in range(3):
        if w[k] > 0.0:
            c = int(corners[i, k])
            if side[c] < 0:
                return
            if w[k] > most:
                most = w[k]
                nearest = c
            at += w[k] * vertices[c]
            b += w[k] * black[c]
            a += w[k] * slope[c]
            facing += w[k] * cosine[c]
    seen = turn * at + shift
    x = seen[0] / seen[2]
    y = seen[1] / seen[2]
    height = mask.shape[0]
    width = mask.shape[1]
    if not (x > 1.0 and y > 1.0 and x < float(width - 1) and y < float(height - 1)):
        return
    here = picture[int(y), int(x)]
    if mask[int(y), int(x)] <= solid or wp.max(wp.max(here[0], here[1]), here[2]) >= clipped:
        return
    encoded = _shown_at(picture, x, y)
    s = side[nearest]
    said = explained[s, i]
    weight = trusted[s, i]
    for k in range(3):
        photo = _linear(encoded[k])
        share = facing / (photo + dark)
        trust = share * share * a[k]
        said[k] += trust * (photo - b[k])
        weight[k] += trust * a[k]
    explained[s, i] = said
    trusted[s, i] = weight


def add_photograph(
    target: ViewTarget,
    samples: FaceSamples,
    vertices: Float[Tensor, "vertex 3"],
    side: Int32[Tensor, "vertex"],
    black: Float[Tensor, "vertex 3"],
    slope: Float[Tensor, "vertex 3"],
    cosine: Float[Tensor, "vertex"],
    explained: Float[Tensor, "side sample 3"],
    weight: Float[Tensor, "side sample 3"],
) -> None:
    """Add what the photograph says of each sample to its sums, those of the side that its nearest vertex is seen from: trust times slope times (photo - black),
    and trust times slope squared. It says nothing where a vertex around is not seen, or the pixel is not whole, or overexposed.

    Args:
        side: from which each vertex is seen; -1: it is not. black, slope: radiance without albedo, and what a unit of albedo adds. cosine: between normal and view.
    """
    camera = target.camera
    turn = camera.intrinsics @ camera.camera_from_world[:3, :3]
    shift = camera.intrinsics @ camera.camera_from_world[:3, 3]
    mask, picture = target.mask.contiguous(), target.saturation.contiguous()
    vectors = [warp_argument(x, wp.vec3) for x in (samples.weights, vertices)]
    inputs = [
        warp_argument(samples.corners), *vectors, warp_argument(side), warp_argument(black, wp.vec3), warp_argument(slope, wp.vec3),
        warp_argument(cosine), wp.mat33(*turn.flatten().tolist()), wp.vec3(*shift.tolist()), warp_argument(mask),
        warp_argument(picture, wp.vec3), SATURATED * target.ceiling, DARK, SOLID,
    ]  # fmt: skip
    outputs = [warp_argument(sums, wp.vec3) for sums in (explained, weight)]
    launch(sums_kernel, len(samples.corners), inputs, outputs, warp_device(explained))
