"""Slow float64 twin of drgs/render/progressive/kept_light: what is kept at vertices, by the path integrator, and what is read between them."""

import torch
from torch import Tensor

from drgs.maths.color import luminance
from drgs.maths.sampling import sample_cosine, world_from_local
from drgs.reference.path_integrator import LitMesh, incoming_radiance

LEAST_DIFFUSE, F0 = 0.75, 0.04
LARGEST_FACE, FLAT = 6.0, 0.95
LARGEST_ERROR, STEEPEST, NOISE = 0.2, 0.25, 2.0
TRACED, WANTED, READ = range(3)


def white_paint_at(scene: LitMesh, vertex: Tensor, face: Tensor, bounces: int, random: torch.Generator) -> Tensor:
    """(point, 3) one estimate of irradiance / pi at vertices (point,), as the points of one of the faces (point,) around them see it."""
    mesh = scene.mesh
    a, b, c = mesh.vertices[mesh.faces[face.long()].long()].unbind(1)
    face_normal = torch.nn.functional.normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    wi = world_from_local(sample_cosine(torch.rand(len(vertex), 2, generator=random, dtype=torch.float64)), mesh.normals[vertex])
    radiance = incoming_radiance(scene, mesh.vertices[vertex] + scene.lift * face_normal, wi, bounces, random)
    return torch.where(((face_normal * wi).sum(-1) > 0)[:, None], radiance, 0.0)


def read_between(
    corner: Tensor, normal: Tensor, light: Tensor, variance: Tensor, is_known: Tensor, barycentric: Tensor, share: float, pixel: float
) -> tuple[int, Tensor, Tensor]:
    """Verdict on one point, its light (3,) and the variance of that.

    Args:
        corner: (3, 3) the corners of its face. normal: (3, 3) of these. light: (3, 3) kept there. variance: (3,) of its luminance.
        is_known: (3,) bool; whether each has estimates. barycentric: (2,) of the second and third corner.
        share: of the reflected energy that is diffuse. pixel: its size there [world units].
    """
    nothing = torch.zeros(3, dtype=light.dtype), torch.zeros((), dtype=light.dtype)
    sides = corner - corner.roll(1, 0)
    face_normal = torch.linalg.cross(corner[1] - corner[0], corner[2] - corner[0])
    flattest = float((normal @ (face_normal / face_normal.norm())).min())
    if share < LEAST_DIFFUSE or float(sides.norm(dim=-1).max()) > LARGEST_FACE * pixel or flattest < FLAT:
        return TRACED, *nothing
    weights = torch.stack([1 - barycentric.sum(), *barycentric])
    brightness, there = luminance(light), weights.square() @ variance
    mean = brightness.mean()
    is_steep = brightness.max() - brightness.min() > STEEPEST * mean + NOISE * variance.max().sqrt()
    if not bool(is_known.all()) or bool(is_steep) or bool(there.sqrt() > LARGEST_ERROR * mean):
        return WANTED, *nothing
    return READ, weights @ light, there


def sent_by_vertex(direct: Tensor, rounds: int, albedo: Tensor, metallic: float) -> Tensor:
    """(4,) radiance that a vertex is known to send back to rays that meet it, and 1; the last is 0 where it is not known, -1 where it never will be.

    Args:
        direct: (3,) sum over rounds of what white paint there would send of the environment's own light. albedo: (3,).
    """
    base = float(albedo.max())
    diffuse, specular = (1 - metallic) * base, F0 * (1 - metallic) + metallic * base
    verdict = -1.0 if diffuse < LEAST_DIFFUSE * (diffuse + specular) else float(rounds > 0)
    facing = F0 * (1 - metallic) + metallic * albedo
    sent = direct / max(rounds, 1) * ((1 - metallic) * albedo + facing + (1 - facing) / 21)
    return torch.cat([sent if verdict > 0 else torch.zeros_like(sent), sent.new_tensor([verdict])])
