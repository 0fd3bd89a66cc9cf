"""Whether a place is metal, by what the photographs say: two explanations of its brightness over all views, each at its best.

With geometry, roughness and light as they are, the radiance of a vertex in view v is, by split sum,

    L_v = d E + f A_v + B_v,   A_v = S_v F1,  B_v = S_v F2,

with d the diffuse albedo, f the reflectance at normal incidence, E the irradiance over pi that arrives and S_v the light of the mirror lobe.
Matter that is no metal has f = 0.04 and a free d, metal has d = 0 and a free f: three numbers each, so that their residuals compare fairly.
Gradients never decide this: a darker light and a diffuse part trade places without a trace in the loss.

Errors of shape and light spoil the predicted mirror S_v, not the constant E, so they count against metal alone: real paint hardly ever says
"metal", real metal says "paint" wherever its normals are off. So the benefit of the doubt is metal's, and each place hears its surroundings.
Where light turns with the camera, what arrives at paint changes from view to view as well, and is predicted nearly as badly: then there is less of it.

In: the mesh through its tracer, photographs, light. Out: evidence in -1 (no metal) .. 1 (metal) a vertex, near 0 where nothing is known.
"""

from functools import partial

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.constants import F0
from drgs.reconstruct.fit.evidence.seen_vertices import mirrored_radiance, seen_vertices
from drgs.reconstruct.fit.light.mesh_light import LightOf
from drgs.reconstruct.fit.light.split_sum import shade_split_sum
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.agree_along_edges import agree_along_edges
from drgs.reconstruct.geometry.mesh_edges import MeshEdges
from drgs.render.intersect.tracer import AbstractTracer

FEWEST_VIEWS = 4
DARK = 0.05
"""Radiance below which errors count as absolute rather than relative."""
NOISE = 0.02
"""Standard deviation of a photograph's radiance, relative above DARK, that explains nothing."""
NEIGHBOURHOOD = 3
"""Times that residuals are averaged with the neighbours'."""
DOUBT = 0.4
"""Of the residuals' logarithms: by how much metal may explain worse and is believed, where it leaves much unexplained."""
DOUBT_TURNED = 0.2
"""The same where light turns with the camera. Drafts, metallic RMSE of bunny and teapot: .45 and .38 with 0.4, .17 and .42 with 0.2, .09 and .54 with 0."""
LOST = 0.45
"""Relative error of the better explanation above which neither says much: there the shape is wrong, not the paint."""
STRONGEST = 2.0
"""Difference of the logarithms beyond which a place counts no more than that."""
TOGETHER = 3.0
"""Weight of neighbours being of one kind, against a difference of logarithms of 1."""
UNSEEN = 1e-4
"""Weight of a place of which views say nothing: it is what its surroundings are."""
DECISIVE = 0.3
"""Agreement of a place and its surroundings, -1..1, at which evidence is 0.76."""


def metal_evidence(tracer: AbstractTracer, targets: list[ViewTarget], light_of: LightOf, edges: MeshEdges) -> Float[Tensor, "vertex"]:
    """Of the tracer's mesh, whose roughness is taken as known."""
    mesh = tracer.mesh
    count, device = len(mesh.vertices), mesh.vertices.device
    sums = torch.zeros(7, count, 3, device=device)  # w, E y0, E^2 (of no metal); A y, A^2, y^2 (of metal); y0^2
    views = torch.zeros(count, device=device)
    for target in targets:
        here = seen_vertices(tracer, target)
        seen, photo = here.index, here.photo
        if len(seen) == 0:
            continue
        normal, roughness = mesh.normals[seen], mesh.roughness[seen]
        light = light_of(target)
        transmittance, met = mirrored_radiance(tracer, here, light)

        white = torch.ones(len(seen), 3, device=device)
        shaded = partial(shade_split_sum, residual=0 * white, roughness=roughness, normal=normal, wo=here.wo, tables=light.tables)
        shaded = partial(shaded, light_from_world=light.light_from_world)
        lit = partial(shaded, transmittance=transmittance, hit_radiance=met, open_share=light.open_share[seen])
        b = lit(diffuse_albedo=0 * white, f0=0 * white)
        a, e = lit(diffuse_albedo=0 * white, f0=white) - b, lit(diffuse_albedo=white, f0=0 * white) - b
        y = photo - b
        y0 = y - F0 * a
        weight = 1 / (photo + DARK) ** 2
        for k, term in enumerate((torch.ones_like(y), e * y0, e * e, a * y, a * a, y * y, y0 * y0)):
            sums[k].index_add_(0, seen, weight * term)
        views.index_add_(0, seen, torch.ones_like(roughness))
    _, ey, ee, ay, aa, yy, y0y0 = sums
    diffuse = (ey / ee.clamp(min=1e-12)).clamp(0, 1)
    plain = (y0y0 - 2 * diffuse * ey + diffuse**2 * ee).clamp(min=0).sum(-1)
    reflectance = (ay / aa.clamp(min=1e-12)).clamp(0, 1)
    metal = (yy - 2 * reflectance * ay + reflectance**2 * aa).clamp(min=0).sum(-1)
    floor = 3 * NOISE**2 * views
    plain, metal = (_averaged(error + floor, views, edges) for error in (plain, metal))
    floor = _averaged(floor, views, edges)
    unexplained = 1 - floor / metal.clamp(min=1e-12)
    relative_error = ((torch.minimum(plain, metal) - floor).clamp(min=0) / 3).sqrt()
    trust = 1 / (1 + (relative_error / LOST) ** 4)
    doubt = DOUBT if all(target.light_from_world is None for target in targets) else DOUBT_TURNED
    better = torch.log(plain.clamp(min=1e-12) / metal.clamp(min=1e-12)) + doubt * trust * unexplained
    strength = torch.where(views >= FEWEST_VIEWS, trust * better.abs().clamp(max=STRONGEST), torch.zeros_like(better))
    kind = agree_along_edges(edges, strength + UNSEEN, torch.sign(better) * (strength > 0), TOGETHER)
    return torch.tanh(kind / DECISIVE)


def _averaged(error: Tensor, views: Tensor, edges: MeshEdges) -> Tensor:
    """(vertex,) error a view, averaged over the neighbourhood by the number of views."""
    start, end = edges.vertices.unbind(1)
    total, weight = error.clone(), views.clone()
    for _ in range(NEIGHBOURHOOD):
        total, weight = (
            values + torch.zeros_like(values).index_add_(0, start, values[end]).index_add_(0, end, values[start])
            for values in (total, weight)
        )
    return total / weight.clamp(min=1)
