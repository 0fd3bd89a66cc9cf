"""Directions that environment samples choose among: resampled importance sampling, with the candidates drawn beforehand.

A sample that looks at one direction of the table finds light, but hardly ever where a narrow lobe reflects it. It may look at CANDIDATES
directions instead, and take one with a probability in proportion to the light it would bring if nothing were in the way. Only that one is
traced; its weight is the sum of all candidates' shares over its own (docs/sources.md: talbot2005), so the mean stays what it was.

Drawing costs most of a candidate, therefore all points of a round share one pool: POOL directions of one scrambled Sobol sequence, in blocks
of CANDIDATES that follow each other in it, each of which covers the light evenly. A sample's block is a matter of its pixel, strategy and
index, so light depends neither on batching nor on threads. Pools of different rounds are independent, and so are the two of a round, for
points and for surfaces that their rays meet: a path chooses once from each. What is given up: samples of one round no longer continue the
sequence of the last, which a smooth integrand under a broad sky would notice (plan.WORTH_CHOOSING).

Twin: drgs/reference/environment_pool.py.
"""

import threading
from collections import OrderedDict
from typing import Any
from weakref import WeakKeyDictionary

import torch
import warp as wp
from torch import Tensor

from drgs.render.integrate.brdf_warp import PI, ggx_pdf, specular_brdf
from drgs.render.integrate.environment_table import (
    EnvironmentLight,
    environment_direction,
    lookup_pdf,
    lookup_radiance,
    uv_from_world_direction,
)
from drgs.render.integrate.random_warp import hash_combine, sobol_2d
from drgs.warp_torch import load_kernel, share_out, warp_array, warp_device

wp.set_module_options({"enable_backward": False})

CANDIDATES = 16
"""Of a sample that chooses: one for each lane of the vectors of CPU kernels."""
POOL = 2048
"""Directions of a pool."""
BLOCKS = POOL // CANDIDATES
NUMBERS = 8
"""Of a candidate: direction, radiance, density and floor."""
AT_POINTS, AT_SURFACES = 0, 1
"""The pools of a round."""
POOL_STREAM = 8
"""Seeds of pools are those of a strategy from here on, of which points have three."""
BLOCK_STREAM = 8
"""Where a sample's block comes from; scatter_hits takes numbers of streams from 16 on."""
FLOOR = 0.3
"""Light of other surfaces that a choice reckons with everywhere, as a share of the sky's mean radiance: directions under a black sky must stay
possible. Any positive share keeps the mean."""
ROUNDS_KEPT = 64
"""Of a light; 8 MiB. Slices of an image go through the same rounds one after the other."""

vec16 = wp.types.vector(length=CANDIDATES, dtype=float)


@wp.struct
class CandidatePools:
    """Those of the rounds from `first_round` on, as kernels see them."""

    numbers: wp.array[float]
    """(round, AT_POINTS or AT_SURFACES, block, NUMBERS, CANDIDATES), all in one row; empty where samples do not choose."""
    first_round: int


@wp.func
def pool_place(round_: int, pool: int, block: int) -> int:
    """Where the numbers of a block begin."""
    return ((round_ * 2 + pool) * BLOCKS + block) * (NUMBERS * CANDIDATES)


