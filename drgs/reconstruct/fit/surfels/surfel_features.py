"""What stage 1 blends of each surfel: its tangents and features, of the parameters that are fitted, in one kernel there and back.

As operations on all surfels, each on its own, it took a seventh of a step. Gradients are written out. Twin: drgs/reference/surfel_features.py.
"""

from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.maths.constants import F0
from drgs.maths.spherical_harmonics import K00, K1, K20, K21, K22, K30, K31, K32, K33
from drgs.render.visible.rasterize.gbuffer import SEEN_FROM_BEHIND
from drgs.warp_torch import launch, warp_argument, warp_device

wp.set_module_options({"enable_backward": False})

CHANNELS = 13
"""Normal, diffuse albedo, F0, roughness and what harmonics add: 3, 3, 3, 1, 3."""
_F0 = wp.constant(float(F0))
_BEHIND = wp.constant(float(SEEN_FROM_BEHIND))
_K = wp.constant(wp.types.vector(length=9, dtype=float)(K00, K1, K20, K21, K22, K30, K31, K32, K33))

_Coefficients = wp.types.vector(length=16, dtype=float)


@wp.func
def _harmonics(d: wp.vec3):
    """sh_basis."""
    x = d[0]
    y = d[1]
    z = d[2]
    xx = x * x
    yy = y * y
    zz = z * z
    b = _Coefficients()
    b[0] = _K[0]
    b[1] = -_K[1] * y
    b[2] = _K[1] * z
    b[3] = -_K[1] * x
    b[4] = _K[3] * x * y
    b[5] = -_K[3] * y * z
    b[6] = _K[2] * (2.0 * zz - xx - yy)
    b[7] = -_K[3] * x * z
    b[8] = _K[4] * (xx - yy)
    b[9] = -_K[8] * y * (3.0 * xx - yy)
    b[10] = 2.0 * _K[7] * x * y * z
    b[11] = -_K[6] * y * (4.0 * zz - xx - yy)
    b[12] = _K[5] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy)
    b[13] = -_K[6] * x * (4.0 * zz - xx - yy)
    b[14] = _K[7] * z * (xx - yy)
    b[15] = -_K[8] * x * (xx - 3.0 * yy)
    return b


@wp.func
def _share(logit: float) -> float:
    return 1.0 / (1.0 + wp.exp(-logit))


