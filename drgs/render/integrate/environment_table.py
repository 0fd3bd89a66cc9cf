"""Importance sampling of an environment: a density that matches the bilinear lookup.

The density over (u, v) interpolates `largest channel * sin(polar angle)` bilinearly between texel centres, the very
nodes between which `environment_radiance` interpolates (so light that leaks from a sun into the neighbouring
texels is sampled as well), plus two rows of weight 0 at the poles. Rows are drawn from the piecewise linear marginal;
given v, the running sums over columns of the two neighbouring rows are mixed by v, so both inversions are exact.
Density per solid angle: p(u, v) / (2 pi^2 sin(polar angle)).
"""

import math
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.maths.sampling import sample_linear
from drgs.scene.environment import Environment, direction_from_uv, uv_from_direction
from drgs.warp_torch import warp_array

MAX_RADIANCE = 1e12
"""Of a texel; a half-float picture holds 65504, squared luminance overflows at 1e19."""
LANES = 16
"""Of the vectors that CPU kernels search with."""


@dataclass(frozen=True, eq=False)
class EnvironmentTable:
    """Written by build_environment_table, read by the samplers; carries no gradient."""

    texels: Float[Tensor, "height_plus_2 width 4"]
    """Radiance and density before normalisation at texel centres, which a lookup interpolates alike; first and last row: the poles, with the
    radiance of the rows beside them and density 0."""
    padded_column_sums: Float[Tensor, "height_plus_2 pitch"]
    """column_sums, then infinity up to a multiple of LANES and LANES more: searches look at that many at once."""
    padded_row_sums: Float[Tensor, "pitch"]
    """row_sums, likewise."""
    coarse_column_sums: Float[Tensor, "height_plus_2 16"]
    """Of each row's column_sums every search_stride(width)-th."""

    @property
    def nodes(self) -> Float[Tensor, "height_plus_2 width"]:
        """Density before normalisation at texel centres."""
        return self.texels[..., 3]

    @property
    def column_sums(self) -> Float[Tensor, "height_plus_2 width_plus_1"]:
        """Running integral of each row over u, from the centre of column 0 onwards."""
        return self.padded_column_sums[:, : self.texels.shape[1] + 1]

    @property
    def row_sums(self) -> Float[Tensor, "height_plus_2"]:
        """Running integral over v of the rows' totals; the last entry is the integral of everything, 0 for a black sky."""
        return self.padded_row_sums[: len(self.texels)]


def search_stride(count: int) -> int:
    """Distance of the LANES entries among `count` that a search looks at first; it is then halved down to LANES."""
    stride = LANES
    while stride * LANES < count:
        stride *= 2
    return stride


def _beyond(count: int) -> int:
    """How much infinity stands behind a row of so many sums."""
    return -count % LANES + LANES


