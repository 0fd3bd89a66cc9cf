"""Light at shading points: L_o = sum over samples of f L_i (n.wi) weight. What every integrator offers, and what they share.

In: points with the places their rays start from, the environment, settings. Out: diffuse and specular radiance, the variance of the
luminance, and the open share of the sky, per point. L_i is the environment where a ray escapes, else the outgoing light of what it
meets: nothing with 0 bounces, otherwise the light that a path from there finds.
Rays that cannot carry light (below the true surface, black sky with no bounce) are void and cost next to nothing.

Implementations: wavefront (any device, any tracer) and fused_embree (CPU); choose_integrator.py chooses.
Source: Veach 1995 (balance heuristic). Truth: drgs/reference/path_integrator.py.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
import warp as wp
from torch import Tensor

from drgs.render.integrate.environment_pool import candidate_pools
from drgs.render.integrate.ray_scene import ray_scene
from drgs.render.integrate.sample_arrays import point_arrays, sample_set, start_arrays
from drgs.render.integrate.sum_samples import LightSums
from drgs.render.integrate.surface_light import SurfaceLight
from drgs.render.intersect.ray_memory import RayMemory, empty_rays, usable_rays
from drgs.render.intersect.trace_rays import over_slices
from drgs.render.intersect.tracer import AbstractTracer
from drgs.render.records import RayStarts, SampleCounts, ShadedPoints, ShadingPoints, TracedRays
from drgs.warp_torch import in_thread_pool, thread_count, warp_array

MIN_RAYS_A_SLICE = 4096
"""Fewer are not cut up further to balance threads, for each slice costs Python. Of 8192, 4096 and 2048 (moving pictures of the demo's sample, medians of five in turns) 86, 82 and 80 ms; of a bunny 65, 66 and 70."""


@dataclass(frozen=True)
class IntegratorSettings:
    """Which rays an estimate is made of."""

    counts: SampleCounts
    bounces: int = 0
    """Surfaces that light may meet between the environment and the points."""
    seed: int = 0
    by_material: bool = False
    """Each point shares its samples out by its material (sample_rays.split_at)."""
    split_indirect: bool = False
    """Say how much of the light comes from other surfaces (ShadedPoints.indirect, .indirect_diffuse)."""
    candidates: int = 1
    """Directions that each environment sample chooses among: 1 or environment_pool.CANDIDATES."""


@dataclass(frozen=True, eq=False)
class Estimate:
    """One estimate in the making, as its slices see it. The structs share memory with the tensors."""

    points: Any
    """PointArrays."""
    starts: Any
    """StartArrays."""
    scene: Any
    """RayScene."""
    samples: Any
    """SampleSet."""
    rays_a_point: int
    bounces: int
    order: Tensor | None
    """(chosen,) int32, the points that are meant; None: all."""
    known: TracedRays | None
    """What rays met before, of all points, chosen or not; used for those that are still the same."""
    kept: TracedRays | None
    """Where to write down what the rays meet."""
    sums: Any
    """LightSums of all points."""


class AbstractIntegrator(ABC):
    """Light at shading points, by the rays of one tracer."""

    def __init__(self, tracer: AbstractTracer) -> None:
        self.tracer = tracer

    @abstractmethod
    def load_kernels(self) -> None:
        """Compile what slices launch, before threads race for it."""

    @abstractmethod
    def rays_a_slice(self) -> int:
        """Most rays of a slice."""

    @abstractmethod
    def shade_slice(self, estimate: Estimate, first: int, last: int) -> int:
        """Write the sums of points `first` to `last`; returns how many rays were traced. Runs on the calling thread."""

    def shade(
        self,
        points: ShadingPoints,
        starts: RayStarts,
        light: Any,
        settings: IntegratorSettings,
        samples_round: int | Tensor = 0,
        memory: RayMemory | None = None,
        horizon: Tensor | None = None,
        known: SurfaceLight | None = None,
        order: Tensor | None = None,
        onto: ShadedPoints | None = None,
        pool_rounds: Tensor | None = None,
    ) -> ShadedPoints:
        """Outgoing light of all points, or of some, one estimate of `settings.counts.total` rays each.

        Args:
            light: EnvironmentLight struct (environment_table.environment_light).
            samples_round: how many estimates of the same settings came before; continues their sequences. (point,) int32 where it differs.
            memory: of an estimate of the same counts from the same starts: rays that are known are not traced, and it then knows these;
                where only some points are meant it stays as it is.
            horizon: (face, SECTORS) sines (horizon.Horizons); rays above them are not traced.
            known: what surfaces of the tracer's mesh send, read where a ray meets one; only with one bounce.
            order: (chosen,) int32, the points that are meant; None: all, one after the other. The others stay 0, or
            onto: what is known of all points so far; the light of those that are meant is written into it.
            pool_rounds: (point,) int32, the rounds whose pools samples choose from (environment_pool.py); None: their own.
        """
        assert known is None or settings.bounces == 1
        device, rays_a_point = points.normal_world.device, settings.counts.total
        point_count = len(points.pixel) if order is None else len(order)
        result = _no_light(len(points.pixel), settings.split_indirect, device) if onto is None else onto
        ray_count, finds_surfaces = point_count * rays_a_point, settings.bounces > 0
        if ray_count == 0:
            return result
        rounds, first_round = (samples_round, 0) if isinstance(samples_round, Tensor) else (None, samples_round)
        of_pools = rounds if pool_rounds is None else pool_rounds
        lowest, highest = (first_round, first_round) if of_pools is None else (int(bound) for bound in of_pools.aminmax())
        pools = candidate_pools(light, settings.candidates, settings.seed, lowest, highest, device)
        estimate = Estimate(
            point_arrays(points, rounds, order, pool_rounds),
            start_arrays(starts),
            ray_scene(light, self.tracer, horizon, pools, known),
            sample_set(settings.counts, settings.seed, first_round, settings.by_material, settings.candidates),
            rays_a_point,
            settings.bounces,
            order,
            usable_rays(memory, len(points.pixel) * rays_a_point, finds_surfaces),
            empty_rays(memory, ray_count, finds_surfaces, device) if order is None else None,
            light_sums(result),
        )
        self.load_kernels()
        shrinking = device.type == "cpu" and thread_count() > 1 and not in_thread_pool()
        over_slices(
            point_count,
            device,
            lambda first, last: self.shade_slice(estimate, first, last),
            max(1, self.rays_a_slice() // rays_a_point),
            max(1, MIN_RAYS_A_SLICE // rays_a_point) if shrinking else None,
        )
        if memory is not None and order is None:
            memory.rays = estimate.kept
        return result


def _no_light(count: int, split_indirect: bool, device: torch.device) -> ShadedPoints:
    diffuse, specular, variance = (torch.zeros(count, 3, device=device) for _ in range(3))
    indirect, of_it_diffuse = (torch.zeros(count, 3, device=device) if split_indirect else None for _ in range(2))
    return ShadedPoints(diffuse, specular, variance, torch.zeros(count, device=device), indirect, of_it_diffuse)


def light_sums(light: ShadedPoints) -> Any:
    """The struct that kernels write to; shares memory with the tensors."""
    sums = LightSums()
    sums.diffuse, sums.specular = warp_array(light.diffuse, wp.vec3), warp_array(light.specular, wp.vec3)
    sums.variance, sums.visibility = warp_array(light.variance, wp.vec3), warp_array(light.visibility)
    none = light.diffuse[:0]
    sums.indirect = warp_array(none if light.indirect is None else light.indirect, wp.vec3)
    sums.indirect_diffuse = warp_array(none if light.indirect_diffuse is None else light.indirect_diffuse, wp.vec3)
    return sums
