"""Shading points in, sampled directions with balance-heuristic weights out.

Three strategies a point: cosine hemisphere, GGX visible normals, environment table. The estimate of an integral of g
over the hemisphere is the sum of g(direction) * weight over a point's samples, weight = 1 / sum_k n_k p_k (Veach 1995);
a sample below the horizon has weight 0. Random numbers are Owen-scrambled Sobol points addressed by
(seed, pixel, strategy, sample), so they depend neither on batching nor on threads.
Does not know the tracer, nor radiance.
"""

import torch
import warp as wp

from drgs.maths.constants import F0, MIN_COVERAGE
from drgs.render.integrate.brdf_warp import PI, alpha_of, cosine_direction, ggx_direction, ggx_pdf
from drgs.render.integrate.environment_table import (
    EnvironmentLight,
    EnvironmentTable,
    environment_direction,
    environment_light,
    lookup_pdf,
    uv_from_world_direction,
)
from drgs.render.integrate.random_warp import hash_combine, sobol_2d
from drgs.render.integrate.sample_arrays import PointArrays, SampleSet, point_arrays, sample_set
from drgs.render.integrate.sample_sixteen import SIXTEEN, sample_directions_by_sixteen
from drgs.render.records import GBuffer, Rays, SampleCounts, ShadingPoints
from drgs.warp_torch import launch, warp_array, warp_device

wp.set_module_options({"enable_backward": False})