@wp.kernel
def draw_pools(
    light: EnvironmentLight,
    seed: wp.uint32,
    round_: int,
    # outputs
    numbers: wp.array[float],
):
    i = wp.tid()
    pool = i // POOL
    entry = i % POOL
    stream = hash_combine(hash_combine(seed, wp.uint32(round_)), wp.uint32(POOL_STREAM + pool))
    wi = environment_direction(light, sobol_2d(wp.uint32(entry), stream))
    uv = uv_from_world_direction(light, wi)
    radiance = lookup_radiance(light, uv)
    pdf = lookup_pdf(light, uv)
    at = pool_place(0, pool, entry // CANDIDATES) + entry % CANDIDATES
    for k in range(3):
        numbers[at + k * CANDIDATES] = wi[k]
        numbers[at + (3 + k) * CANDIDATES] = radiance[k]
    numbers[at + 6 * CANDIDATES] = pdf
    # Largest channel over density is its integral over the sphere, at every direction.
    numbers[at + 7 * CANDIDATES] = wp.where(pdf > 0.0, FLOOR * wp.max(radiance) / (4.0 * PI * wp.max(pdf, 1.0e-37)), 0.0)


@wp.func
def block_of(stream: wp.uint32, index: wp.uint32) -> int:
    """The block of a sample: samples of a pixel that follow each other take blocks that do."""
    return int((hash_combine(stream, wp.uint32(BLOCK_STREAM)) + index) % wp.uint32(BLOCKS))


@wp.func
def candidate_direction(pools: CandidatePools, at: int, k: int) -> wp.vec3:
    i = at + k
    return wp.vec3(pools.numbers[i], pools.numbers[i + CANDIDATES], pools.numbers[i + 2 * CANDIDATES])


@wp.func
def choose_candidate(
    pools: CandidatePools,
    at: int,
    shares: wp.vec3,
    floor: float,
    u: float,
    wo: wp.vec3,
    n: wp.vec3,
    surface_normal: wp.vec3,
    alpha: float,
    albedo: wp.vec3,
    metallic: float,
) -> wp.vec2:
    """Which of a block's candidates is taken, and the sum of all shares over its own; -1 and 0 if none can bring light.

    Args:
        at: where the block begins.
        shares: cosine, GGX and environment samples; candidates count as samples.
        floor: 1 where other surfaces may bring light, else 0.
        u: chooses.
    """
    diffuse = albedo * ((1.0 - metallic) / PI)
    q = vec16()
    total = wp.float32(0.0)
    for k in range(CANDIDATES):
        i = at + k
        wi = candidate_direction(pools, at, k)
        n_dot_l = wp.dot(n, wi)
        if n_dot_l > 0.0 and wp.dot(surface_normal, wi) > 0.0:
            density = shares[0] * n_dot_l / PI + shares[1] * ggx_pdf(wi, wo, n, alpha) + shares[2] * pools.numbers[i + 6 * CANDIDATES]
            least = floor * pools.numbers[i + 7 * CANDIDATES]
            light = wp.vec3(
                pools.numbers[i + 3 * CANDIDATES] + least,
                pools.numbers[i + 4 * CANDIDATES] + least,
                pools.numbers[i + 5 * CANDIDATES] + least,
            )
            if density > 0.0:
                q[k] = wp.dot(diffuse + specular_brdf(wi, wo, n, alpha, albedo, metallic), light) * n_dot_l / density
                total += q[k]
    target = u * total
    before = wp.float32(0.0)
    chosen = wp.int32(-1)
    for k in range(CANDIDATES):
        if q[k] > 0.0 and before <= target:
            chosen = k
        before += q[k]
    if chosen < 0:
        return wp.vec2(-1.0, 0.0)
    return wp.vec2(float(chosen), total / q[chosen])


_lock = threading.Lock()
_kept: WeakKeyDictionary[Any, OrderedDict[tuple[int, int], Tensor]] = WeakKeyDictionary()


def candidate_pools(light: Any, candidates: int, seed: int, first_round: int, last_round: int, device: torch.device) -> Any:
    """The struct that kernels read: pools of a range of rounds. They are kept with the light; threads may ask at once.

    Args:
        light: EnvironmentLight.
        candidates: 1 (none to choose among) or CANDIDATES.

    Raises:
        ValueError: another number of candidates.
    """
    if candidates not in (1, CANDIDATES):
        raise ValueError(f"{candidates} candidates for each environment sample; expected 1 or {CANDIDATES}: ask for one of these")
    pools = CandidatePools()
    pools.first_round = first_round
    if candidates == 1:
        pools.numbers = warp_array(torch.empty(0, device=device))
        return pools
    with _lock:
        kept = _kept.setdefault(light, OrderedDict())
        rounds = [_pools_of_round(kept, light, seed & 0xFFFFFFFF, round_, device) for round_ in range(first_round, last_round + 1)]
        while len(kept) > ROUNDS_KEPT:
            kept.popitem(last=False)
    pools.numbers = warp_array(rounds[0] if len(rounds) == 1 else torch.cat(rounds))
    return pools


def draw_ahead(light: Any, seed: int, first_round: int, end_round: int, device: torch.device) -> None:
    """Draw the pools of a range of rounds side by side, so that slices which need all of them need not draw one after the other."""
    seed = seed & 0xFFFFFFFF
    with _lock:
        kept = _kept.setdefault(light, OrderedDict())
        missing = [round_ for round_ in range(first_round, end_round) if (seed, round_) not in kept][:ROUNDS_KEPT]
    numbers = share_out(lambda k, _: _draw(light, seed, missing[k], device), range(len(missing) + 1))
    with _lock:
        kept.update({(seed, round_): drawn for round_, drawn in zip(missing, numbers, strict=True)})


def _draw(light: Any, seed: int, round_: int, device: torch.device) -> Tensor:
    """(2 * POOL * NUMBERS,), drawn by the calling thread."""
    numbers = torch.empty(2 * POOL * NUMBERS, device=device)
    load_kernel(draw_pools, warp_device(numbers))
    wp.launch(draw_pools, dim=2 * POOL, inputs=[light, seed, round_], outputs=[warp_array(numbers)], device=warp_device(numbers))
    return numbers


def _pools_of_round(kept: OrderedDict[tuple[int, int], Tensor], light: Any, seed: int, round_: int, device: torch.device) -> Tensor:
    """(2 * POOL * NUMBERS,)."""
    if (seed, round_) not in kept:
        kept[seed, round_] = _draw(light, seed, round_, device)  # not by the thread pool, whose threads may be waiting for the lock
    kept.move_to_end((seed, round_))
    return kept[seed, round_]
