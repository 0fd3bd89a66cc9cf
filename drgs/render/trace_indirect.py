"""Outgoing light of the surfaces that rays meet: a path traced from each hit.

In: first hits of a batch of rays. Out: radiance that each hit sends back along its ray; 0 for rays without a hit.
A hit takes material and shading normal from the mesh's vertices. Its direct light is one sample of the environment table
and one of the BRDF under the balance heuristic, each with its own shadow ray; the BRDF ray carries the path on while
bounces are left, ended by Russian roulette from the second hit onwards. Nothing is clamped or cached.
The back of a triangle sends nothing.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import warp as wp
from jaxtyping import Float, Int
from torch import Tensor

from drgs.maths.brdf import MIN_ROUGHNESS
from drgs.render.brdf_warp import PI, alpha_of, cosine_direction, ggx_direction, ggx_pdf, specular_brdf
from drgs.render.environment_table import EnvironmentLight, environment_direction, lookup_pdf, lookup_radiance, table_place
from drgs.render.horizon import horizon_sector
from drgs.render.random_warp import hash_combine, shuffle_index, sobol_2d
from drgs.render.records import Hits
from drgs.render.sample_rays import PointArrays, SampleSet, round_at, split_at, strategy_of, strategy_seed
from drgs.render.tracer import AbstractTracer
from drgs.scene.mesh import TriangleMesh
from drgs.warp_torch import warp_array, warp_device

wp.set_module_options({"enable_backward": False})


@wp.struct
class MeshArrays:
    """TriangleMesh as kernels see it."""

    vertices: wp.array[wp.vec3]
    faces: wp.array[int]
    normals: wp.array[wp.vec3]
    albedo: wp.array[wp.vec3]
    roughness: wp.array[float]
    metallic: wp.array[float]
    lift: float
    """Of ray origins off the surface."""
    horizon: wp.array[float]
    """Eight of each face (horizon_sector); empty where none is known."""


def mesh_arrays(mesh: TriangleMesh, lift: float, horizon: Tensor | None = None) -> Any:
    """The struct that kernels read; shares memory with the tensors.

    Args:
        horizon: (face, SECTORS) sines; rays above them are not traced.
    """
    arrays = MeshArrays()
    arrays.vertices = warp_array(mesh.vertices.float(), wp.vec3)
    arrays.faces = warp_array(mesh.faces.to(torch.int32).reshape(-1))
    arrays.normals = warp_array(mesh.normals.float(), wp.vec3)
    arrays.albedo = warp_array(mesh.albedo.float(), wp.vec3)
    arrays.roughness = warp_array(mesh.roughness.float())
    arrays.metallic = warp_array(mesh.metallic.float())
    arrays.lift = lift
    arrays.horizon = warp_array(mesh.roughness[:0].float() if horizon is None else horizon.reshape(-1))
    return arrays


@wp.struct
class Surface:
    """A point on the mesh with its interpolated attributes."""

    position: wp.vec3
    normal: wp.vec3
    """Shading normal."""
    face_normal: wp.vec3
    albedo: wp.vec3
    roughness: float
    metallic: float


@wp.func
def surface_at(mesh: MeshArrays, face: int, barycentric: wp.vec2) -> Surface:
    a = mesh.faces[3 * face]
    b = mesh.faces[3 * face + 1]
    c = mesh.faces[3 * face + 2]
    y = barycentric[0]
    z = barycentric[1]
    x = 1.0 - y - z
    pa = mesh.vertices[a]
    pb = mesh.vertices[b]
    pc = mesh.vertices[c]
    surface = Surface()
    surface.position = x * pa + y * pb + z * pc
    surface.normal = wp.normalize(x * mesh.normals[a] + y * mesh.normals[b] + z * mesh.normals[c])
    surface.face_normal = wp.normalize(wp.cross(pb - pa, pc - pa))
    surface.albedo = x * mesh.albedo[a] + y * mesh.albedo[b] + z * mesh.albedo[c]
    surface.roughness = x * mesh.roughness[a] + y * mesh.roughness[b] + z * mesh.roughness[c]
    surface.metallic = x * mesh.metallic[a] + y * mesh.metallic[b] + z * mesh.metallic[c]
    return surface


@wp.func
def far_along(direction: wp.vec3) -> wp.vec3:
    """An origin far outside from which a ray leads away: it misses at the root of the tree."""
    return wp.vec3(
        wp.where(direction[0] < 0.0, -1.0e15, 1.0e15),
        wp.where(direction[1] < 0.0, -1.0e15, 1.0e15),
        wp.where(direction[2] < 0.0, -1.0e15, 1.0e15),
    )


@wp.func
def face_limit(mesh: MeshArrays, face: int, normal: wp.vec3, direction: wp.vec3) -> float:
    """Sine of elevation above which a ray from a face meets nothing; 2 where that is not known."""
    if mesh.horizon.shape[0] == 0:
        return 2.0
    return mesh.horizon[8 * face + horizon_sector(normal, direction)]


@wp.func
def brdf_times_cosine(surface: Surface, wi: wp.vec3, wo: wp.vec3, alpha: float) -> wp.vec3:
    cosine = wp.dot(surface.normal, wi)
    diffuse = surface.albedo * ((1.0 - surface.metallic) / PI)
    return cosine * (diffuse + specular_brdf(wi, wo, surface.normal, alpha, surface.albedo, surface.metallic))


@wp.kernel
def scatter_hits(
    path_ray: wp.array[wp.int64],
    face: wp.array[int],
    barycentric: wp.array[wp.vec2],
    ray_direction: wp.array[wp.vec3],
    throughput: wp.array[wp.vec3],
    first_point: int,
    depth: int,
    path_count: int,
    points: PointArrays,
    light: EnvironmentLight,
    mesh: MeshArrays,
    samples: SampleSet,
    # outputs: light rays first, BRDF rays after them
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    contribution: wp.array[wp.vec3],
    next_throughput: wp.array[wp.vec3],
):
    i = wp.tid()
    j = i + path_count
    zero = wp.vec3(0.0, 0.0, 0.0)
    outside = wp.vec3(1.0e15, 1.0e15, 1.0e15)
    away = wp.vec3(0.57735027, 0.57735027, 0.57735027)
    origin[i] = outside
    origin[j] = outside
    direction[i] = away
    direction[j] = away
    contribution[i] = zero
    contribution[j] = zero
    next_throughput[i] = zero
    surface = surface_at(mesh, face[i], barycentric[i])
    wo = -ray_direction[i]
    n = surface.normal
    n_dot_v = wp.dot(n, wo)
    if n_dot_v <= 0.0 or wp.dot(surface.face_normal, wo) <= 0.0:
        return
    count = samples.cosine + samples.ggx + samples.environment
    ray = int(path_ray[i])
    point = first_point + ray // count
    pixel = points.pixel[point]
    place = strategy_of(split_at(samples, points, point), round_at(samples, points, point), ray % count)
    base = strategy_seed(samples, pixel, place[0])
    index = wp.uint32(place[1])
    seed_light = hash_combine(base, wp.uint32(16 + 4 * depth))
    seed_brdf = hash_combine(base, wp.uint32(17 + 4 * depth))
    seed_choice = hash_combine(base, wp.uint32(18 + 4 * depth))
    u_light = sobol_2d(shuffle_index(index, seed_light), seed_light)
    u_brdf = sobol_2d(shuffle_index(index, seed_brdf), seed_brdf)
    u_choice = sobol_2d(shuffle_index(index, seed_choice), seed_choice)
    alpha = alpha_of(surface.roughness)
    start = surface.position + mesh.lift * surface.face_normal
    # The lobe is chosen by its share of the reflected energy, Fresnel at the viewing angle.
    c = 1.0 - n_dot_v
    fresnel = c * c * c * c * c
    f0 = wp.max(0.04 * (1.0 - surface.metallic) + wp.max(surface.albedo) * surface.metallic, 1.0e-3)
    specular = f0 + (1.0 - f0) * fresnel
    diffuse = (1.0 - surface.metallic) * wp.max(surface.albedo)
    share = wp.clamp(specular / (specular + diffuse), 0.1, 1.0)
    carried = throughput[i]
    wi = environment_direction(light, u_light)
    n_dot_l = wp.dot(n, wi)
    if n_dot_l > 0.0 and wp.dot(surface.face_normal, wi) > 0.0:
        uv = table_place(light, wi)
        density = lookup_pdf(light, uv) + share * ggx_pdf(wi, wo, n, alpha) + (1.0 - share) * n_dot_l / PI
        if density > 0.0:
            limit = face_limit(mesh, face[i], surface.face_normal, wi)
            origin[i] = wp.where(wp.dot(surface.face_normal, wi) <= limit, start, far_along(wi))
            direction[i] = wi
            incoming = lookup_radiance(light, uv)
            contribution[i] = wp.cw_mul(carried, wp.cw_mul(brdf_times_cosine(surface, wi, wo, alpha), incoming)) / density

    if u_choice[0] < share:  # noqa: SIM108 (a Warp expression would evaluate both)
        wi = ggx_direction(u_brdf, wo, n, alpha)
    else:
        wi = cosine_direction(u_brdf, n)
    n_dot_l = wp.dot(n, wi)
    if n_dot_l > 0.0 and wp.dot(surface.face_normal, wi) > 0.0:
        uv = table_place(light, wi)
        own = share * ggx_pdf(wi, wo, n, alpha) + (1.0 - share) * n_dot_l / PI
        if own > 0.0:
            reflected = wp.cw_mul(carried, brdf_times_cosine(surface, wi, wo, alpha))
            limit = face_limit(mesh, face[i], surface.face_normal, wi)
            origin[j] = wp.where(wp.dot(surface.face_normal, wi) <= limit, start, far_along(wi))
            direction[j] = wi
            contribution[j] = wp.cw_mul(reflected, lookup_radiance(light, uv)) / (own + lookup_pdf(light, uv))
            survival = wp.float32(1.0)
            if depth > 0:
                survival = wp.clamp(wp.max(reflected) / own, 0.05, 1.0)
            if u_choice[1] < survival:
                next_throughput[i] = reflected / (own * survival)


def ray_source(name: str, *parts: int) -> str:
    """Chosen parts of the native function body in one of this folder's files, with what it needs before it."""
    folder = Path(__file__).parent
    shared = [folder / "rasterize_gbuffer" / "tile_vector.h", folder / "ray_vector.h"]
    body = (folder / name).read_text().split("// ----\n")
    return f"constexpr float MIN_ROUGHNESS = {MIN_ROUGHNESS}f;\n" + "".join(
        [path.read_text() for path in shared] + [body[part] for part in parts]
    )


