"""sample_directions of sample_rays.py for the CPU: sixteen rays side by side, in a sixth of the time where vectors are that wide.

In: what that kernel takes. Out: the same directions and weights but for rounding; tests hold both to the reference.
"""

from pathlib import Path

import warp as wp

from drgs.maths.constants import F0, MIN_ROUGHNESS
from drgs.render.integrate.environment_pool import BLOCK_STREAM, BLOCKS
from drgs.render.integrate.environment_table import EnvironmentLight
from drgs.render.integrate.sample_arrays import PointArrays, SampleSet
from drgs.render.native_source import native_source

SIXTEEN = 16
"""Rays that a launch index works on."""


def _source(name: str) -> str:
    folder = Path(__file__).parent
    # BLOCKS and BLOCK_STREAM are those of ray_vector.h's pools, from which nothing is drawn here.
    constants = {"F0": F0, "MIN_ROUGHNESS": MIN_ROUGHNESS, "BLOCKS": BLOCKS, "BLOCK_STREAM": BLOCK_STREAM}
    return native_source(folder / name, folder / "ray_vector.h", constants=constants)


@wp.func_native(_source("sample_sixteen.h"))
def sample_sixteen_rays(
    base: int, ray_count: int, points: PointArrays, light: EnvironmentLight, samples: SampleSet,
    direction: wp.array[wp.vec3], weight: wp.array[float],
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="unique")
def sample_directions_by_sixteen(
    first: int,
    ray_count: int,
    points: PointArrays,
    light: EnvironmentLight,
    samples: SampleSet,
    # outputs
    direction: wp.array[wp.vec3],
    weight: wp.array[float],
):
    """One index for SIXTEEN rays."""
    sample_sixteen_rays(16 * (first + wp.tid()), ray_count, points, light, samples, direction, weight)
