"""Kernels of mesh_light.py: where mirrored rays go, and what a ray sees where it meets the mesh; without gradient."""

from functools import cache
from typing import Any

import warp as wp
from torch import Tensor

from drgs.maths.constants import F0
from drgs.reconstruct.fit.light.ground_light import ground_along
from drgs.reconstruct.fit.light.split_sum_kernels import radiance_of_point
from drgs.render.integrate.random_warp import hash32, hash_combine, unit_float
from drgs.render.intersect.tracer import KernelQuery

wp.set_module_options({"enable_backward": False})

_F0 = wp.constant(float(F0))
MOST_MIRRORS = 2
"""How often mirrored_kernel lets mirror what rays meet: it has place for one hit more."""


@wp.func
def normal_at(blended: wp.vec3) -> wp.vec3:
    return blended / wp.max(wp.length(blended), 1.0e-12)


@wp.func
def base_f0(albedo: wp.vec3, metallic: float) -> wp.vec3:
    """As drgs.maths.brdf.f0_from_base."""
    dielectric = _F0 * (1.0 - metallic)
    return wp.vec3(dielectric, dielectric, dielectric) + albedo * metallic


@wp.func
def vector_at(values: wp.array[wp.vec3], corner: wp.vec3i, weight: wp.vec3) -> wp.vec3:
    return values[corner[0]] * weight[0] + values[corner[1]] * weight[1] + values[corner[2]] * weight[2]


@wp.func
def number_at(values: wp.array[float], corner: wp.vec3i, weight: wp.vec3) -> float:
    return values[corner[0]] * weight[0] + values[corner[1]] * weight[1] + values[corner[2]] * weight[2]


def rotation_of(light_from_world: Tensor | None) -> Any:
    """A kernel's argument; None: directions of the light are those of the world."""
    if light_from_world is None:
        return wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)
    return wp.mat33(*light_from_world.flatten().tolist())


@wp.func
def _corner(face: int, faces: wp.array2d[int]) -> wp.vec3i:
    return wp.vec3i(faces[face, 0], faces[face, 1], faces[face, 2])


@wp.func
def _sent(
    corner: wp.vec3i,
    weight: wp.vec3,
    towards: wp.vec3,
    normals: wp.array[wp.vec3],
    albedo: wp.array[wp.vec3],
    roughness: wp.array[float],
    metallic: wp.array[float],
    open_share: wp.array[wp.vec3],
    open_sky: float,
    seen: wp.vec3,
    light_from_world: wp.mat33,
    tables: wp.array[wp.vec3],
    factors: wp.array[wp.vec2],
) -> wp.vec3:
    """Radiance that a place on the mesh sends `towards`, at least 0; `open_sky` and `seen`: whether its mirrored ray escapes, and what that meets.

    Many arguments because kernels take arrays one by one.
    """
    base = vector_at(albedo, corner, weight)
    metal = number_at(metallic, corner, weight)
    normal = light_from_world * normal_at(vector_at(normals, corner, weight))
    sent = radiance_of_point(
        base * (1.0 - metal), base_f0(base, metal), number_at(roughness, corner, weight), normal, light_from_world * towards, open_sky,
        seen, vector_at(open_share, corner, weight), tables, factors,
    )  # fmt: skip
    return wp.max(sent, wp.vec3(0.0, 0.0, 0.0))


@wp.kernel
def hit_kernel(
    first: int,
    face: wp.array[wp.int64],
    weights: wp.array[wp.vec3],
    towards: wp.array[wp.vec3],
    faces: wp.array2d[int],
    normals: wp.array[wp.vec3],
    albedo: wp.array[wp.vec3],
    roughness: wp.array[float],
    metallic: wp.array[float],
    open_share: wp.array[wp.vec3],
    light_from_world: wp.mat33,
    tables: wp.array[wp.vec3],
    factors: wp.array[wp.vec2],
    # outputs
    radiance: wp.array[wp.vec3],
):
    """What places send `towards` where a ray came from; they mirror the sky alone.

    Many arguments because a struct of them would be filled anew, array by array, for each launch.
    """
    i = first + wp.tid()
    radiance[i] = _sent(
        _corner(int(face[i]), faces), weights[i], towards[i], normals, albedo, roughness, metallic, open_share, 1.0, wp.vec3(0.0, 0.0, 0.0),
        light_from_world, tables, factors,
    )  # fmt: skip


@wp.func
def _drawn_half_vector(n: wp.vec3, roughness: float, seed: wp.uint32) -> wp.vec3:
    """From the GGX lobe, by two uniform numbers (Walter et al. 2007; docs/sources.md: walter2007)."""
    alpha = roughness * roughness
    u = unit_float(seed)
    cosine2 = (1.0 - u) / (1.0 + (alpha * alpha - 1.0) * u)
    sine = wp.sqrt(wp.max(1.0 - cosine2, 0.0))
    angle = 2.0 * wp.pi * unit_float(hash32(seed))
    # tangents_from_normal
    sign = wp.where(n[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    t_u = wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0])
    t_v = wp.vec3(b, sign + n[1] * n[1] * a, -n[1])
    return t_u * (sine * wp.cos(angle)) + t_v * (sine * wp.sin(angle)) + n * wp.sqrt(cosine2)