def sample_counts(total: int) -> SampleCounts:
    """2:1:1 of `total` samples (at least one each)."""
    quarter = max(1, total // 4)
    return SampleCounts(max(1, total - 2 * quarter), quarter, quarter)


@wp.kernel
def gather_points(
    first: int,
    pixel: wp.array[wp.int64],
    position: wp.array[wp.vec3],
    normal: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    albedo: wp.array[wp.vec3],
    roughness: wp.array[float],
    metallic: wp.array[float],
    first_pixel: int,
    # outputs
    points: PointArrays,
):
    i = first + wp.tid()
    p = int(pixel[i])
    points.position[i] = position[p]
    points.normal[i] = normal[p]
    points.wo[i] = wo[p]
    points.albedo[i] = albedo[p]
    points.roughness[i] = roughness[p]
    points.metallic[i] = metallic[p]
    points.pixel[i] = first_pixel + p


@wp.func
def point_at(points: PointArrays, listed: int) -> int:
    """Number of the listed-th point that is meant."""
    if points.order.shape[0] > 0:
        return points.order[listed]
    return listed


@wp.func
def split_at(samples: SampleSet, points: PointArrays, point: int) -> wp.vec3i:
    """Cosine, GGX and environment samples of one point; their sum is the same everywhere.

    Cosine samples in proportion to the diffuse share of the reflected energy: bare metal gets none, and GGX gets theirs. It also gets the
    environment's the more mirror-like a metal is: these hardly ever fall into a narrow lobe. Any split is unbiased.
    """
    if samples.by_material == 0:
        return wp.vec3i(samples.cosine, samples.ggx, samples.environment)
    total = samples.cosine + samples.ggx + samples.environment
    metallic = points.metallic[point]
    base = wp.max(points.albedo[point])
    diffuse = (1.0 - metallic) * base
    specular = F0 * (1.0 - metallic) + metallic * base
    share = diffuse / wp.max(diffuse + specular, 1.0e-6)
    cosine = wp.min(int(float(samples.cosine) * share + 0.5), total - 1)
    mirror = (1.0 - share) * wp.clamp(1.0 - 4.0 * points.roughness[point], 0.0, 1.0)
    # One stays wherever there are any: it alone finds light in the lobe's far tail, and without it the variance would not show that it is missed.
    environment = wp.min(wp.max(int(float(samples.environment) * (1.0 - mirror) + 0.5), 1), samples.environment)
    return wp.vec3i(cosine, total - cosine - environment, environment)


@wp.func
def round_at(samples: SampleSet, points: PointArrays, point: int) -> int:
    if points.round.shape[0] > 0:
        return samples.round + points.round[point]
    return samples.round


@wp.func
def pool_round_at(samples: SampleSet, points: PointArrays, point: int) -> int:
    if points.pool.shape[0] > 0:
        return points.pool[point]
    return round_at(samples, points, point)


@wp.func
def strategy_of(split: wp.vec3i, samples_round: int, slot: int) -> wp.vec2i:
    """(strategy, index in its sequence) of a point's slot-th sample."""
    if slot < split[0]:
        return wp.vec2i(0, samples_round * split[0] + slot)
    if slot < split[0] + split[1]:
        return wp.vec2i(1, samples_round * split[1] + slot - split[0])
    return wp.vec2i(2, samples_round * split[2] + slot - split[0] - split[1])


@wp.func
def strategy_seed(samples: SampleSet, pixel: int, strategy: int) -> wp.uint32:
    return hash_combine(hash_combine(samples.seed, wp.uint32(pixel)), wp.uint32(strategy))


@wp.func
def sampled_direction(
    samples: SampleSet,
    split: wp.vec3i,
    light: EnvironmentLight,
    pixel: int,
    samples_round: int,
    slot: int,
    wo: wp.vec3,
    n: wp.vec3,
    alpha: float,
) -> wp.vec3:
    """World direction of a point's slot-th sample; possibly below the horizon."""
    strategy = strategy_of(split, samples_round, slot)
    u = sobol_2d(wp.uint32(strategy[1]), strategy_seed(samples, pixel, strategy[0]))
    if strategy[0] == 0:
        return cosine_direction(u, n)
    if strategy[0] == 1:
        return ggx_direction(u, wo, n, alpha)
    return environment_direction(light, u)


@wp.func
def balance_weight(
    samples: SampleSet, split: wp.vec3i, light: EnvironmentLight, wi: wp.vec3, wo: wp.vec3, n: wp.vec3, alpha: float, uv: wp.vec3
) -> float:
    """1 / sum_k n_k p_k of a direction above the horizon; candidates count as samples."""
    density = float(split[0]) * wp.dot(n, wi) / PI
    if split[1] > 0:
        density += float(split[1]) * ggx_pdf(wi, wo, n, alpha)
    if split[2] > 0:
        density += float(split[2] * samples.candidates) * lookup_pdf(light, uv)
    if density <= 0.0:
        return 0.0
    return 1.0 / density


@wp.kernel
def sample_directions(
    first: int,
    points: PointArrays,
    light: EnvironmentLight,
    samples: SampleSet,
    # outputs
    direction: wp.array[wp.vec3],
    weight: wp.array[float],
):
    i = first + wp.tid()
    count = samples.cosine + samples.ggx + samples.environment
    point = i // count
    n = points.normal[point]
    wo = points.wo[point]
    alpha = alpha_of(points.roughness[point])
    wi = n
    w = wp.float32(0.0)
    if wp.dot(n, wo) > 0.0:
        split = split_at(samples, points, point)
        wi = sampled_direction(samples, split, light, points.pixel[point], round_at(samples, points, point), i % count, wo, n, alpha)
        if wp.dot(n, wi) > 0.0:
            w = balance_weight(samples, split, light, wi, wo, n, alpha, uv_from_world_direction(light, wi))
    direction[i] = wi
    weight[i] = w


def shading_points(gbuffer: GBuffer, first_pixel: int = 0) -> ShadingPoints:
    """The covered pixels of a G-buffer, packed in row-major order; differentiable.

    Args:
        first_pixel: number in the image of the G-buffer's first pixel.
    """
    pixel = torch.nonzero(gbuffer.coverage.reshape(-1) > MIN_COVERAGE).squeeze(-1)
    vectors = [v.reshape(-1, 3) for v in (gbuffer.position_world, gbuffer.normal_world, gbuffer.wo_world, gbuffer.albedo)]
    numbers = [v.reshape(-1) for v in (gbuffer.roughness, gbuffer.metallic)]
    maps = [*vectors, *numbers]
    is_learnt = torch.is_grad_enabled() and any(values.requires_grad for values in maps)
    position, normal, wo, albedo, roughness, metallic = (
        values[pixel] if is_learnt else values.new_empty(len(pixel), *values.shape[1:]) for values in maps
    )
    points = ShadingPoints(position, normal, wo, albedo, roughness, metallic, (pixel + first_pixel).int())
    if not is_learnt:
        arrays = [*(warp_array(values, wp.vec3) for values in vectors), *(warp_array(values) for values in numbers)]
        launch(gather_points, len(pixel), [warp_array(pixel), *arrays, first_pixel], [point_arrays(points)], warp_device(pixel))
    return points


def sample_rays(
    points: ShadingPoints,
    environment_table: EnvironmentTable,
    counts: SampleCounts,
    seed: int,
    lift: float = 0.0,
    by_material: bool = False,
) -> Rays:
    """Directions and weights for all points. Materials, normals and light enter as numbers: no gradient flows through
    the choice of directions, and none is needed for an unbiased gradient of the estimate.

    Args:
        environment_table: of the unturned environment (training has none turned).
        lift: origins stand this far off the points along the normal [world units].
        by_material: each point shares its samples out by its material (split_at).
    """
    device = points.normal_world.device
    point_count = len(points.pixel)
    light = environment_light(environment_table)
    direction = torch.empty(point_count, counts.total, 3, device=device)
    weight = torch.empty(point_count, counts.total, device=device)
    inputs = [point_arrays(points), light, sample_set(counts, seed, by_material=by_material)]
    outputs = [warp_array(direction.view(-1, 3), wp.vec3), warp_array(weight.view(-1))]
    rays = point_count * counts.total
    if device.type == "cpu":
        launch(sample_directions_by_sixteen, -(-rays // SIXTEEN), [rays, *inputs], outputs, warp_device(direction))
    else:
        launch(sample_directions, rays, inputs, outputs, warp_device(direction))
    return Rays((points.position_world + lift * points.normal_world).detach(), direction, weight)