@wp.func_native(ray_source("scatter_hits.h", 0, 1, 3))
def scatter_sixteen_hits(
    base: int, paths: int,
    path_ray: wp.array(dtype=wp.int64), face: wp.array(dtype=int), barycentric: wp.array(dtype=wp.vec2), ray_direction: wp.array(dtype=wp.vec3),
    throughput: wp.array(dtype=wp.vec3), first_point: int, depth: int,
    points: PointArrays, light: EnvironmentLight, mesh: MeshArrays, samples: SampleSet,
    origin: wp.array(dtype=wp.vec3), direction: wp.array(dtype=wp.vec3), contribution: wp.array(dtype=wp.vec3),
    next_throughput: wp.array(dtype=wp.vec3),
): ...  # fmt: skip


@wp.kernel(enable_backward=False, module="unique")
def scatter_hits_simd(
    path_ray: wp.array[wp.int64],
    face: wp.array[int],
    barycentric: wp.array[wp.vec2],
    ray_direction: wp.array[wp.vec3],
    throughput: wp.array[wp.vec3],
    first_point: int,
    depth: int,
    path_count: int,
    points: PointArrays,
    light: EnvironmentLight,
    mesh: MeshArrays,
    samples: SampleSet,
    # outputs
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    contribution: wp.array[wp.vec3],
    next_throughput: wp.array[wp.vec3],
):
    """scatter_hits for sixteen paths a launch index, on the CPU."""
    scatter_sixteen_hits(
        16 * wp.tid(), path_count, path_ray, face, barycentric, ray_direction, throughput, first_point, depth, points, light, mesh, samples,
        origin, direction, contribution, next_throughput,
    )  # fmt: skip


