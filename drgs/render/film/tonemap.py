"""Linear radiance to pictures: exposure, tone curve, background, sRGB, straight alpha.

Sources of the curves (docs/sources.md): filmic: hill2016, brightened by 1 / 0.6 as three.js does, so that grey stays about as bright; agx:
sobotka2022 with wrensch2023's polynomial and the Rec.2020 primaries of Blender and Filament; neutral: khronos2024. They are the curves of
three.js, by which the viewer's local picture is drawn.
"""

from typing import get_args

import warp as wp
from torch import Tensor

from drgs.maths.constants import F0
from drgs.render.color_warp import srgb_of
from drgs.scene.tone_curve import ToneCurve
from drgs.warp_torch import launch, warp_device, warp_view

wp.set_module_options({"enable_backward": False})

Rows = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
"""Of a matrix that acts on a column."""
ACES_FROM_LINEAR: Rows = ((0.59719, 0.35458, 0.04823), (0.07600, 0.90834, 0.01566), (0.02840, 0.13383, 0.83777))
"""Rec.709 to AP1, with ACES' desaturation."""
LINEAR_FROM_ACES: Rows = ((1.60475, -0.53108, -0.07367), (-0.10208, 1.10813, -0.00605), (-0.00327, -0.07276, 1.07602))
REC2020_FROM_LINEAR: Rows = ((0.6274, 0.3293, 0.0433), (0.0691, 0.9195, 0.0113), (0.0164, 0.0880, 0.8956))
LINEAR_FROM_REC2020: Rows = ((1.6605, -0.5876, -0.0728), (-0.1246, 1.1329, -0.0083), (-0.0182, -0.1006, 1.1187))
AGX_FROM_REC2020: Rows = (
    (0.856627153315983, 0.0951212405381588, 0.0482516061458583),
    (0.137318972929847, 0.761241990602591, 0.101439036467562),
    (0.11189821299995, 0.0767994186031903, 0.811302368396859),
)
REC2020_FROM_AGX: Rows = (
    (1.1271005818144368, -0.11060664309660323, -0.016493938717834573),
    (-0.1413297634984383, 1.157823702216272, -0.016493938717834257),
    (-0.14132976349843826, -0.11060664309660294, 1.2519364065950405),
)
AGX_STOPS = (-12.47393, 4.026069)
"""Darkest and brightest radiance that AgX tells apart, as powers of two."""
AGX_CONTRAST = (-0.00232, 0.1191, 0.4298, -6.868, 31.96, -40.14, 15.5)
"""Its curve between them: factors of the powers of 0..1, lowest first."""
CURVES: tuple[ToneCurve, ...] = get_args(ToneCurve)
"""The kernel knows a curve by its place."""


def tonemap(
    radiance_linear: Tensor,
    coverage: Tensor,
    exposure: float = 0.0,
    background_linear: Tensor | None = None,
    curve: ToneCurve = "standard",
    behind_srgb: Tensor | None = None,
) -> Tensor:
    """(height, width, 4) sRGB in [0, 1] with straight alpha.

    Args:
        radiance_linear: (height, width, 3), alpha-normalised.
        coverage: (height, width), 0..1.
        exposure: [stops]; scales radiance of object and background alike.
        background_linear: (height, width, 3) radiance behind the object, or the (3,) colour of a screen, which neither exposure nor curve
            change; None leaves it transparent.
        behind_srgb: (height, width, 4) the background as it is shown, which pictures of one look share: pixels that nothing covers stay it. It is written to.
    """
    plain = background_linear is not None and background_linear.ndim == 1
    height, width = coverage.shape
    rgba = radiance_linear.new_empty(height, width, 4) if behind_srgb is None else behind_srgb
    behind = radiance_linear.new_empty(0, 0, 3)
    if background_linear is not None:
        behind = background_linear.to(radiance_linear).expand(height, width, 3)
    inputs = [
        width,
        2.0**exposure,
        CURVES.index(curve),
        plain,
        behind_srgb is not None,
        warp_view(radiance_linear, wp.vec3),
        warp_view(coverage),
        warp_view(behind, wp.vec3),
    ]
    launch(show, height * width, inputs, [warp_view(rgba, wp.vec4)], warp_device(rgba))
    return rgba


