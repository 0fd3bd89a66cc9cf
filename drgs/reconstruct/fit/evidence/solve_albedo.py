"""Albedo as fine as the photographs show it: solved for places on the faces from all views at once, and put into what stage 2 found.

Stage 2 looks at a few thousand points a step, so it decides what is large and leaves fine patterns blurred. Under its light, and with its
normals, roughness and metallic, split sum's radiance is linear in a place's albedo a, channel by channel: L = B + a A. So least squares over
all photographs that show the place has a closed form,

    a = (sum w A (photo - B) + HOLD W a0) / (sum w A^2 + HOLD W)        w = (cos / (photo + DARK))^2

with a0 of stage 2 and W the median of sum w A^2. B, A and what hides a place are known at vertices and taken as linear between them; the photographs
are looked up at each place, at the size at which they were taken. What of a / a0 varies slowly is divided out: it is split sum's error against traced
light, or light that was not the same in all photographs, and stage 2 knows better.

Where the surface lies in the wrong place, each photograph shows something else there, and its mean is no paint. So the same is solved from the
photographs of one side and of the other alone: what both say counts, what they contradict does not.

In: the mesh through its tracer, photographs, light. Out: albedo of the vertices, and AlbedoDetail between them. Source: linear least squares; reliability
of a mean by its halves (docs/sources.md: spearman1910); ours.
"""

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int, Int32
from torch import Tensor

from drgs.maths.brdf import f0_from_base
from drgs.maths.frames import tangents_from_normal
from drgs.reconstruct.fit.evidence.albedo_kernels import add_photograph
from drgs.reconstruct.fit.evidence.seen_vertices import SeenVertices, mirrored_radiance, seen_vertices
from drgs.reconstruct.fit.light.mesh_light import LightOf, MeshLight
from drgs.reconstruct.fit.light.split_sum import shade_split_sum
from drgs.reconstruct.fit.view_targets import ViewTarget
from drgs.reconstruct.geometry.average_around import averaged, averaging_matrix
from drgs.reconstruct.geometry.face_samples import FaceSamples, face_samples
from drgs.reconstruct.geometry.mesh_edges import MeshEdges
from drgs.render.intersect.tracer import AbstractTracer
from drgs.scene.albedo_detail import MOST_PARTS, AlbedoDetail, codes_of
from drgs.scene.camera import Camera
from drgs.scene.mesh import TriangleMesh

LEAST, MOST = 0.005, 0.995
"""Albedo, as logits_of_shares keeps it."""
MOST_RATIO = 4.0
"""To stage 2's albedo; what differs more was seen wrongly."""
HOLD = 0.05
"""Weight of stage 2's albedo, against what a median place's photographs say."""
SIDES = 4
"""Of a surface's normal, about a frame of its own, from which photographs show it."""
HALVES = (((0, 1), (2, 3)), ((0, 2), (1, 3)))
"""Sides whose photographs are compared."""
RINGS = 5
"""Neighbourhoods of undivided faces over which slow changes are told from fast ones, and fast ones are compared."""


@dataclass(frozen=True)
class DetailSettings:
    """How fine."""

    most_samples: int = 3_000_000
    """On all faces, each counted once. While they are solved for one takes 150 bytes, in an asset about 6."""
    side: int = 2048
    """Photographs are reduced to at most this [pixels]."""


@dataclass(frozen=True, eq=False)
class SolvedAlbedo:
    """What the photographs say."""

    albedo: Float[Tensor, "vertex 3"]
    """The mean around each vertex."""
    detail: AlbedoDetail | None
    """By which it is multiplied between the vertices; None: samples were vertices alone."""


def parts_for(mesh: TriangleMesh, cameras: tuple[Camera, ...], settings: DetailSettings) -> int:
    """Into how many parts to cut each side of a face: samples then lie as far apart as pixels of the photographs, or as near as there may be samples.

    Args:
        cameras: of the photographs as they are looked up.
    """
    corners = mesh.vertices[mesh.faces.long()]
    edge = float((corners - corners.roll(1, 1)).norm(dim=-1).mean())
    middle = mesh.vertices.mean(0)
    pixel = torch.stack([(camera.center_world.to(middle) - middle).norm() / camera.intrinsics[0, 0].to(middle) for camera in cameras])
    wanted = round(edge / float(pixel.median()))
    # There are half as many vertices as faces, and parts^2 as many samples as vertices.
    allowed = int((2 * settings.most_samples / len(mesh.faces)) ** 0.5)
    return max(1, min(wanted, allowed, MOST_PARTS))


