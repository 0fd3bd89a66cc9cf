"""Kernels of mesh_light.py: where mirrored rays go, and what a ray sees where it meets the mesh; without gradient."""

from functools import cache
from typing import Any

import warp as wp
from torch import Tensor

from drgs.maths.constants import F0
from drgs.reconstruct.fit.light.split_sum_kernels import radiance_of_point
from drgs.render.intersect.tracer import KernelQuery

wp.set_module_options({"enable_backward": False})

_F0 = wp.constant(float(F0))


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
def _corner(face: wp.int64, faces: wp.array2d[int]) -> wp.vec3i:
    k = int(face)
    return wp.vec3i(faces[k, 0], faces[k, 1], faces[k, 2])


@wp.kernel
def mirrored_kernel(
    first: int,
    face: wp.array[wp.int64],
    weights: wp.array[wp.vec3],
    wo: wp.array[wp.vec3],
    drawn: wp.array2d[float],
    faces: wp.array2d[int],
    vertices: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    roughness: wp.array[float],
    face_normals: wp.array[wp.vec3],
    lift: float,
    clear: float,
    # outputs
    origin: wp.array[wp.vec3],
    direction: wp.array[wp.vec3],
    above: wp.array[wp.bool],
):
    """wo mirrored at a half vector that two uniform numbers draw from the GGX lobe (Walter et al. 2007; docs/sources.md: walter2007), and whether
    that leaves the face; the normal where it does not.

    Many arguments because a struct of them would be filled anew, array by array, for each launch.
    """
    i = first + wp.tid()
    corner = _corner(face[i], faces)
    weight = weights[i]
    n = normal_at(vector_at(normals, corner, weight))
    r = number_at(roughness, corner, weight)
    alpha = r * r
    u = drawn[0, i]
    cosine2 = (1.0 - u) / (1.0 + (alpha * alpha - 1.0) * u)
    sine = wp.sqrt(wp.max(1.0 - cosine2, 0.0))
    azimuth = 2.0 * wp.pi * drawn[1, i]
    # tangents_from_normal
    sign = wp.where(n[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + n[2])
    b = n[0] * n[1] * a
    t_u = wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * b, -sign * n[0])
    t_v = wp.vec3(b, sign + n[1] * n[1] * a, -n[1])
    half = t_u * (sine * wp.cos(azimuth)) + t_v * (sine * wp.sin(azimuth)) + n * wp.sqrt(cosine2)
    mirrored = 2.0 * wp.dot(half, wo[i]) * half - wo[i]
    up = face_normals[int(face[i])]
    leaves = wp.dot(mirrored, up) > clear
    origin[i] = vector_at(vertices, corner, weight) + lift * up
    direction[i] = wp.where(leaves, mirrored, up)
    above[i] = leaves


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
    transmittance: wp.array[float],
    met: wp.array[wp.vec3],
    mirrors: int,
    light_from_world: wp.mat33,
    tables: wp.array[wp.vec3],
    factors: wp.array[wp.vec2],
    # outputs
    radiance: wp.array[wp.vec3],
):
    """What places send `towards` where a ray came from, at least 0; without `mirrors` they mirror the sky alone.

    Many arguments because a struct of them would be filled anew, array by array, for each launch.
    """
    i = first + wp.tid()
    open_sky = float(1.0)
    seen = wp.vec3(0.0, 0.0, 0.0)
    if mirrors != 0:
        open_sky = transmittance[i]
        seen = met[i]
    radiance[i] = _sent(
        _corner(face[i], faces), weights[i], towards[i], normals, albedo, roughness, metallic, open_share, open_sky, seen, light_from_world,
        tables, factors,
    )  # fmt: skip


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
                free = 1.0
            else:
                corner = wp.vec3i(faces[hit.face, 0], faces[hit.face, 1], faces[hit.face, 2])
                weights = wp.vec3(1.0 - (hit.barycentric[0] + hit.barycentric[1]), hit.barycentric[0], hit.barycentric[1])
                met = _sent(
                    corner, weights, -along, normals, albedo, roughness, metallic, open_share, 1.0, wp.vec3(0.0, 0.0, 0.0), light_from_world,
                    tables, factors,
                )  # fmt: skip
        transmittance[i] = free
        radiance[i] = met

    return arriving_light