def scatter_kernel(device: torch.device) -> Any:
    """The one that trace_indirect launches there."""
    return scatter_hits_simd if device.type == "cpu" else scatter_hits


@wp.kernel
def add_contributions(
    path_ray: wp.array[wp.int64],
    contribution: wp.array[wp.vec3],
    blocked: wp.array[wp.bool],
    path_count: int,
    # outputs
    indirect: wp.array[wp.vec3],
):
    i = wp.tid()
    j = i + path_count
    total = wp.vec3(0.0, 0.0, 0.0)
    if not blocked[i]:
        total += contribution[i]
    if not blocked[j]:
        total += contribution[j]
    ray = int(path_ray[i])
    indirect[ray] = indirect[ray] + total


@dataclass(frozen=True, eq=False)
class Paths:
    """The rays of a batch that met a surface, packed in their order."""

    ray: Int[Tensor, "path"]
    """int64; number in the batch."""
    face: Int[Tensor, "path"]
    barycentric: Float[Tensor, "path 2"]
    arriving: Float[Tensor, "path 3"]
    """Unit direction of the ray."""


def paths_of_hits(hits: Hits, direction: Tensor) -> Paths:
    """The rays (ray, 3) that met something."""
    ray = torch.nonzero(hits.hit).squeeze(-1)
    return Paths(ray, hits.face[ray], hits.barycentric[ray], direction[ray])