_ACES_FROM_LINEAR = wp.constant(wp.mat33(ACES_FROM_LINEAR))
_LINEAR_FROM_ACES = wp.constant(wp.mat33(LINEAR_FROM_ACES))
_REC2020_FROM_LINEAR = wp.constant(wp.mat33(REC2020_FROM_LINEAR))
_LINEAR_FROM_REC2020 = wp.constant(wp.mat33(LINEAR_FROM_REC2020))
_AGX_FROM_REC2020 = wp.constant(wp.mat33(AGX_FROM_REC2020))
_REC2020_FROM_AGX = wp.constant(wp.mat33(REC2020_FROM_AGX))
_AGX_FLOOR = wp.constant(AGX_STOPS[0])
_AGX_RANGE = wp.constant(AGX_STOPS[1] - AGX_STOPS[0])
_NEUTRAL_TOE = 2 * F0
"""Where the least channel is darker, less than F0 is taken off: khronos2024 removes the reflection that white light adds to a dielectric."""
_NEUTRAL_TOE_CURVATURE = 1 / (4 * F0)
_NEUTRAL_START = 0.8 - F0
"""Highlights are compressed from here on."""
_NEUTRAL_HEADROOM = 1 - _NEUTRAL_START
_NEUTRAL_HEADROOM_SQUARED = _NEUTRAL_HEADROOM * _NEUTRAL_HEADROOM
_NEUTRAL_POLE = _NEUTRAL_START - _NEUTRAL_HEADROOM
_C0, _C1, _C2, _C3, _C4, _C5, _C6 = (wp.constant(factor) for factor in AGX_CONTRAST)


@wp.func
def aces_fit(v: float) -> float:
    return (v * (v + 0.0245786) - 0.000090537) / (v * (0.983729 * v + 0.4329510) + 0.238081)


@wp.func
def filmic(color: wp.vec3) -> wp.vec3:
    v = _ACES_FROM_LINEAR * (color / 0.6)
    return _LINEAR_FROM_ACES * wp.vec3(aces_fit(v[0]), aces_fit(v[1]), aces_fit(v[2]))


@wp.func
def agx_fit(v: float) -> float:
    x = wp.clamp((wp.log2(wp.max(v, 1.0e-10)) - _AGX_FLOOR) / _AGX_RANGE, 0.0, 1.0)
    return _C0 + x * (_C1 + x * (_C2 + x * (_C3 + x * (_C4 + x * (_C5 + x * _C6)))))


@wp.func
def agx(color: wp.vec3) -> wp.vec3:
    v = _AGX_FROM_REC2020 * (_REC2020_FROM_LINEAR * color)
    v = _REC2020_FROM_AGX * wp.vec3(agx_fit(v[0]), agx_fit(v[1]), agx_fit(v[2]))
    v = wp.vec3(wp.pow(wp.max(v[0], 0.0), 2.2), wp.pow(wp.max(v[1], 0.0), 2.2), wp.pow(wp.max(v[2], 0.0), 2.2))
    return _LINEAR_FROM_REC2020 * v


@wp.func
def neutral(color: wp.vec3) -> wp.vec3:
    least = wp.min(color)
    offset = float(F0)
    if least < _NEUTRAL_TOE:
        offset = least - _NEUTRAL_TOE_CURVATURE * least * least
    color = color - wp.vec3(offset, offset, offset)
    peak = wp.max(color)
    if peak < _NEUTRAL_START:
        return color
    compressed = 1.0 - _NEUTRAL_HEADROOM_SQUARED / (peak - _NEUTRAL_POLE)
    whiteness = 1.0 - 1.0 / (0.15 * (peak - compressed) + 1.0)
    return (1.0 - whiteness) * (compressed / peak) * color + whiteness * wp.vec3(compressed, compressed, compressed)


@wp.func
def apply_tone_curve(color: wp.vec3, curve: int) -> wp.vec3:
    """reference.tonemap.apply_tone_curve; the place of the curve in CURVES."""
    if curve == 1:
        return filmic(color)
    if curve == 2:
        return agx(color)
    if curve == 3:
        return neutral(color)
    return color


@wp.kernel
def show(
    first: int,
    width: int,
    scale: float,
    curve: int,
    plain: bool,
    behind_is_there: bool,
    radiance: wp.array2d[wp.vec3],
    coverage: wp.array2d[float],
    background: wp.array2d[wp.vec3],
    # outputs
    rgba: wp.array2d[wp.vec4],
):
    i = first + wp.tid()
    y = i / width
    x = i - y * width
    alpha = wp.clamp(coverage[y, x], 0.0, 1.0)
    if behind_is_there and alpha <= 0.0:
        return
    color = wp.vec3(0.0, 0.0, 0.0)
    if alpha > 0.0:
        color = radiance[y, x]
    if background.shape[0] > 0 and not plain:
        color = alpha * color + (1.0 - alpha) * background[y, x]
    color = apply_tone_curve(scale * color, curve)
    if background.shape[0] > 0:
        if plain:
            color = alpha * color + (1.0 - alpha) * background[y, x]
        alpha = 1.0
    rgba[y, x] = wp.vec4(srgb_of(color[0]), srgb_of(color[1]), srgb_of(color[2]), alpha)
