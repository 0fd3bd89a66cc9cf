"""Light transport as the rendering equation says it, in float64: what the integrators of drgs/render/integrate must find in the mean.

    L_o(x, wo) = ∫ f(wi, wo) L_i(x, wi) (n·wi) dwi                                              outgoing_radiance
    L_i(x, wi) = L_env(wi) where nothing lies along wi, else L_o(x', -wi) of the surface x' there       incoming_radiance

The integral over the hemisphere is estimated by one direction: f L_i (n·wi) / p(wi), where wi is drawn from cosine, visible GGX normals
or the environment, each in a third of all cases, and p is the density of the three together (one-sample balance heuristic, Veach 1995).
Nothing ends a path but the number of bounces. The environment is looked up, never sampled by rays of its own.

As in the renderer, light comes neither from below the shading normal nor from below the triangle, and the back of a triangle is black.
Rays are held against all triangles.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from drgs.maths.brdf import evaluate_brdf
from drgs.maths.constants import MIN_ROUGHNESS
from drgs.maths.sampling import cosine_pdf, ggx_vndf_pdf, sample_cosine, sample_ggx_vndf, world_from_local
from drgs.reference.mesh_surface import Surfaces, surfaces_at
from drgs.render.integrate.environment_table import EnvironmentTable, environment_pdf, sample_environment
from drgs.scene.environment import Environment, environment_radiance
from drgs.scene.mesh import TriangleMesh

PAIRS_AT_ONCE = 1 << 15
"""Rays times triangles that are held against each other together: what they need stays in the processor's cache."""


@dataclass(frozen=True, eq=False)
class LitMesh:
    """A scene, in float64."""

    mesh: TriangleMesh
    environment: Environment
    table: EnvironmentTable
    """Of that environment."""
    lift: float
    """How far rays start above their triangle [world units]."""


def outgoing_radiance(scene: LitMesh, x: Surfaces, wo: Tensor, bounces: int, random: torch.Generator) -> Tensor:
    """(point, 3) one estimate of the radiance that surfaces send along wo (point, 3).

    Args:
        bounces: further surfaces that light may meet before x.
    """
    wi = sample_direction(scene, x, wo, random)
    n_dot_l = (x.normal * wi).sum(-1)
    front = ((x.normal * wo).sum(-1) > 0) & ((x.face_normal * wo).sum(-1) > 0) & (n_dot_l > 0) & ((x.face_normal * wi).sum(-1) > 0)
    diffuse, specular = evaluate_brdf(wi, wo, x.normal, x.albedo, x.roughness, x.metallic)
    weight = torch.where(front, n_dot_l / direction_density(scene, x, wo, wi), 0.0)
    carried = (diffuse + specular) * weight[:, None]

    radiance = torch.zeros_like(wo)
    live = carried.amax(-1) > 0
    radiance[live] = carried[live] * incoming_radiance(scene, (x.position + scene.lift * x.face_normal)[live], wi[live], bounces, random)
    return radiance


def incoming_radiance(scene: LitMesh, origin: Tensor, direction: Tensor, bounces: int, random: torch.Generator) -> Tensor:
    """(ray, 3) one estimate of the radiance that arrives at origins (ray, 3) along -direction (ray, 3)."""
    face, barycentric = first_hits(scene.mesh, origin, direction)
    met = face >= 0
    radiance = torch.where(met[:, None], 0.0, environment_radiance(scene.environment, direction))
    if bounces > 0:
        surfaces = surfaces_at(scene.mesh, face[met], barycentric[met])
        radiance[met] = outgoing_radiance(scene, surfaces, -direction[met], bounces - 1, random)
    return radiance


def sample_direction(scene: LitMesh, x: Surfaces, wo: Tensor, random: torch.Generator) -> Tensor:
    """(point, 3) directions of density direction_density; possibly below the horizon."""
    u = torch.rand(len(wo), 2, generator=random, dtype=wo.dtype)
    which = torch.randint(3, (len(wo), 1), generator=random)
    frame = torch.stack([world_from_local(axis.expand_as(wo), x.normal) for axis in torch.eye(3, dtype=wo.dtype)], -1)
    wo_local = torch.einsum("pij,pi->pj", frame, wo)
    cosine = world_from_local(sample_cosine(u), x.normal)
    ggx = world_from_local(sample_ggx_vndf(u, wo_local, x.roughness.clamp(min=MIN_ROUGHNESS) ** 2), x.normal)
    return torch.where(which == 0, cosine, torch.where(which == 1, ggx, sample_environment(scene.table, u)))


def direction_density(scene: LitMesh, x: Surfaces, wo: Tensor, wi: Tensor) -> Tensor:
    """(point,) density per solid angle of sample_direction at wi above the horizon."""
    cosine = cosine_pdf((x.normal * wi).sum(-1))
    ggx = ggx_vndf_pdf(wi, wo, x.normal, x.roughness.clamp(min=MIN_ROUGHNESS) ** 2)
    return (cosine + ggx + environment_pdf(scene.table, wi)) / 3


def first_hits(mesh: TriangleMesh, origin: Tensor, direction: Tensor) -> tuple[Tensor, Tensor]:
    """(ray,) faces, -1 where nothing is met, and (ray, 2) weights of their second and third vertex (Möller and Trumbore 1997)."""
    a, b, c = mesh.vertices[mesh.faces.long()].unbind(1)
    ab, ac = b - a, c - a
    faces, weights = [], []
    for o, d in zip(*(rays.split(max(1, PAIRS_AT_ONCE // len(a))) for rays in (origin, direction)), strict=True):
        p = torch.linalg.cross(d[:, None], ac[None])
        determinant = (p * ab).sum(-1)
        from_a = o[:, None] - a
        q = torch.linalg.cross(from_a, ab[None])
        u = (from_a * p).sum(-1) / determinant
        v = (d[:, None] * q).sum(-1) / determinant
        t = (q * ac).sum(-1) / determinant
        inside = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > 0)
        nearest, face = torch.where(inside, t, torch.inf).min(-1)
        faces.append(torch.where(torch.isfinite(nearest), face, -1))
        weights.append(torch.stack([u.gather(1, face[:, None]), v.gather(1, face[:, None])], -1)[:, 0])
    return torch.cat(faces), torch.cat(weights)