def build_environment_table(environment: Environment) -> EnvironmentTable:
    """The table of an environment; a few torch operations, cheap enough to repeat in training.

    Raises:
        ValueError: a texel is negative, not finite or above MAX_RADIANCE.
    """
    radiance = environment.radiance.detach()
    height, width, _ = radiance.shape
    darkest, brightest = (float(x) for x in radiance.aminmax())  # NaN where there is one
    if not (darkest >= 0 and brightest <= MAX_RADIANCE):
        raise ValueError(
            f"the environment's texels span {darkest:g} to {brightest:g}; expected finite radiance from 0 to {MAX_RADIANCE:g}: "
            "clamp it, or scale it and raise the edit's intensity"
        )
    # One entry of texels after the other, each written once: a table of half a million texels is made anew with every edit of the light.
    texels = radiance.new_empty(height + 2, width, 4)
    texels[1:-1, :, :3] = radiance
    texels[0, :, :3], texels[-1, :, :3] = radiance[0], radiance[-1]
    nodes = radiance.new_zeros(height + 2, width)
    polar = (torch.arange(height, device=radiance.device, dtype=radiance.dtype) + 0.5) * (math.pi / height)
    red, green, blue = radiance.unbind(-1)
    torch.mul(torch.maximum(torch.maximum(red, green), blue), torch.sin(polar)[:, None], out=nodes[1:-1])
    # A density knows no unit: the brightest texel becomes 0.5 to 1 by a power of two, which is exact, and no square under- or overflows.
    exponent = -math.frexp(brightest)[1]
    # In two steps: 2^149, for the dimmest sky, is no float32.
    nodes.mul_(2.0 ** (exponent // 2)).mul_(2.0 ** (exponent - exponent // 2))
    texels[..., 3] = nodes
    # Sums run in float64: after a sun of 1e6, a float32 sum would forget the dim texels behind it.
    cells = nodes.new_empty(height + 2, width, dtype=torch.float64)
    cells[:, :-1], cells[:, -1] = nodes[:, :-1] + nodes[:, 1:], nodes[:, -1] + nodes[:, 0]
    sums = cells.mul_(0.5 / width).cumsum_(1)
    padded = radiance.new_full((height + 2, width + 1 + _beyond(width + 1)), math.inf)
    padded[:, 0] = 0.0
    padded[:, 1 : width + 1] = sums
    totals = sums[:, -1]
    row_height = torch.full((height + 1,), 1 / height, device=radiance.device, dtype=torch.float64)
    row_height[0] = row_height[-1] = 0.5 / height
    row_sums = torch.cat([totals.new_zeros(1), (0.5 * row_height * (totals[1:] + totals[:-1])).cumsum(0)])
    padded_rows = torch.nn.functional.pad(row_sums.to(radiance.dtype), (0, _beyond(height + 2)), value=math.inf)
    columns = (torch.arange(LANES, device=radiance.device) * search_stride(width + 1)).clamp(max=padded.shape[1] - 1)
    return EnvironmentTable(texels, padded, padded_rows, padded[:, columns].contiguous())


def _row_of_v(v: Tensor, height: int) -> tuple[Tensor, Tensor]:
    """Row cell (between node rows j and j + 1) and the position inside it, 0..1."""
    y = v * height + 0.5
    j = torch.floor(y).clamp(0, height)
    t = torch.where(j == 0, 2 * (y - 0.5), torch.where(j == height, 2 * (y - j), y - j))
    return j.long(), t.clamp(0, 1)


def environment_pdf(table: EnvironmentTable, direction: Tensor) -> Tensor:
    """Density per solid angle of `sample_environment` at unit directions (..., 3) in the table's frame."""
    height, width = table.nodes.shape[0] - 2, table.nodes.shape[1]
    uv = uv_from_direction(direction)
    j, t = _row_of_v(uv[..., 1], height)
    x = uv[..., 0] * width - 0.5
    i0 = torch.floor(x)
    s = x - i0
    i0 = i0.long() % width
    i1 = (i0 + 1) % width
    upper = table.nodes[j, i0] * (1 - s) + table.nodes[j, i1] * s
    lower = table.nodes[j + 1, i0] * (1 - s) + table.nodes[j + 1, i1] * s
    sin_polar = torch.sqrt((1 - direction[..., 2] ** 2).clamp(min=1e-12))
    total = table.row_sums[-1]
    return torch.where(
        total > 0, (upper * (1 - t) + lower * t) / (2 * math.pi**2 * sin_polar * total.clamp(min=1e-37)), torch.zeros_like(t)
    )


def sample_environment(table: EnvironmentTable, u: Tensor) -> Tensor:
    """(..., 3) unit directions in the table's frame of numbers (..., 2); meaningless for a black sky (density 0)."""
    height, width = table.nodes.shape[0] - 2, table.nodes.shape[1]
    shape, u = u.shape[:-1], u.reshape(-1, 2)
    target = u[:, 0].contiguous() * table.row_sums[-1]
    j = (torch.searchsorted(table.row_sums, target, right=True) - 1).clamp(0, height)
    mass = table.row_sums[j + 1] - table.row_sums[j]
    t = sample_linear(
        ((target - table.row_sums[j]) / mass.clamp(min=1e-37)).clamp(0, 1), table.column_sums[j, -1], table.column_sums[j + 1, -1]
    )
    v = torch.where(j == 0, t * 0.5, torch.where(j == height, j - 0.5 + t * 0.5, j - 0.5 + t)) / height
    target = u[:, 1] * (table.column_sums[j, -1] * (1 - t) + table.column_sums[j + 1, -1] * t)
    low, high = torch.zeros_like(j), torch.full_like(j, width)
    while bool((high - low > 1).any()):  # the cell whose mixed running sum contains the target
        middle = (low + high) // 2
        below = table.column_sums[j, middle] * (1 - t) + table.column_sums[j + 1, middle] * t <= target
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    before = table.column_sums[j, low] * (1 - t) + table.column_sums[j + 1, low] * t
    after = table.column_sums[j, low + 1] * (1 - t) + table.column_sums[j + 1, low + 1] * t
    next_column = (low + 1) % width
    a = table.nodes[j, low] * (1 - t) + table.nodes[j + 1, low] * t
    b = table.nodes[j, next_column] * (1 - t) + table.nodes[j + 1, next_column] * t
    s = sample_linear(((target - before) / (after - before).clamp(min=1e-37)).clamp(0, 1), a, b)
    uv = torch.stack([((low + 0.5 + s) / width) % 1.0, v], -1)
    return direction_from_uv(uv).reshape(*shape, 3)


@wp.struct
class EnvironmentLight:
    """An environment as kernels see it: lookup, density and sampling in world space."""

    texels: wp.array2d[wp.vec4]
    column_sums: wp.array2d[float]
    """Padded; of the same pitch as in the table."""
    row_sums: wp.array[float]
    coarse_column_sums: wp.array2d[float]
    column_stride: int
    row_stride: int
    height: int
    width: int
    cos_rotation: float
    sin_rotation: float
    intensity: float


@wp.func
def uv_from_world_direction(light: EnvironmentLight, direction: wp.vec3) -> wp.vec3:
    """(u, v, sin of the polar angle) of a world direction."""
    x = light.cos_rotation * direction[0] + light.sin_rotation * direction[1]
    y = light.cos_rotation * direction[1] - light.sin_rotation * direction[0]
    sin_polar = wp.sqrt(direction[0] * direction[0] + direction[1] * direction[1])
    u = 0.5 - wp.atan2(y, x) * 0.15915494309
    v = wp.atan2(sin_polar, direction[2]) * 0.31830988618
    return wp.vec3(u, v, sin_polar)


@wp.func
def texel_at(light: EnvironmentLight, uv: wp.vec3) -> wp.vec4:
    """Radiance without the intensity, and density before normalisation, between four texel centres."""
    y = uv[1] * float(light.height) + 0.5
    row = wp.clamp(int(y), 0, light.height)
    t = y - float(row)
    if row == 0:
        t = 2.0 * (y - 0.5)
    if row == light.height:
        t = 2.0 * t
    t = wp.clamp(t, 0.0, 1.0)
    x = uv[0] * float(light.width) - 0.5
    x0 = wp.floor(x)
    s = x - x0
    column0 = int(x0)
    if column0 < 0:
        column0 += light.width
    if column0 >= light.width:
        column0 -= light.width
    column1 = column0 + 1
    if column1 >= light.width:
        column1 = 0
    upper = light.texels[row, column0] * (1.0 - s) + light.texels[row, column1] * s
    lower = light.texels[row + 1, column0] * (1.0 - s) + light.texels[row + 1, column1] * s
    return upper * (1.0 - t) + lower * t


@wp.func
def lookup_radiance(light: EnvironmentLight, uv: wp.vec3) -> wp.vec3:
    texel = texel_at(light, uv)
    return light.intensity * wp.vec3(texel[0], texel[1], texel[2])


@wp.func
def lookup_pdf(light: EnvironmentLight, uv: wp.vec3) -> float:
    total = light.row_sums[light.height + 1]
    if total <= 0.0:
        return 0.0
    return texel_at(light, uv)[3] / (19.7392088 * wp.max(uv[2], 1.0e-6) * total)


@wp.func
def wp_sample_linear(u: float, a: float, b: float) -> float:
    return u * (a + b) / wp.max(a + wp.sqrt(wp.max(a * a + u * (b * b - a * a), 0.0)), 1.0e-37)


@wp.func
def environment_direction(light: EnvironmentLight, u: wp.vec2) -> wp.vec3:
    """A world direction drawn from the table."""
    target = u[0] * light.row_sums[light.height + 1]
    low = wp.int32(0)
    high = light.height + 1
    while high - low > 1:
        middle = (low + high) >> 1
        if light.row_sums[middle] <= target:
            low = middle
        else:
            high = middle
    row = low
    before = light.row_sums[row]
    mass = wp.max(light.row_sums[row + 1] - before, 1.0e-37)
    upper_total = light.column_sums[row, light.width]
    lower_total = light.column_sums[row + 1, light.width]
    t = wp_sample_linear(wp.clamp((target - before) / mass, 0.0, 1.0), upper_total, lower_total)
    y = float(row) - 0.5 + t
    if row == 0:
        y = 0.5 * t
    if row == light.height:
        y = float(row) - 0.5 + 0.5 * t
    target = u[1] * (upper_total * (1.0 - t) + lower_total * t)
    low = wp.int32(0)
    high = light.width
    while high - low > 1:
        middle = (low + high) >> 1
        if light.column_sums[row, middle] * (1.0 - t) + light.column_sums[row + 1, middle] * t <= target:
            low = middle
        else:
            high = middle
    before = light.column_sums[row, low] * (1.0 - t) + light.column_sums[row + 1, low] * t
    after = light.column_sums[row, low + 1] * (1.0 - t) + light.column_sums[row + 1, low + 1] * t
    following = low + 1
    if following == light.width:
        following = 0
    a = light.texels[row, low][3] * (1.0 - t) + light.texels[row + 1, low][3] * t
    b = light.texels[row, following][3] * (1.0 - t) + light.texels[row + 1, following][3] * t
    s = wp_sample_linear(wp.clamp((target - before) / wp.max(after - before, 1.0e-37), 0.0, 1.0), a, b)
    azimuth = (0.5 - (float(low) + 0.5 + s) / float(light.width)) * 6.28318530718
    polar = 3.14159265359 * y / float(light.height)
    x = wp.cos(azimuth) * wp.sin(polar)
    z = wp.sin(azimuth) * wp.sin(polar)
    return wp.vec3(light.cos_rotation * x - light.sin_rotation * z, light.sin_rotation * x + light.cos_rotation * z, wp.cos(polar))


def environment_light(table: EnvironmentTable, rotation_degrees: float = 0.0, intensity: float = 1.0) -> Any:
    """The struct that kernels read; it keeps the tensors' memory alive.

    Args:
        rotation_degrees: counter-clockwise seen from above.
    """
    light = EnvironmentLight()
    light.texels = warp_array(table.texels.float(), wp.vec4)
    light.column_sums = warp_array(table.padded_column_sums.float())
    light.row_sums = warp_array(table.padded_row_sums.float())
    light.coarse_column_sums = warp_array(table.coarse_column_sums.float())
    light.height, light.width = table.texels.shape[0] - 2, table.texels.shape[1]
    light.column_stride, light.row_stride = search_stride(light.width + 1), search_stride(light.height + 2)
    light.cos_rotation = math.cos(math.radians(rotation_degrees))
    light.sin_rotation = math.sin(math.radians(rotation_degrees))
    light.intensity = intensity
    return light
