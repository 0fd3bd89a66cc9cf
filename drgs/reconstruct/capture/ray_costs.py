"""What rays through a radiance grid cost, the gradient of that, and how far they see: one thread a ray, there and back.

As some fifty operations on all samples a step of the fit took five times as long. Formulas: drgs/reference/ray_costs.py.
"""

import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from drgs.warp_torch import launch, launch_adding, warp_argument, warp_device

wp.set_module_options({"enable_backward": False})

PASSED = 1e-7
"""Is added to what passes a sample, so that it can be divided by."""
LEAST_STOPPED = 0.01
"""Share of a ray's light below which its middle is drawn to the eye."""


@wp.struct
class _Cell:
    """Of the grid, with a place in it."""

    base: wp.vec3i
    """Its first node."""
    part: wp.vec3
    """Of its side, along each axis."""


@wp.func
def _cell_at(at: wp.vec3) -> _Cell:
    found = _Cell()
    found.base = wp.vec3i(int(wp.floor(at[0])), int(wp.floor(at[1])), int(wp.floor(at[2])))
    found.part = at - wp.vec3(float(found.base[0]), float(found.base[1]), float(found.base[2]))
    return found


@wp.func
def _node(here: _Cell, corner: int, count: int) -> int:
    """Of the eight around a place; -1 where there is none."""
    i = here.base[0] + corner // 4
    j = here.base[1] + (corner // 2) % 2
    k = here.base[2] + corner % 2
    within = wp.min(wp.min(i, j), k) >= 0 and wp.max(wp.max(i, j), k) < count
    return wp.where(within, (i * count + j) * count + k, -1)


@wp.func
def _share(here: _Cell, corner: int) -> float:
    x = wp.where(corner // 4 == 1, here.part[0], 1.0 - here.part[0])
    y = wp.where((corner // 2) % 2 == 1, here.part[1], 1.0 - here.part[1])
    return x * y * wp.where(corner % 2 == 1, here.part[2], 1.0 - here.part[2])


@wp.func
def _inside_and_density(inside: wp.array[float], density: wp.array[float], here: _Cell, count: int) -> wp.vec2:
    total = wp.vec2(0.0, 0.0)
    for corner in range(8):
        node = _node(here, corner, count)
        if node >= 0:
            total += _share(here, corner) * wp.vec2(inside[node], density[node])
    return total


@wp.func
def _inner(at: wp.vec3, count: int) -> wp.vec3:
    last = float(count) - 1.001
    return wp.vec3(wp.clamp(at[0], 0.0, last), wp.clamp(at[1], 0.0, last), wp.clamp(at[2], 0.0, last))


@wp.func
def _shown(colors: wp.array2d[wp.vec4], row: wp.array[wp.int64], here: _Cell, count: int, harmonics: wp.vec4) -> wp.vec3:
    red = wp.vec4(0.0, 0.0, 0.0, 0.0)
    green = wp.vec4(0.0, 0.0, 0.0, 0.0)
    blue = wp.vec4(0.0, 0.0, 0.0, 0.0)
    for corner in range(8):
        r = int(row[_node(here, corner, count)])
        share = _share(here, corner)
        red += share * colors[r, 0]
        green += share * colors[r, 1]
        blue += share * colors[r, 2]
    raw = wp.vec3(wp.dot(red, harmonics), wp.dot(green, harmonics), wp.dot(blue, harmonics))
    return wp.vec3(1.0 / (1.0 + wp.exp(-raw[0])), 1.0 / (1.0 + wp.exp(-raw[1])), 1.0 / (1.0 + wp.exp(-raw[2])))


@wp.func
def _add_color(gradients: wp.array2d[wp.vec4], row: wp.array[wp.int64], here: _Cell, count: int, harmonics: wp.vec4, g: wp.vec3):
    """The gradient g of what _shown has before the sigmoid."""
    red = g[0] * harmonics
    green = g[1] * harmonics
    blue = g[2] * harmonics
    for corner in range(8):
        r = int(row[_node(here, corner, count)])
        share = _share(here, corner)
        wp.atomic_add(gradients, r, 0, share * red)
        wp.atomic_add(gradients, r, 1, share * green)
        wp.atomic_add(gradients, r, 2, share * blue)


@wp.func
def _offset(k: int, shake: float, count: int) -> float:
    """Share of the way at which a ray's k-th sample lies."""
    return (float(k) + shake) / float(count)


@wp.func
def _stopped(density: float, step: float) -> float:
    """Share of the light that a sample stops, whose cell's side has that density before softplus."""
    dense = wp.where(density > 20.0, density, wp.log(1.0 + wp.exp(wp.min(density, 20.0))))
    return 1.0 - wp.exp(-dense * step)


@wp.kernel
def rays_there(
    first: int,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    near: wp.array[float],
    far: wp.array[float],
    photo: wp.array[wp.vec3],
    shake: wp.array[float],
    low: wp.vec3,
    cell: float,
    count: int,
    density: wp.array[float],
    inside: wp.array[float],
    colors: wp.array2d[wp.vec4],
    row: wp.array[wp.int64],
    least: float,
    # outputs
    samples: wp.array2d[wp.vec3],
    shown: wp.array2d[wp.vec3],
    off: wp.array[wp.vec3],
    stopped_and_middle: wp.array[wp.vec2],
):
    """What each ray shows, less the photograph. Of its samples (ray, sample): density before softplus, opacity, weight, and the colour `shown`
    where that is looked up; of all: opacity, and where in sides of the box the weight lies on average.

    Many arguments because a struct of them would be filled anew, array by array, for each launch.
    """
    ray = first + wp.tid()
    d = direction[ray]
    harmonics = wp.vec4(1.0, d[0], d[1], d[2])
    start = near[ray] - cell
    length = far[ray] + cell - start
    step = length / (float(count) * cell)
    side = cell * float(count - 5)
    passed = float(1.0)
    total = float(0.0)
    kept = float(0.0)
    middle = float(0.0)
    image = wp.vec3(0.0, 0.0, 0.0)
    for k in range(count):
        offset = _offset(k, shake[ray], count)
        at = (origin[ray] + (start + length * offset) * d - low) / cell
        here = _cell_at(at)
        value = _inside_and_density(inside, density, here, count)
        stopped = float(0.0)
        if value[0] > 0.5:
            stopped = _stopped(value[1], step)
        w = stopped * passed
        samples[ray, k] = wp.vec3(value[1], stopped, w)
        passed *= 1.0 - stopped + PASSED
        total += w
        middle += w * offset * length / side
        if w > least:
            kept += w
            seen = _shown(colors, row, _cell_at(_inner(at, count)), count, harmonics)
            shown[ray, k] = seen
            image += w * seen
    # What was not looked up has the photograph's colour.
    off[ray] = image + (total - kept) * photo[ray] - photo[ray]
    stopped_and_middle[ray] = wp.vec2(total, middle / wp.max(total, LEAST_STOPPED))


@wp.kernel
def rays_back(
    first: int,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    near: wp.array[float],
    far: wp.array[float],
    shake: wp.array[float],
    low: wp.vec3,
    cell: float,
    count: int,
    row: wp.array[wp.int64],
    weights: wp.vec2,
    least: float,
    samples: wp.array2d[wp.vec3],
    shown: wp.array2d[wp.vec3],
    off: wp.array[wp.vec3],
    stopped_and_middle: wp.array[wp.vec2],
    # outputs
    cost: wp.array[float],
    density_gradient: wp.array[float],
    color_gradient: wp.array2d[wp.vec4],
):
    """Each ray's cost and its gradient. `weights` are those of an opaque object and of gathered density.

    Many arguments because a struct of them would be filled anew, array by array, for each launch.
    """
    ray = first + wp.tid()
    d = direction[ray]
    harmonics = wp.vec4(1.0, d[0], d[1], d[2])
    start = near[ray] - cell
    length = far[ray] + cell - start
    step = length / (float(count) * cell)
    scale = length / (cell * float(count - 5))
    total = stopped_and_middle[ray][0]
    middle = stopped_and_middle[ray][1]
    clear = wp.clamp(total, 1.0e-4, 1.0)
    scattered = float(0.0)
    pull = float(0.0)
    for k in range(count):
        away = _offset(k, shake[ray], count) * scale - middle
        scattered += samples[ray, k][2] * wp.abs(away)
        pull -= samples[ray, k][2] * wp.where(away > 0.0, 1.0, wp.where(away < 0.0, -1.0, 0.0))
    cost[ray] = wp.dot(off[ray], off[ray]) / 3.0 - weights[0] * wp.log(clear) + weights[1] * scattered

    g_image = 2.0 / 3.0 * off[ray]
    g_total = wp.where(clear == total, -weights[0] / clear, 0.0)
    behind = float(0.0)
    for back in range(count):
        k = count - 1 - back
        offset = _offset(k, shake[ray], count)
        stopped = samples[ray, k][1]
        w = samples[ray, k][2]
        at = (origin[ray] + (start + length * offset) * d - low) / cell
        g_weight = g_total + weights[1] * (wp.abs(offset * scale - middle) + pull * offset * scale / wp.max(total, LEAST_STOPPED))
        if w > least:
            seen = shown[ray, k]
            g_weight += wp.dot(g_image, seen)
            slope = wp.cw_mul(g_image, wp.cw_mul(seen, wp.vec3(1.0, 1.0, 1.0) - seen)) * w
            _add_color(color_gradient, row, _cell_at(_inner(at, count)), count, harmonics, slope)
        if stopped > 0.0:
            g_opacity = g_weight * w / stopped - behind / (1.0 - stopped + PASSED)
            g_value = g_opacity * step * (1.0 - stopped) / (1.0 + wp.exp(-samples[ray, k][0]))
            here = _cell_at(at)
            for corner in range(8):
                node = _node(here, corner, count)
                if node >= 0:
                    wp.atomic_add(density_gradient, node, g_value * _share(here, corner))
        behind += g_weight * w


@wp.kernel
def rays_stop(
    first: int,
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    near: wp.array[float],
    far: wp.array[float],
    low: wp.vec3,
    cell: float,
    count: int,
    density: wp.array[float],
    inside: wp.array[float],
    # outputs
    weights: wp.array2d[float],
    median: wp.array[float],
    spread: wp.array[float],
):
    """Distance at which half of each ray's light is stopped, inf where it never is, and the mean distance of what stops it from its own mean; by samples in
    the middles of even stretches, whose weights (ray, sample) are left behind.

    Many arguments because a struct of them would be filled anew, array by array, for each launch.
    """
    ray = first + wp.tid()
    samples = weights.shape[1]
    start = near[ray] - cell
    length = far[ray] + cell - start
    step = length / (float(samples) * cell)
    passed = float(1.0)
    total = float(0.0)
    moment = float(0.0)
    half = float(wp.inf)
    for k in range(samples):
        distance = start + length * _offset(k, 0.5, samples)
        value = _inside_and_density(inside, density, _cell_at((origin[ray] + distance * direction[ray] - low) / cell), count)
        stopped = float(0.0)
        if value[0] > 0.5:
            stopped = _stopped(value[1], step)
        w = stopped * passed
        weights[ray, k] = w
        passed *= 1.0 - stopped + PASSED
        total += w
        moment += w * distance
        if total > 0.5 and half == wp.inf:
            half = distance
    middle = moment / wp.max(total, LEAST_STOPPED)
    scattered = float(0.0)
    for k in range(samples):
        scattered += weights[ray, k] * wp.abs(start + length * _offset(k, 0.5, samples) - middle)
    median[ray] = half
    spread[ray] = scattered / wp.max(total, LEAST_STOPPED)


def ray_depths(
    rays: tuple[Tensor, Tensor, Tensor, Tensor],
    low: Float[Tensor, "3"],
    cell: float,
    inside: Float[Tensor, "n n n"],
    density: Float[Tensor, "n n n"],
    samples: int,
) -> tuple[Float[Tensor, "ray"], Float[Tensor, "ray"]]:
    """As rays_stop has them, by so many samples a ray.

    Args:
        rays: of ray_costs. low, cell, inside, density: of RadianceGrid.
    """
    flat, device = density.detach().contiguous().reshape(-1), warp_device(density)
    given = [warp_argument(values.contiguous(), dtype) for values, dtype in zip(rays, _TYPES, strict=False)]
    count = len(rays[0])
    weights, median, spread = flat.new_empty(count, samples), flat.new_empty(count), flat.new_empty(count)
    inputs = [*given, wp.vec3(*low.tolist()), cell, len(density), warp_argument(flat), warp_argument(inside.reshape(-1))]
    launch(rays_stop, count, inputs, [warp_argument(weights), warp_argument(median), warp_argument(spread)], device)
    return median, spread


def ray_costs(
    rays: tuple[Tensor, Tensor, Tensor, Tensor],
    photo: Float[Tensor, "ray 3"],
    shake: Float[Tensor, "ray 1"],
    low: Float[Tensor, "3"],
    cell: float,
    inside: Float[Tensor, "n n n"],
    row: Int[Tensor, "node"],
    density: Float[Tensor, "n n n"],
    colors: Float[Tensor, "row 12"],
    weights: tuple[float, float],
    least: float,
) -> tuple[Float[Tensor, ""], Float[Tensor, "n n n"], Float[Tensor, "row 12"]]:
    """Their sum, and its gradients by `density` and `colors`.

    Many arguments because they are what rays_there and rays_back take.

    Args:
        rays: origins (ray, 3), unit directions (ray, 3), where they enter the hull (ray,) and leave it (ray,). photo: sRGB. shake: 0..1, of a ray's
            samples in their stretches. low, cell, inside, row, density, colors: of RadianceGrid. weights: of an opaque object and of gathered density.
        least: RadianceGridSettings.least_weight.
    """
    given = tuple(values.contiguous() for values in (*rays, photo, shake[:, 0]))
    density, colors = density.detach().contiguous(), colors.detach().contiguous()
    flat, device, count, side = density.reshape(-1), warp_device(density), len(given[0]), len(density)
    samples, hues = density.new_empty(count, side, 3), density.new_empty(count, side, 3)
    off, sums, cost = (density.new_empty(count, *tail) for tail in ((3,), (2,), ()))
    origin, direction, near, far, photos, shaken = (warp_argument(x, dtype) for x, dtype in zip(given, _TYPES, strict=True))
    space = (wp.vec3(*low.tolist()), cell, side)
    there = [*(warp_argument(x, wp.vec3) for x in (samples, hues, off)), warp_argument(sums, wp.vec2)]
    rows = warp_argument(row)
    inputs = [
        origin,
        direction,
        near,
        far,
        photos,
        shaken,
        *space,
        warp_argument(flat),
        warp_argument(inside.reshape(-1)),
        warp_argument(colors.reshape(-1, 3, 4), wp.vec4),
        rows,
        least,
    ]
    launch(rays_there, count, inputs, there, device)
    inputs = [origin, direction, near, far, shaken, *space, rows, wp.vec2(*weights), least, *there]
    by_density, by_colors = launch_adding(
        rays_back, count, inputs, [warp_argument(cost)], [(flat, None), (colors.reshape(-1, 3, 4), wp.vec4)], device
    )
    return cost.sum(), by_density.reshape(density.shape), by_colors.reshape(colors.shape)


_TYPES = (wp.vec3, wp.vec3, None, None, wp.vec3, None)
