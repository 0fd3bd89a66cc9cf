"""Random numbers and directions with their exact densities, in torch; float64-able.

Numbers: the first two Sobol dimensions under hash-based Owen scrambling, addressed by (seed, index), so a picture
depends neither on batching nor on threads. Every aligned run of 2^k indices is a (0, 2)-net.
Directions: cosine hemisphere and GGX visible normals in the bounded spherical-cap form. Densities are per solid angle
and hold for every direction above the horizon; a sample that lands below it is void and is not redrawn.
The Warp kernels restate these lines (drgs/render/integrate/random_warp.py, brdf_warp.py) and are tested against this file.

Source: Burley 2020 "Practical hash-based Owen scrambling"; constants of the scrambling hash by N. Vegdahl, of hash32 by
C. Wellons; Dupuy and Benyoub 2023 (spherical caps), Eto and Tokuyoshi 2023 (the bound).
"""

import math

import torch
from torch import Tensor

from drgs.maths.brdf import ggx_d
from drgs.maths.frames import tangents_from_normal

MASK32 = 0xFFFFFFFF


def hash32(x: Tensor) -> Tensor:
    """A bijective 32-bit mix of int64 values in [0, 2^32)."""
    x = (x ^ (x >> 16)) * 0x7FEB352D & MASK32
    x = (x ^ (x >> 15)) * 0x846CA68B & MASK32
    return x ^ (x >> 16)


def hash_combine(seed: Tensor, value: Tensor) -> Tensor:
    """A 32-bit seed that depends on both."""
    return hash32(seed ^ hash32((value + 0x9E3779B9) & MASK32))


def reverse_bits32(x: Tensor) -> Tensor:
    """The 32 bits in reverse order."""
    x = ((x & 0x55555555) << 1) | ((x >> 1) & 0x55555555)
    x = ((x & 0x33333333) << 2) | ((x >> 2) & 0x33333333)
    x = ((x & 0x0F0F0F0F) << 4) | ((x >> 4) & 0x0F0F0F0F)
    x = ((x & 0x00FF00FF) << 8) | ((x >> 8) & 0x00FF00FF)
    return ((x << 16) & MASK32) | (x >> 16)


def scramble_reversed(x: Tensor, seed: Tensor) -> Tensor:
    """Owen scrambling of bit-reversed values: each bit is flipped by a hash of the bits below it only."""
    x = x ^ (x * 0x3D20ADEA & MASK32)
    x = (x + seed) & MASK32
    x = x * ((seed >> 16) | 1) & MASK32
    x = x ^ (x * 0x05526C56 & MASK32)
    return x ^ (x * 0x53A22864 & MASK32)


def sobol_second_reversed(index: Tensor) -> Tensor:
    """Second Sobol dimension of an index, bit-reversed: row j of Pascal's triangle mod 2 for each set bit j."""
    result = torch.zeros_like(index)
    row = torch.ones_like(index)
    for bit in range(32):
        result = torch.where((index >> bit) & 1 == 1, result ^ row, result)
        row = (row ^ (row << 1)) & MASK32
    return result


def sobol_2d(index: Tensor, seed: Tensor, dtype: torch.dtype = torch.float32) -> Tensor:
    """(..., 2) scrambled Sobol points in [0, 1) of int64 indices and seeds (broadcast together)."""
    index, seed = torch.broadcast_tensors(index & MASK32, seed & MASK32)
    x = reverse_bits32(scramble_reversed(index, hash32(seed)))
    y = reverse_bits32(scramble_reversed(sobol_second_reversed(index), hash32(seed ^ 0x68BC21EB)))
    return torch.stack([x >> 8, y >> 8], -1).to(dtype) * 2.0**-24


def shuffle_index(index: Tensor, seed: Tensor) -> Tensor:
    """Owen-permuted index: makes two padded pairs of dimensions of one path independent and keeps nets whole."""
    return reverse_bits32(scramble_reversed(reverse_bits32(index & MASK32), hash32(seed & MASK32)))