@torch.no_grad()
def solve_albedo(
    tracer: AbstractTracer,
    targets: list[ViewTarget],
    as_taken: Callable[[int], ViewTarget],
    light_of: LightOf,
    edges: MeshEdges,
    rings: int,
    parts: int,
) -> SolvedAlbedo:
    """Of the tracer's mesh: its albedo with what the photographs show finer than `rings` neighbourhoods.

    Args:
        targets: as the fits saw them. as_taken: gives the photograph of a target at the size at which it is looked up.
        parts: of each side of a face, between which samples lie; 1: at vertices alone.
    """
    mesh = tracer.mesh
    samples = face_samples(mesh.faces, len(mesh.vertices), parts)
    own_albedo = samples.at(mesh.albedo)
    explained, weight = _sums_by_side(tracer, targets, as_taken, light_of, samples)
    known = weight.sum(0) > 0
    if not bool(known.any()):
        return SolvedAlbedo(mesh.albedo, None)
    outwards, inwards = samples.averaging(len(mesh.vertices))
    around, hold = averaging_matrix(edges, len(mesh.vertices)), HOLD * weight.sum(0)[known].median()

    def at_vertices(values: Tensor) -> Tensor:
        """(vertex, k) means of (sample, k) values around them."""
        return torch.from_numpy(inwards @ values.cpu().double().numpy())

    def slowly(values: Tensor) -> Tensor:
        """(sample, k) values averaged over `rings` neighbourhoods."""
        return torch.from_numpy(outwards @ averaged(around, at_vertices(values), rings).cpu().numpy()).to(values)

    def fine(sides: tuple[int, ...]) -> tuple[Tensor, Tensor]:
        """(sample, 3) of albedo over its slow part, less 1, by the photographs of these sides; and (sample,) whether they say something."""
        share = len(sides) / SIDES
        own, own_hold = weight[list(sides)].sum(0), share * hold
        ratio = (explained[list(sides)].sum(0) + own_hold * own_albedo) / ((own + own_hold) * own_albedo)
        ratio = ratio.clamp(1 / MOST_RATIO, MOST_RATIO)
        return ratio / slowly(ratio) - 1, (own > own_hold).all(-1)

    agreed, each = torch.zeros_like(own_albedo[:, 0]), torch.zeros_like(own_albedo[:, 0])
    for sides, others in HALVES:
        (one, says_one), (other, says_other) = fine(sides), fine(others)
        both = (says_one & says_other).to(one)
        agreed += both * (one * other).sum(-1)
        each += both * (one.square() + other.square()).sum(-1) / 2
    agreed, each = slowly(torch.stack([agreed, each], -1)).unbind(1)
    alike = (agreed / each.clamp(min=1e-8)).clamp(0, 1)
    # As strong as paint is whose halves are so much alike: errors of the mean would make it stronger.
    strength = (2 * alike / (1 + alike)).sqrt()
    found = (own_albedo * (1 + strength[:, None] * fine(tuple(range(SIDES)))[0])).clamp(LEAST, MOST)
    if parts == 1:
        return SolvedAlbedo(found, None)
    albedo = (mesh.albedo + at_vertices(found - own_albedo).to(found)).clamp(LEAST, MOST)
    return SolvedAlbedo(albedo, AlbedoDetail(codes_of(found / samples.at(albedo))[samples.number]))


def _sums_by_side(
    tracer: AbstractTracer, targets: list[ViewTarget], as_taken: Callable[[int], ViewTarget], light_of: LightOf, samples: FaceSamples
) -> tuple[Float[Tensor, "side sample 3"], Float[Tensor, "side sample 3"]]:
    """Both sums of the least squares, for photographs from each of SIDES sides of the surface's normal."""
    mesh, count = tracer.mesh, len(samples.corners)
    explained, weight = (torch.zeros(SIDES, count, 3, device=mesh.albedo.device) for _ in range(2))
    for target, large in zip(targets, _one_ahead(as_taken, len(targets)), strict=True):
        seen = seen_vertices(tracer, target)
        if len(seen.index) == 0:
            continue
        normal = mesh.normals[seen.index]
        side = torch.full_like(mesh.roughness, -1, dtype=torch.int32)
        side[seen.index] = _side_of_view(normal, seen.wo)
        found = (*_linear_in_albedo(tracer, seen, light_of(target)), (normal * seen.wo).sum(-1))
        black, slope, cosine = (_at_vertices(values, seen.index, len(mesh.vertices)) for values in found)
        add_photograph(large, samples, mesh.vertices, side, black, slope, cosine, explained, weight)
    return explained, weight


def _one_ahead(as_taken: Callable[[int], ViewTarget], count: int) -> Iterator[ViewTarget]:
    """All of them in turn; the next one is read meanwhile, for large files take as long as what is done with them."""
    with ThreadPoolExecutor(1, thread_name_prefix="photographs") as reader:
        coming = None
        for number in range(count):
            photograph = (coming or reader.submit(as_taken, number)).result()
            coming = reader.submit(as_taken, number + 1) if number + 1 < count else None
            yield photograph


def _at_vertices(values: Float[Tensor, "seen *rest"], index: Int[Tensor, "seen"], count: int) -> Float[Tensor, "{count} *rest"]:
    """0 at those that are not seen."""
    return values.new_zeros(count, *values.shape[1:]).index_copy_(0, index, values)


def _side_of_view(normal: Float[Tensor, "seen 3"], wo: Float[Tensor, "seen 3"]) -> Int32[Tensor, "seen"]:
    """Of SIDES, from which places with these normals are seen."""
    right, ahead = ((wo * tangent).sum(-1) > 0 for tangent in tangents_from_normal(normal))
    return 2 * right.int() + ahead.int()


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