@wp.func
def _rotation(q: wp.vec4) -> wp.mat33:
    """Of a unit quaternion w, x, y, z."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return wp.mat33(
        1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y),
        2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x),
        2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y),
    )  # fmt: skip


@wp.func
def _column(m: wp.mat33, k: int) -> wp.vec3:
    return wp.vec3(m[0, k], m[1, k], m[2, k])


@wp.func
def _side(normal: wp.vec3, towards: wp.vec3) -> float:
    """facing_normals."""
    return wp.where(wp.dot(normal, towards) > _BEHIND, -1.0, 1.0)


@wp.kernel
def features_kernel(
    first: int,
    coefficients: int,
    camera: wp.vec3,
    centers: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec2],
    albedo_logits: wp.array[wp.vec3],
    roughness_logits: wp.array[float],
    metallic_logits: wp.array[float],
    sh_dc: wp.array[wp.vec3],
    sh_rest: wp.array2d[wp.vec3],
    open_share: wp.array[wp.vec3],
    # outputs
    tangents: wp.array2d[float],
    features: wp.array2d[float],
):
    """Many arguments because a struct of them would be filled anew, array by array, for each launch."""
    i = first + wp.tid()
    q = quats[i]
    turn = _rotation(q / wp.max(wp.length(q), 1.0e-12))
    towards = wp.normalize(centers[i] - camera)
    side = _side(_column(turn, 2), towards)
    albedo = wp.vec3(_share(albedo_logits[i][0]), _share(albedo_logits[i][1]), _share(albedo_logits[i][2]))
    metallic = _share(metallic_logits[i])
    lit = albedo
    if open_share.shape[0] > 0:
        lit = wp.cw_mul(albedo, open_share[i])
    basis = _harmonics(towards)
    sent = basis[0] * sh_dc[i]
    for k in range(1, coefficients):
        sent += basis[k] * sh_rest[i, k - 1]
    scale_u = wp.exp(log_scales[i][0])
    scale_v = wp.exp(log_scales[i][1])
    for c in range(3):
        tangents[i, 2 * c] = turn[c, 0] * scale_u
        tangents[i, 2 * c + 1] = turn[c, 1] * scale_v
        features[i, c] = side * turn[c, 2]
        features[i, 3 + c] = lit[c] * (1.0 - metallic)
        features[i, 6 + c] = _F0 * (1.0 - metallic) + albedo[c] * metallic
        features[i, 10 + c] = sent[c]
    features[i, 9] = _share(roughness_logits[i])


@wp.kernel
def features_adjoint(
    first: int,
    coefficients: int,
    camera: wp.vec3,
    centers: wp.array[wp.vec3],
    quats: wp.array[wp.vec4],
    log_scales: wp.array[wp.vec2],
    albedo_logits: wp.array[wp.vec3],
    roughness_logits: wp.array[float],
    metallic_logits: wp.array[float],
    sh_dc: wp.array[wp.vec3],
    sh_rest: wp.array2d[wp.vec3],
    open_share: wp.array[wp.vec3],
    g_tangents: wp.array2d[float],
    g_features: wp.array2d[float],
    # outputs
    g_quats: wp.array[wp.vec4],
    g_log_scales: wp.array[wp.vec2],
    g_albedo_logits: wp.array[wp.vec3],
    g_roughness_logits: wp.array[float],
    g_metallic_logits: wp.array[float],
    g_sh_dc: wp.array[wp.vec3],
    g_sh_rest: wp.array2d[wp.vec3],
):
    """Many arguments because a struct of them would be filled anew, array by array, for each launch."""
    i = first + wp.tid()
    length = wp.max(wp.length(quats[i]), 1.0e-12)
    q = quats[i] / length
    turn = _rotation(q)
    towards = wp.normalize(centers[i] - camera)
    side = _side(_column(turn, 2), towards)
    scale_u = wp.exp(log_scales[i][0])
    scale_v = wp.exp(log_scales[i][1])
    g = wp.mat33()
    by_scale = wp.vec2(0.0, 0.0)
    for c in range(3):
        g[c, 0] = g_tangents[i, 2 * c] * scale_u
        g[c, 1] = g_tangents[i, 2 * c + 1] * scale_v
        g[c, 2] = side * g_features[i, c]
        by_scale += wp.vec2(g[c, 0] * turn[c, 0], g[c, 1] * turn[c, 1])
    g_log_scales[i] = by_scale
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    by_unit = 2.0 * wp.vec4(
        x * (g[2, 1] - g[1, 2]) + y * (g[0, 2] - g[2, 0]) + z * (g[1, 0] - g[0, 1]),
        y * (g[0, 1] + g[1, 0]) + z * (g[0, 2] + g[2, 0]) + w * (g[2, 1] - g[1, 2]) - 2.0 * x * (g[1, 1] + g[2, 2]),
        x * (g[0, 1] + g[1, 0]) + z * (g[1, 2] + g[2, 1]) + w * (g[0, 2] - g[2, 0]) - 2.0 * y * (g[0, 0] + g[2, 2]),
        x * (g[0, 2] + g[2, 0]) + y * (g[1, 2] + g[2, 1]) + w * (g[1, 0] - g[0, 1]) - 2.0 * z * (g[0, 0] + g[1, 1]),
    )
    g_quats[i] = (by_unit - wp.dot(by_unit, q) * q) / length
    metallic = _share(metallic_logits[i])
    by_metallic = float(0.0)
    by_albedo = wp.vec3(0.0, 0.0, 0.0)
    sent = wp.vec3(0.0, 0.0, 0.0)
    for c in range(3):
        albedo = _share(albedo_logits[i][c])
        open_sky = float(1.0)
        if open_share.shape[0] > 0:
            open_sky = open_share[i][c]
        diffuse = g_features[i, 3 + c]
        mirrored = g_features[i, 6 + c]
        by_albedo[c] = (diffuse * open_sky * (1.0 - metallic) + mirrored * metallic) * albedo * (1.0 - albedo)
        by_metallic += mirrored * (albedo - _F0) - diffuse * albedo * open_sky
        sent[c] = g_features[i, 10 + c]
    g_albedo_logits[i] = by_albedo
    g_metallic_logits[i] = by_metallic * metallic * (1.0 - metallic)
    roughness = _share(roughness_logits[i])
    g_roughness_logits[i] = g_features[i, 9] * roughness * (1.0 - roughness)
    basis = _harmonics(towards)
    g_sh_dc[i] = basis[0] * sent
    for k in range(1, coefficients):
        g_sh_rest[i, k - 1] = basis[k] * sent


_DTYPES = (wp.vec3, wp.vec4, wp.vec2, wp.vec3, wp.float32, wp.float32, wp.vec3, wp.vec3, wp.vec3)
"""Of centres, quaternions, sizes, albedo, roughness, metallic, both of the harmonics and the open share."""


def _arguments(coefficients: int, camera: Tensor, values: list[Tensor]) -> list:
    arrays = (warp_argument(value, dtype) for value, dtype in zip(values, _DTYPES, strict=True))
    return [coefficients, wp.vec3(*camera.tolist()), *arrays]


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, coefficients: int, camera: Tensor, *given: Tensor) -> tuple[Tensor, Tensor]:
        values = [value.detach().contiguous() for value in given]
        values[6] = values[6].view(-1, 3)  # one coefficient each
        ctx.coefficients, ctx.camera = coefficients, camera
        ctx.save_for_backward(*values)
        count = len(values[0])
        tangents, features = values[0].new_empty(count, 3, 2), values[0].new_empty(count, CHANNELS)
        outputs = [warp_argument(tangents.view(count, 6)), warp_argument(features)]
        launch(features_kernel, count, _arguments(coefficients, camera, values), outputs, warp_device(features))
        return tangents, features

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        values = list(ctx.saved_tensors)
        count, upstream = len(values[0]), [gradient.contiguous() for gradient in gradients]
        found = [torch.empty_like(value) for value in values[1:7]]
        # Coefficients of higher degrees get none.
        rest = torch.empty_like(values[7]) if ctx.coefficients == 16 else torch.zeros_like(values[7])
        given = [
            *_arguments(ctx.coefficients, ctx.camera, values),
            warp_argument(upstream[0].view(count, 6)),
            warp_argument(upstream[1]),
        ]
        outputs = [warp_argument(value, dtype) for value, dtype in zip([*found, rest], _DTYPES[1:8], strict=True)]
        launch(features_adjoint, count, given, outputs, warp_device(values[0]))
        found[5] = found[5].view(count, 1, 3)
        return None, None, None, *found, rest if ctx.coefficients > 1 else None, None


def surfel_features(
    parameters: dict[str, Tensor], camera_center: Float[Tensor, "3"], sh_degree: int, open_share: Float[Tensor, "surfel 3"] | None = None
) -> tuple[Float[Tensor, "surfel 3 2"], Float[Tensor, "surfel 13"]]:
    """Tangents (world columns, as long as the surfels are wide) and features (CHANNELS) of the surfels seen from a camera; differentiable in all but
    the centres.

    Args:
        open_share: of the open sky's irradiance that arrives at each; None: all of it.
    """
    names = ("centers", "quats", "log_scales", "albedo_logits", "roughness_logits", "metallic_logits", "sh_dc", "sh_rest")
    share = parameters["centers"].new_empty(0, 3) if open_share is None else open_share
    return _Features.apply((sh_degree + 1) ** 2, camera_center, *(parameters[name] for name in names), share)