def trace_indirect(
    met: Paths,
    ray_count: int,
    first_point: int,
    points: Any,
    light: Any,
    mesh: Any,
    samples: Any,
    tracer: AbstractTracer,
    bounces: int,
) -> Tensor:
    """(ray, 3) radiance that the first hits of a batch send back along its rays. Runs on the calling thread.

    Args:
        ray_count: of the batch; rays are grouped by point, `samples` a point, from `first_point` on.
        points, light, mesh, samples: PointArrays, EnvironmentLight, MeshArrays and SampleSet structs.
        bounces: at least 1; hits that a path may go through.
    """
    device = met.arriving.device
    warp_dev = warp_device(met.arriving)
    indirect = torch.zeros(ray_count, 3, device=device)
    path_ray, face, barycentric, arriving = met.ray, met.face, met.barycentric, met.arriving
    throughput = torch.ones(len(path_ray), 3, device=device)
    for depth in range(bounces):
        paths = len(path_ray)
        if paths == 0:
            break
        inputs = [
            warp_array(path_ray), warp_array(face), warp_array(barycentric, wp.vec2), warp_array(arriving, wp.vec3),
            warp_array(throughput, wp.vec3), first_point, depth, paths, points, light, mesh, samples,
        ]  # fmt: skip
        origin, direction, contribution = (torch.empty(2 * paths, 3, device=device) for _ in range(3))
        next_throughput = torch.empty(paths, 3, device=device)
        wp.launch(
            scatter_kernel(device),
            dim=-(-paths // 16) if device.type == "cpu" else paths,
            inputs=inputs,
            outputs=[warp_array(t, wp.vec3) for t in (origin, direction, contribution, next_throughput)],
            device=warp_dev,
        )
        if depth + 1 == bounces:
            blocked = tracer.occluded(origin, direction)
        else:
            onward = tracer.closest_hits(origin[paths:], direction[paths:])
            blocked = torch.cat([tracer.occluded(origin[:paths], direction[:paths]), onward.hit])
        wp.launch(
            add_contributions,
            dim=paths,
            inputs=[warp_array(path_ray), warp_array(contribution, wp.vec3), warp_array(blocked), paths],
            outputs=[warp_array(indirect, wp.vec3)],
            device=warp_dev,
        )
        if depth + 1 < bounces:
            alive = torch.nonzero(onward.hit & (next_throughput.amax(-1) > 0)).squeeze(-1)
            path_ray, throughput = path_ray[alive], next_throughput[alive]
            face, barycentric, arriving = onward.face[alive], onward.barycentric[alive], direction[paths:][alive]
    return indirect
