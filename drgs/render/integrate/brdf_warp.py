"""The BRDF and its samplers for kernels: the Warp restatement of drgs/maths/brdf.py and sampling.py (see there for sources)."""

import math

import warp as wp

from drgs.maths.constants import F0, MIN_ROUGHNESS

PI = wp.constant(math.pi)


@wp.func
def tangent_of(n: wp.vec3) -> wp.vec3:
    sign = wp.where(n[2] >= 0.0, 1.0, -1.0)
    a = -1.0 / (sign + n[2])
    return wp.vec3(1.0 + sign * n[0] * n[0] * a, sign * n[0] * n[1] * a, -sign * n[0])


@wp.func
def alpha_of(roughness: float) -> float:
    r = wp.max(roughness, MIN_ROUGHNESS)
    return r * r


@wp.func
def ggx_d(n_dot_h: float, sin2_nh: float, alpha: float) -> float:
    a2 = alpha * alpha
    denominator = sin2_nh + n_dot_h * n_dot_h * a2
    return a2 / wp.max(PI * denominator * denominator, 1.0e-30)


@wp.func
def smith_v(n_dot_l: float, n_dot_v: float, alpha: float) -> float:
    a2 = alpha * alpha
    lambda_v = n_dot_l * wp.sqrt(n_dot_v * n_dot_v * (1.0 - a2) + a2)
    lambda_l = n_dot_v * wp.sqrt(n_dot_l * n_dot_l * (1.0 - a2) + a2)
    return 0.5 / wp.max(lambda_v + lambda_l, 1.0e-12)


@wp.func
def specular_brdf(wi: wp.vec3, wo: wp.vec3, n: wp.vec3, alpha: float, albedo: wp.vec3, metallic: float) -> wp.vec3:
    """D V F; both directions above the horizon of n."""
    h = wp.normalize(wi + wo)
    n_dot_h = wp.clamp(wp.dot(n, h), 0.0, 1.0)
    n_dot_l = wp.max(wp.dot(n, wi), 1.0e-6)
    n_dot_v = wp.max(wp.dot(n, wo), 1.0e-6)
    dv = ggx_d(n_dot_h, wp.length_sq(wp.cross(n, h)), alpha) * smith_v(n_dot_l, n_dot_v, alpha)
    c = 1.0 - wp.clamp(wp.dot(h, wo), 0.0, 1.0)
    c5 = c * c * c * c * c
    base = F0 * (1.0 - metallic)
    f0 = wp.vec3(base + albedo[0] * metallic, base + albedo[1] * metallic, base + albedo[2] * metallic)
    return dv * (f0 * (1.0 - c5) + wp.vec3(c5, c5, c5))


@wp.func
def cosine_direction(u: wp.vec2, n: wp.vec3) -> wp.vec3:
    radius = wp.sqrt(u[0])
    azimuth = 2.0 * PI * u[1]
    t = tangent_of(n)
    b = wp.cross(n, t)
    return wp.normalize(radius * wp.cos(azimuth) * t + radius * wp.sin(azimuth) * b + wp.sqrt(wp.max(1.0 - u[0], 0.0)) * n)


@wp.func
def vndf_bound(wo_z: float, alpha: float) -> float:
    s = 1.0 + wp.sqrt(wp.max(1.0 - wo_z * wo_z, 0.0))
    return (1.0 - alpha * alpha) * s * s / (s * s + alpha * alpha * wo_z * wo_z)


@wp.func
def ggx_direction(u: wp.vec2, wo: wp.vec3, n: wp.vec3, alpha: float) -> wp.vec3:
    """World wi; may lie below the horizon (void)."""
    t = tangent_of(n)
    b = wp.cross(n, t)
    wo_z = wp.dot(n, wo)
    stretched = wp.normalize(wp.vec3(alpha * wp.dot(t, wo), alpha * wp.dot(b, wo), wo_z))
    bound = vndf_bound(wo_z, alpha) * stretched[2]
    z = 1.0 - u[0] * (1.0 + bound)
    radius = wp.sqrt(wp.max(1.0 - z * z, 0.0))
    azimuth = 2.0 * PI * u[1]
    cap = wp.vec3(radius * wp.cos(azimuth), radius * wp.sin(azimuth), z) + stretched
    h_local = wp.normalize(wp.vec3(alpha * cap[0], alpha * cap[1], cap[2]))
    h = h_local[0] * t + h_local[1] * b + h_local[2] * n
    return wp.normalize(2.0 * wp.dot(wo, h) * h - wo)


@wp.func
def ggx_pdf(wi: wp.vec3, wo: wp.vec3, n: wp.vec3, alpha: float) -> float:
    h = wp.normalize(wi + wo)
    wo_z = wp.dot(n, wo)
    n_dot_h = wp.dot(n, h)
    if wo_z <= 0.0 or n_dot_h <= 0.0:
        return 0.0
    stretch = wp.sqrt(alpha * alpha * wp.max(1.0 - wo_z * wo_z, 0.0) + wo_z * wo_z)
    return ggx_d(n_dot_h, wp.length_sq(wp.cross(n, h)), alpha) / (2.0 * (vndf_bound(wo_z, alpha) * wo_z + stretch))
