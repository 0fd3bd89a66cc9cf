"""What the fits of the surface hold against a normal, a material or the light without looking at a photograph.

Neighbours are alike: each edge costs the differences between its ends. A kernel sums them vertex by vertex, over the edges of each, together with
the gradient: as operations on all edges, there and back, this took a tenth of a step.
"""

from typing import Any

import torch
import warp as wp
from jaxtyping import Float
from torch import Tensor

from drgs.reconstruct.fit.losses import rough_light, white_light
from drgs.reconstruct.geometry.mesh_edges import MeshEdges
from drgs.warp_torch import launch, warp_argument, warp_device

wp.set_module_options({"enable_backward": False})


@wp.func
def _sign(x: float) -> float:
    return wp.where(x > 0.0, 1.0, wp.where(x < 0.0, -1.0, 0.0))


@wp.kernel
def differences_kernel(
    first: int,
    edges_before: wp.array[wp.int64],
    neighbours: wp.array[wp.int64],
    surface: wp.array2d[float],
    bend: float,
    albedo: float,
    other: float,
    # outputs
    cost: wp.array[wp.vec2],
    gradient: wp.array2d[float],
):
    """One thread a vertex. `bend`, `albedo` and `other` are weights of one edge's differences, of albedo's by channel; each end pays half."""
    v = first + wp.tid()
    normal = wp.vec3(surface[v, 0], surface[v, 1], surface[v, 2])
    bent = float(0.0)
    unlike = float(0.0)
    g_normal = wp.vec3(0.0, 0.0, 0.0)
    g_albedo = wp.vec3(0.0, 0.0, 0.0)
    g_roughness = float(0.0)
    g_metallic = float(0.0)
    for k in range(int(edges_before[v]), int(edges_before[v + 1])):
        u = int(neighbours[k])
        turned = normal - wp.vec3(surface[u, 0], surface[u, 1], surface[u, 2])
        length = wp.length(turned)
        bent += length
        if length > 0.0:
            g_normal += turned / length
        for c in range(3):
            difference = surface[v, 3 + c] - surface[u, 3 + c]
            unlike += albedo * wp.abs(difference)
            g_albedo[c] = g_albedo[c] + _sign(difference)
        roughness = surface[v, 6] - surface[u, 6]
        metallic = surface[v, 7] - surface[u, 7]
        unlike += other * (wp.abs(roughness) + wp.abs(metallic))
        g_roughness += _sign(roughness)
        g_metallic += _sign(metallic)
    cost[v] = wp.vec2(0.5 * bend * bent, 0.5 * unlike)
    for c in range(3):
        gradient[v, c] = bend * g_normal[c]
        gradient[v, 3 + c] = albedo * g_albedo[c]
    gradient[v, 6] = other * g_roughness
    gradient[v, 7] = other * g_metallic


class _Differences(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, surface: Tensor, edges: MeshEdges, bend: float, smooth: float) -> Tensor:
        values, count = surface.detach().contiguous(), max(1, len(edges.vertices))
        cost, gradient = torch.zeros(len(values), 2, device=values.device), torch.zeros_like(values)
        before, neighbours = edges.around(len(values))
        inputs = [
            warp_argument(before),
            warp_argument(neighbours),
            warp_argument(values),
            bend / count,
            smooth / (3 * count),
            smooth / count,
        ]
        launch(differences_kernel, len(values), inputs, [warp_argument(cost, wp.vec2), warp_argument(gradient)], warp_device(values))
        ctx.save_for_backward(gradient)
        return cost.sum(0)

    @staticmethod
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor | None, ...]:
        (gradient,) = ctx.saved_tensors
        return gradient * torch.cat([upstream[:1].expand(3), upstream[1:].expand(5)]), None, None, None


def prior_terms(
    edges: MeshEdges,
    environment: Float[Tensor, "rows columns 3"],
    surface: Float[Tensor, "vertex 8"],
    evidence: Float[Tensor, "vertex"],
    bend: float,
    smooth: float,
    metal: float,
    white: float,
    rough: float,
) -> dict[str, Tensor]:
    """Weighted loss terms: normals and materials along edges, metallic against the evidence, the light.

    Args:
        surface: of packed_surface. evidence: of metal_evidence.
    """
    bent, unlike = _Differences.apply(surface, edges, bend, smooth).unbind(0)
    decided = (evidence > 0).to(evidence)
    return {
        "bend": bent,
        "smooth": unlike,
        "metal": metal * (evidence.abs() * (surface[:, 7] - decided).abs()).mean(),
        "white_light": white * white_light(environment),
        "rough_light": rough * rough_light(environment),
    }
