"""Albedo as fine as the photographs show it: solved for each vertex from all views at once, and put into what stage 2 found.

Stage 2 looks at a few thousand points a step, so it decides what is large and leaves fine patterns blurred. Under its light, and with its
normals, roughness and metallic, split sum's radiance is linear in a vertex's albedo a, channel by channel: L = B + a A. So least squares over
all photographs that show the vertex has a closed form,

    a = (sum w A (photo - B) + HOLD W a0) / (sum w A^2 + HOLD W)        w = (cos / (photo + DARK))^2

with a0 of stage 2 and W the median of sum w A^2. What of a / a0 varies slowly is divided out: it is split sum's error against traced light, or
light that was not the same in all photographs, and stage 2 knows better. Faces were divided before, until edges are about as long as pixels are wide.

Where the surface lies in the wrong place, each photograph shows something else there, and its mean is no paint. So the same is solved from the
photographs of one side and of the other alone: what both say counts, what they contradict does not.

In: the mesh through its tracer, photographs, light. Out: albedo. Source: linear least squares; reliability of a mean by its halves (docs/sources.md: spearman1910); ours.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from drgs.maths.brdf import f0_from_base
from drgs.maths.frames import tangents_from_normal
from drgs.reconstruct.fit.evidence.metal_evidence import DARK
from drgs.reconstruct.fit.evidence.seen_vertices import SeenVertices, mirrored_radiance, seen_vertices
from drgs.reconstruct.fit.light.mesh_light import LightOf, MeshLight
from drgs.reconstruct.fit.light.split_sum import shade_split_sum
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix
from drgs.reconstruct.geometry.mesh_edges import MeshEdges
from drgs.render.intersect.tracer import AbstractTracer

LEAST, MOST = 0.005, 0.995
"""Albedo, as logits_of_shares keeps it."""
MOST_RATIO = 4.0
"""To stage 2's albedo; what differs more was seen wrongly."""
HOLD = 0.05
"""Weight of stage 2's albedo, against what a median vertex's photographs say."""
SIDES = 4
"""Of a vertex's normal, about a frame of its own, from which photographs show it."""
HALVES = (((0, 1), (2, 3)), ((0, 2), (1, 3)))
"""Sides whose photographs are compared."""
RINGS = 5
"""Neighbourhoods of undivided faces over which slow changes are told from fast ones, and fast ones are compared."""


@torch.no_grad()
def albedo_detail(
    tracer: AbstractTracer, targets: list[ViewTarget], light_of: LightOf, edges: MeshEdges, rings: int
) -> Float[Tensor, "vertex 3"]:
    """Of the tracer's mesh: its albedo with what the photographs show finer than `rings` neighbourhoods."""
    albedo = tracer.mesh.albedo
    explained, weight = _sums_by_side(tracer, targets, light_of)
    known = weight.sum(0) > 0
    if not bool(known.any()):
        return albedo
    around, hold = averaging_matrix(edges, len(albedo)), HOLD * weight.sum(0)[known].median()

    def fine(sides: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        """(vertex, 3) of albedo over its slow part, less 1, by the photographs of these sides; and (vertex,) whether they say something."""
        share = len(sides) / SIDES
        own, own_hold = weight[list(sides)].sum(0), share * hold
        ratio = (explained[list(sides)].sum(0) + own_hold * albedo) / ((own + own_hold) * albedo)
        ratio = ratio.clamp(1 / MOST_RATIO, MOST_RATIO)
        return ratio / averaged(around, ratio, rings) - 1, (own > own_hold).all(-1)

    agreed, each = torch.zeros_like(albedo[:, 0]), torch.zeros_like(albedo[:, 0])
    for sides, others in HALVES:
        (one, says_one), (other, says_other) = fine(sides), fine(others)
        both = (says_one & says_other).to(one)
        agreed += both * (one * other).sum(-1)
        each += both * (one.square() + other.square()).sum(-1) / 2
    agreed, each = averaged(around, torch.stack([agreed, each], -1), rings).unbind(1)
    alike = (agreed / each.clamp(min=1e-8)).clamp(0, 1)
    # As strong as paint is whose halves are so much alike: errors of the mean would make it stronger.
    strength = (2 * alike / (1 + alike)).sqrt()
    return (albedo * (1 + strength[:, None] * fine(tuple(range(SIDES)))[0])).clamp(LEAST, MOST)


def _sums_by_side(
    tracer: AbstractTracer, targets: list[ViewTarget], light_of: LightOf
) -> tuple[Float[Tensor, "side vertex 3"], Float[Tensor, "side vertex 3"]]:
    """Both sums of the least squares, for photographs from each of SIDES sides of the vertex's normal."""
    mesh = tracer.mesh
    explained, weight = (torch.zeros(SIDES, *mesh.albedo.shape, device=mesh.albedo.device) for _ in range(2))
    for target in targets:
        seen = seen_vertices(tracer, target)
        if len(seen.index) == 0:
            continue
        black, slope = _linear_in_albedo(tracer, seen, light_of(target))
        normal = mesh.normals[seen.index]
        right, ahead = ((seen.wo * tangent).sum(-1) > 0 for tangent in tangents_from_normal(normal))
        place = (2 * right.long() + ahead.long()) * len(mesh.vertices) + seen.index
        trust = ((normal * seen.wo).sum(-1, keepdim=True) / (seen.photo + DARK)) ** 2
        explained.flatten(0, 1).index_add_(0, place, trust * slope * (seen.photo - black))
        weight.flatten(0, 1).index_add_(0, place, trust * slope * slope)
    return explained, weight


def _linear_in_albedo(tracer: AbstractTracer, seen: SeenVertices, light: MeshLight) -> tuple[Tensor, Tensor]:
    """(seen, 3) radiance towards the camera of vertices without albedo, and (seen, 3) what a unit of albedo adds."""
    mesh, index = tracer.mesh, seen.index
    metallic, transmittance_and_met = mesh.metallic[index], mirrored_radiance(tracer, seen, light)

    def shown(albedo: Tensor) -> Tensor:
        return shade_split_sum(
            albedo * (1 - metallic)[:, None], torch.zeros_like(albedo), f0_from_base(albedo, metallic), mesh.roughness[index],
            mesh.normals[index], seen.wo, light.tables, *transmittance_and_met, light.open_share[index], light.light_from_world,
        )  # fmt: skip

    black = shown(torch.zeros_like(seen.photo))
    return black, shown(torch.ones_like(seen.photo)) - black