@cache
def mirrored_kernel(query: KernelQuery) -> Any:
    """The kernel that follows mirrored rays, for a kind of tracer."""
    closest_fn, handle_type = query.closest_fn, query.handle_type

    @wp.kernel(enable_backward=False, module="unique")
    def mirrored_light(
        first: int,
        tracer: handle_type,  # type: ignore[valid-type]  # known when the kernel is made
        seed: wp.uint32,
        mirrors: int,
        face: wp.array[wp.int64],
        weights: wp.array[wp.vec3],
        wo: wp.array[wp.vec3],
        faces: wp.array2d[int],
        vertices: wp.array[wp.vec3],
        face_normals: wp.array[wp.vec3],
        lift: float,
        clear: float,
        normals: wp.array[wp.vec3],
        albedo: wp.array[wp.vec3],
        roughness: wp.array[float],
        metallic: wp.array[float],
        open_share: wp.array[wp.vec3],
        light_from_world: wp.mat33,
        tables: wp.array[wp.vec3],
        factors: wp.array[wp.vec2],
        ground: wp.array2d[wp.vec4],
        ground_frame: wp.mat33,
        ground_middle: wp.vec3,
        # outputs
        transmittance: wp.array[float],
        met: wp.array[wp.vec3],
    ):
        """One thread a place. Rays that do not clear their face count as free.

        Long because its loops share what functions would have to hand on, array by array. Many arguments because a struct of them would be filled anew, array by array, for each launch.
        """
        i = first + wp.tid()
        here = int(face[i])
        weight = weights[i]
        towards = wo[i]
        stream = hash_combine(seed, wp.uint32(i))
        # What rays have met, one after the other: faces, weights and the directions that they came from, row by row.
        met_face = wp.vec3i(0, 0, 0)
        met_weight = wp.mat33()
        met_towards = wp.mat33()
        count = int(0)
        free = float(1.0)
        seen = wp.vec3(0.0, 0.0, 0.0)
        goes_on = bool(True)
        while goes_on:
            goes_on = False
            corner = _corner(here, faces)
            n = normal_at(vector_at(normals, corner, weight))
            half = _drawn_half_vector(n, number_at(roughness, corner, weight), hash_combine(stream, wp.uint32(count)))
            along = 2.0 * wp.dot(half, towards) * half - towards
            up = face_normals[here]
            if wp.dot(along, up) > clear:
                start = vector_at(vertices, corner, weight) + lift * up
                hit = closest_fn(tracer, start, along, wp.inf)
                if hit.face < 0:
                    below = ground_along(ground, ground_frame, ground_middle, start, along)
                    free = 1.0 - below[3]
                    seen = wp.vec3(below[0], below[1], below[2])
                else:
                    here = hit.face
                    weight = wp.vec3(1.0 - (hit.barycentric[0] + hit.barycentric[1]), hit.barycentric[0], hit.barycentric[1])
                    towards = -along
                    met_face[count] = here
                    for c in range(3):
                        met_weight[count, c] = weight[c]
                        met_towards[count, c] = towards[c]
                    count += 1
                    goes_on = count <= mirrors
        while count > 0:
            count -= 1
            seen = _sent(
                _corner(met_face[count], faces), wp.vec3(met_weight[count, 0], met_weight[count, 1], met_weight[count, 2]),
                wp.vec3(met_towards[count, 0], met_towards[count, 1], met_towards[count, 2]), normals, albedo, roughness, metallic, open_share,
                free, seen, light_from_world, tables, factors,
            )  # fmt: skip
            free = 0.0
        transmittance[i] = free
        met[i] = seen

    return mirrored_light


@cache
def arriving_kernel(query: KernelQuery) -> Any:
    """The kernel that finds what light some rays of each point bring, for a kind of tracer."""
    closest_fn, handle_type = query.closest_fn, query.handle_type

    @wp.kernel(enable_backward=False, module="unique")
    def arriving_light(
        first: int,
        tracer: handle_type,  # type: ignore[valid-type]  # known when the kernel is made
        samples: int,
        origin: wp.array[wp.vec3],
        up: wp.array[wp.vec3],
        direction: wp.array[wp.vec3],
        weight: wp.array[float],
        faces: wp.array2d[int],
        normals: wp.array[wp.vec3],
        albedo: wp.array[wp.vec3],
        roughness: wp.array[float],
        metallic: wp.array[float],
        open_share: wp.array[wp.vec3],
        light_from_world: wp.mat33,
        tables: wp.array[wp.vec3],
        factors: wp.array[wp.vec2],
        ground: wp.array2d[wp.vec4],
        ground_frame: wp.mat33,
        ground_middle: wp.vec3,
        # outputs
        transmittance: wp.array[float],
        radiance: wp.array[wp.vec3],
    ):
        """One thread a ray. What it meets mirrors the sky alone.

        Many arguments because a struct of them would be filled anew, array by array, for each launch.
        """
        i = first + wp.tid()
        point = i // samples
        along = direction[i]
        free = float(0.0)
        met = wp.vec3(0.0, 0.0, 0.0)
        if weight[i] > 0.0 and wp.dot(along, up[point]) > 0.0:
            hit = closest_fn(tracer, origin[point], along, wp.inf)
            if hit.face < 0:
                below = ground_along(ground, ground_frame, ground_middle, origin[point], along)
                free = 1.0 - below[3]
                met = wp.vec3(below[0], below[1], below[2])
            else:
                weights = wp.vec3(1.0 - (hit.barycentric[0] + hit.barycentric[1]), hit.barycentric[0], hit.barycentric[1])
                met = _sent(
                    _corner(hit.face, faces), weights, -along, normals, albedo, roughness, metallic, open_share, 1.0, wp.vec3(0.0, 0.0, 0.0), light_from_world,
                    tables, factors,
                )  # fmt: skip
        transmittance[i] = free
        radiance[i] = met

    return arriving_light