def world_from_local(local: Tensor, normal: Tensor) -> Tensor:
    """(..., 3) directions given in the frame [tangent, bitangent, normal]."""
    tangent, bitangent = tangents_from_normal(normal)
    return local[..., :1] * tangent + local[..., 1:2] * bitangent + local[..., 2:] * normal


def sphere_lattice(count: int) -> Tensor:
    """(count, 3) unit directions, float64, spread evenly: a Fibonacci lattice."""
    index = torch.arange(count, dtype=torch.float64) + 0.5
    height, turn = 1 - 2 * index / count, math.pi * (1 + math.sqrt(5)) * index
    side = torch.sqrt(1 - height * height)
    return torch.stack([side * torch.cos(turn), side * torch.sin(turn), height], -1)


def sample_cosine(u: Tensor) -> Tensor:
    """(..., 3) local directions of numbers (..., 2), density cos / pi."""
    radius, azimuth = torch.sqrt(u[..., 0]), 2 * math.pi * u[..., 1]
    return torch.stack([radius * torch.cos(azimuth), radius * torch.sin(azimuth), torch.sqrt((1 - u[..., 0]).clamp(min=0))], -1)


def cosine_pdf(n_dot_l: Tensor) -> Tensor:
    return n_dot_l.clamp(min=0) / math.pi


def _vndf_bound(wo_z: Tensor, alpha: Tensor) -> Tensor:
    """How far below the horizon of the stretched sphere the cap reaches (Eto and Tokuyoshi, eq. 5)."""
    s = 1 + torch.sqrt((1 - wo_z * wo_z).clamp(min=0))
    return (1 - alpha * alpha) * s * s / (s * s + alpha * alpha * wo_z * wo_z)


def sample_ggx_vndf(u: Tensor, wo_local: Tensor, alpha: Tensor) -> Tensor:
    """(..., 3) local wi: wo mirrored at a visible GGX normal; may lie below the horizon (void).

    Args:
        u: (..., 2) numbers in [0, 1).
        wo_local: (..., 3) unit, z > 0.
        alpha: (...) GGX width.
    """
    stretched = torch.nn.functional.normalize(
        torch.stack([alpha * wo_local[..., 0], alpha * wo_local[..., 1], wo_local[..., 2]], -1), dim=-1
    )
    bound = _vndf_bound(wo_local[..., 2], alpha) * stretched[..., 2]
    z = 1 - u[..., 0] * (1 + bound)
    radius, azimuth = torch.sqrt((1 - z * z).clamp(min=0)), 2 * math.pi * u[..., 1]
    cap = torch.stack([radius * torch.cos(azimuth), radius * torch.sin(azimuth), z], -1) + stretched
    h = torch.nn.functional.normalize(torch.stack([alpha * cap[..., 0], alpha * cap[..., 1], cap[..., 2]], -1), dim=-1)
    return 2 * (wo_local * h).sum(-1, keepdim=True) * h - wo_local


def ggx_vndf_pdf(wi: Tensor, wo: Tensor, normal: Tensor, alpha: Tensor) -> Tensor:
    """Density of `sample_ggx_vndf` at wi above the horizon; never below G1 D / (4 n.v), the unbounded one."""
    h = torch.nn.functional.normalize(wi + wo, dim=-1)
    wo_z = (normal * wo).sum(-1)
    n_dot_h = (normal * h).sum(-1)
    sin2 = torch.linalg.cross(normal, h).square().sum(-1)
    stretch = torch.sqrt(alpha * alpha * (1 - wo_z * wo_z).clamp(min=0) + wo_z * wo_z)
    pdf = ggx_d(n_dot_h, alpha, sin2) / (2 * (_vndf_bound(wo_z, alpha) * wo_z + stretch))
    return torch.where((wo_z > 0) & (n_dot_h > 0), pdf, torch.zeros_like(pdf))


def sample_linear(u: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """x in [0, 1] with density proportional to a (1 - x) + b x; a, b >= 0, not both 0."""
    return u * (a + b) / (a + torch.sqrt(a * a + u * (b * b - a * a))).clamp(min=1e-37)
