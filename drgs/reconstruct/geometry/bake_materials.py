"""From surfels to the mesh: materials on vertices, and the outgoing radiance that secondary rays meet while stage 2 learns."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from drgs.maths.brdf import f0_from_base
from drgs.maths.frames import rotation_from_quat_wxyz, tangents_from_normal
from drgs.maths.spherical_harmonics import sh_basis
from drgs.reconstruct.fit.light.split_sum import filter_environment, shade_split_sum
from drgs.reconstruct.geometry.bind_gaussians import nearest_surfels
from drgs.scene.environment import Environment
from drgs.scene.gaussians import Gaussians
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import by_pool

NEIGHBOURS = 8
"""Surfels that a vertex averages."""
HARMONIC_DIRECTIONS = 64
"""Directions of the hemisphere that a surfel's outgoing radiance is sampled in."""
SURFELS_AT_ONCE = 1024
"""Whose outgoing radiance is baked by one thread at a time: what their directions need stays in a core's cache."""


def vertex_weights(
    vertices: Float[Tensor, "vertex 3"], vertex_normals: Float[Tensor, "vertex 3"], gaussians: Gaussians
) -> tuple[Int[Tensor, "vertex k"], Float[Tensor, "vertex k"]]:
    """(vertex, k) surfel indices and weights that sum to 1: opaque surfels that are near and face as the vertex does count most."""
    indices, distances = nearest_surfels(vertices, gaussians.centers, NEIGHBOURS)
    surfel_normals = rotation_from_quat_wxyz(gaussians.quats_wxyz)[:, :, 2]
    scale = gaussians.log_scales.exp().mean(1)[indices]
    facing = (surfel_normals[indices] * vertex_normals[:, None]).sum(-1).abs()
    weights = torch.exp(-0.5 * (distances / scale) ** 2) * torch.sigmoid(gaussians.opacity_logits)[indices] * facing**4
    weights = weights + 1e-6 / (1 + distances / scale)  # far from every surfel: the nearest ones
    return indices, weights / weights.sum(1, keepdim=True)


def average_surfels(
    values: Float[Tensor, "surfel *value"], indices: Int[Tensor, "vertex k"], weights: Float[Tensor, "vertex k"]
) -> Float[Tensor, "vertex *value"]:
    """(vertex, ...) weighted means of surfel values (surfel, ...)."""
    return torch.einsum("vk,vk...->v...", weights, values[indices])


def bake_materials(mesh: TriangleMesh, gaussians: Gaussians) -> TriangleMesh:
    """The mesh with the surfels' materials on its vertices."""
    indices, weights = vertex_weights(mesh.vertices, mesh.normals, gaussians)
    packed = torch.cat([gaussians.albedo, gaussians.roughness[:, None], gaussians.metallic[:, None]], 1)
    baked = average_surfels(packed, indices, weights).clamp(0, 1)
    return TriangleMesh(
        mesh.vertices, mesh.faces, mesh.normals, baked[:, :3].contiguous(), baked[:, 3].contiguous(), baked[:, 4].contiguous()
    )


def outward_normals(gaussians: Gaussians, mesh: TriangleMesh) -> Float[Tensor, "surfel 3"]:
    """(surfel, 3) unit normals, turned to the side that the nearest mesh vertex calls outside."""
    normals = rotation_from_quat_wxyz(gaussians.quats_wxyz)[:, :, 2]
    nearest, _ = nearest_surfels(gaussians.centers, mesh.vertices, 1)
    outside = (normals * mesh.normals[nearest[:, 0]]).sum(-1, keepdim=True) >= 0
    return torch.where(outside, normals, -normals)


def bake_outgoing_radiance(
    gaussians: Gaussians, residual_sh: Float[Tensor, "surfel 16 3"], normals: Float[Tensor, "surfel 3"], environment: Environment
) -> Float[Tensor, "surfel 16 3"]:
    """(surfel, 16, 3) harmonics of the whole outgoing radiance under the environment: split sum plus residual.

    Least squares over directions of the hemisphere that the surfel faces, with a ridge that falls on the higher degrees.

    Args:
        residual_sh: (surfel, 16, 3) of the residual radiance, no offset. normals: (surfel, 3) outward.
    """
    device = normals.device
    k = torch.arange(HARMONIC_DIRECTIONS, device=device) + 0.5
    cosine = 1 - k / HARMONIC_DIRECTIONS * 0.95
    sine, azimuth = (1 - cosine * cosine).sqrt(), k * (math.pi * (3 - math.sqrt(5)))
    local = torch.stack([sine * azimuth.cos(), sine * azimuth.sin(), cosine], 1)
    tables = filter_environment(environment.radiance)
    degree = torch.tensor([math.isqrt(i) for i in range(16)], device=device)
    ridge = torch.diag(HARMONIC_DIRECTIONS * 1e-3 * (1.0 + degree**2))

    @torch.no_grad()
    def baked(first: int, last: int) -> Float[Tensor, "some 16 3"]:
        normal, some = normals[first:last], slice(first, last)
        wo = torch.stack([*tangents_from_normal(normal), normal], 1)  # (some, frame, 3)
        wo = (local @ wo).view(-1, 3)
        basis = sh_basis(-wo).view(last - first, HARMONIC_DIRECTIONS, 16)

        def each_way(values: Tensor) -> Tensor:
            return values[some].repeat_interleave(HARMONIC_DIRECTIONS, 0)

        albedo, metallic, residual = each_way(gaussians.albedo), each_way(gaussians.metallic), (basis @ residual_sh[some]).view(-1, 3)
        f0, diffuse_albedo = f0_from_base(albedo, metallic), albedo * (1 - metallic)[:, None]
        surface = (diffuse_albedo, residual, f0, each_way(gaussians.roughness), each_way(normals))
        radiance = shade_split_sum(*surface, wo, tables).clamp(min=0).view(last - first, HARMONIC_DIRECTIONS, 3)
        turned = basis.transpose(1, 2)
        return torch.linalg.solve(turned @ basis + ridge, turned @ (radiance - 0.5))

    edges = [*range(0, len(normals), SURFELS_AT_ONCE), len(normals)]
    return torch.cat(by_pool(baked, edges, device))
