"""How far the photographs decide what a vertex is: the information that they hold about it, against what is known without them.

The radiance of a vertex depends by split sum on five numbers: albedo (one step in all channels), roughness, metallic and two tilts of the
normal. With the slopes J of the predicted radiance over all views and channels, relative to the photograph, the information about them is

    I = mean(J J^T) / (NOISE^2 / n + unexplained^2 + ABSORBED^2)

for n measurements. What the fit leaves unexplained, and what it has absorbed, are errors of light or shape that all views share: more of
them do not average those out. Certainty is the share of the variance before that the photographs take away, 1 - posterior / prior.
All five are asked at once, so what trades places with another is certain of neither. Of metallic it is that times the strength of
metal_evidence: slopes ask about small steps, evidence compares the two ends.

Light, visibility and what mirrored rays meet are taken as known up to ABSORBED: where light from one direction falls on a single flat place,
as from below on a floor's underside, its error is that place's albedo, and nothing here notices. Shape is what shading says of the
normal: outlines and texture, which may say more, have no part in it.

In: the mesh through its tracer, photographs, light, evidence. Out: Certainty, 0 where no photograph shows the vertex.
Source: Fisher information of a least-squares fit with Gaussian priors (any text on estimation); the choice of noise is ours.
"""

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.brdf import f0_from_base
from drgs.maths.constants import F0
from drgs.maths.frames import tangents_from_normal
from drgs.reconstruct.fit.evidence.metal_evidence import DARK, NOISE
from drgs.reconstruct.fit.evidence.seen_vertices import SeenVertices, mirrored_radiance, seen_vertices
from drgs.reconstruct.fit.light.mesh_light import LightOf, MeshLight
from drgs.reconstruct.fit.light.split_sum import LEVELS, shade_split_sum
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.certainty import Certainty

PRIOR_ALBEDO = 0.1
"""Standard deviation of what is known without photographs: where they say as much, certainty is 0.5."""
PRIOR_ROUGHNESS = 0.1
PRIOR_TILT = 0.1
"""[rad]"""
PRIOR_METALLIC = 0.5
ABSORBED = 0.05
"""Relative error of the light that no residual shows, because the fit has put it into materials and shape."""
STEP = 0.02
"""Half the difference that slopes are taken over: of roughness, and of the normal's tilt [rad]."""


@torch.no_grad()
def vertex_certainty(tracer: AbstractTracer, targets: list[ViewTarget], light_of: LightOf, evidence: Float[Tensor, "vertex"]) -> Certainty:
    """Of the tracer's mesh, as it was fitted.

    Args:
        evidence: of metal_evidence.
    """
    mesh = tracer.mesh
    count, device = len(mesh.vertices), mesh.vertices.device
    squares, error, measurements = (torch.zeros(count, *shape, device=device) for shape in ((5, 5), (), ()))
    for target in targets:
        seen = seen_vertices(tracer, target)
        if len(seen.index) == 0:
            continue
        shown, slopes = _shading(tracer, seen, light_of(target))
        weight = 1 / (seen.photo + DARK)
        slopes = slopes * weight[..., None]
        squares.index_add_(0, seen.index, torch.einsum("nci,ncj->nij", slopes, slopes))
        error.index_add_(0, seen.index, ((shown - seen.photo) * weight).square().sum(-1))
        measurements.index_add_(0, seen.index, torch.full_like(seen.photo[:, 0], seen.photo.shape[1]))
    measurements = measurements.clamp(min=1).double()
    variance = (NOISE**2 + error) / measurements + ABSORBED**2
    information = squares / (measurements * variance)[:, None, None]

    # In units of the priors' deviations the diagonal of the inverse is the share of the variance that is left.
    prior = torch.tensor([PRIOR_ALBEDO, PRIOR_ROUGHNESS, PRIOR_METALLIC, PRIOR_TILT, PRIOR_TILT], dtype=torch.float64, device=device)
    left = torch.linalg.inv(torch.eye(5, dtype=torch.float64, device=device) + prior[:, None] * information * prior)
    albedo, roughness, metallic = (1 - torch.diagonal(left, dim1=1, dim2=2)[:, :3]).unbind(1)
    shape = 1 - _larger_eigenvalue(left[:, 3:, 3:])
    return Certainty(*(values.clamp(0, 1).to(torch.float16) for values in (shape, albedo, roughness, metallic * evidence.abs())))


def _shading(tracer: AbstractTracer, seen: SeenVertices, light: MeshLight) -> tuple[Tensor, Tensor]:
    """(seen, 3) radiance that is predicted towards the camera, and (seen, 3, 5) its slopes in albedo, roughness, metallic and two tilts."""
    mesh, index = tracer.mesh, seen.index
    normal, albedo, metallic = mesh.normals[index], mesh.albedo[index], mesh.metallic[index]
    transmittance, met = mirrored_radiance(tracer, seen, light)
    none, white = torch.zeros_like(albedo), torch.ones_like(albedo)
    shade = partial(
        shade_split_sum,
        residual=none,
        wo=seen.wo,
        tables=light.tables,
        transmittance=transmittance,
        hit_radiance=met,
        open_share=light.open_share[index],
        light_from_world=light.light_from_world,
    )
    roughness = mesh.roughness[index].clamp(LEVELS[0][0] + STEP, LEVELS[-1][0] - STEP)
    plain = partial(shade, roughness=mesh.roughness[index], normal=normal)
    edge = plain(diffuse_albedo=none, f0=none)
    diffuse, mirror = plain(diffuse_albedo=white, f0=none) - edge, plain(diffuse_albedo=none, f0=white) - edge

    m, f0 = metallic[:, None], f0_from_base(albedo, metallic)
    fitted = partial(shade, diffuse_albedo=(1 - m) * albedo, f0=f0)
    slopes = [(1 - m) * diffuse + m * mirror]
    slopes.append((fitted(roughness=roughness + STEP, normal=normal) - fitted(roughness=roughness - STEP, normal=normal)) / (2 * STEP))
    slopes.append((albedo - F0) * mirror - albedo * diffuse)
    for tangent in tangents_from_normal(normal):
        ahead, behind = (torch.nn.functional.normalize(normal + side * STEP * tangent, dim=-1) for side in (1, -1))
        tilted = [fitted(roughness=mesh.roughness[index], normal=turned) for turned in (ahead, behind)]
        slopes.append((tilted[0] - tilted[1]) / (2 * STEP))
    return edge + (1 - m) * albedo * diffuse + f0 * mirror, torch.stack(slopes, -1)


def _larger_eigenvalue(matrix: Float[Tensor, "vertex 2 2"]) -> Float[Tensor, "vertex"]:
    """Of symmetric ones."""
    a, b, c = matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 1]
    return (a + c) / 2 + (((a - c) / 2).square() + b * b).sqrt()
