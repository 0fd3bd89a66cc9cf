"""What kernels that draw samples are given: points, where their rays start, and how samples are laid out.

In: tensors and counts. Out: the structs that kernels read; they share memory with the tensors.
"""

from typing import Any

import torch
import warp as wp

from drgs.render.records import RayStarts, SampleCounts, ShadingPoints
from drgs.warp_torch import warp_array


@wp.struct
class PointArrays:
    """ShadingPoints as kernels see them."""

    position: wp.array[wp.vec3]
    normal: wp.array[wp.vec3]
    wo: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]
    roughness: wp.array[float]
    metallic: wp.array[float]
    pixel: wp.array[int]
    round: wp.array[int]
    """Each point's own rounds, added to SampleSet.round; empty where all are the same."""
    pool: wp.array[int]
    """The round whose pools each point's samples choose from; empty where that is the point's own (environment_pool.py)."""
    order: wp.array[int]
    """The points that are meant, one after the other; empty where all are (point_at)."""


@wp.struct
class StartArrays:
    """RayStarts as kernels see them."""

    origin: wp.array[wp.vec3]
    surface_normal: wp.array[wp.vec3]
    face: wp.array[int]
    """Empty where none is known."""


@wp.struct
class SampleSet:
    """How a point's samples are laid out, and which of each strategy's sequence they are."""

    cosine: int
    ggx: int
    environment: int
    by_material: int
    """1: each point shares the same total out by its material (split_at)."""
    round: int
    """Samples already taken: rounds of the same counts."""
    seed: wp.uint32
    candidates: int
    """Directions that each environment sample chooses among (environment_pool.py)."""


def point_arrays(
    points: ShadingPoints, rounds: torch.Tensor | None = None, order: torch.Tensor | None = None, pools: torch.Tensor | None = None
) -> Any:
    """The struct that kernels read; shares memory with the tensors.

    Args:
        rounds: (point,) int32, where points of several passes come together. order: (chosen,) int32, of some of them.
        pools: (point,) int32, the round whose pools each takes, where that is not its own.
    """
    arrays = PointArrays()
    arrays.position = warp_array(points.position_world.float(), wp.vec3)
    arrays.normal = warp_array(points.normal_world.float(), wp.vec3)
    arrays.wo = warp_array(points.wo_world.float(), wp.vec3)
    arrays.albedo = warp_array(points.albedo.float(), wp.vec3)
    arrays.roughness = warp_array(points.roughness.float())
    arrays.metallic = warp_array(points.metallic.float())
    arrays.pixel = warp_array(points.pixel.int())
    none = points.pixel[:0].int()
    arrays.round, arrays.order, arrays.pool = (warp_array(none if values is None else values) for values in (rounds, order, pools))
    return arrays


def start_arrays(starts: RayStarts) -> Any:
    """The struct that kernels read; shares memory with the tensors."""
    arrays = StartArrays()
    arrays.origin = warp_array(starts.origin_world, wp.vec3)
    arrays.surface_normal = warp_array(starts.surface_normal_world, wp.vec3)
    arrays.face = warp_array(starts.origin_world.new_empty(0, dtype=torch.int32) if starts.face is None else starts.face.int())
    return arrays


def sample_set(counts: SampleCounts, seed: int, samples_round: int = 0, by_material: bool = False, candidates: int = 1) -> Any:
    """The struct that kernels read."""
    samples = SampleSet()
    samples.by_material = int(by_material)
    samples.cosine, samples.ggx, samples.environment = counts.cosine, counts.ggx, counts.environment
    samples.round = samples_round
    samples.seed = seed & 0xFFFFFFFF
    samples.candidates = candidates
    return samples
