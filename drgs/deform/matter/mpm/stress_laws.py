"""Constitutive laws: what deformation gradients are let through, and the Kirchhoff stress they cause.

Each law maps a trial F_e and one plastic number to those after plastic flow, and to tau. Singular values are taken only by laws that
need them: fixed corotated elasticity wants just the rotation, and Newton's iteration gives it in a tenth of the time.
Sources: docs/sources.md (stomakhin2012, klar2016, stomakhin2013). Twin: drgs/reference/mpm.py.
"""

import warp as wp

from drgs.deform.matter.mpm.records import LAWS, SNOW_STIFFENING

wp.set_module_options({"enable_backward": False})

FIXED_COROTATED = wp.constant(LAWS.index("fixed_corotated"))
NEO_HOOKEAN = wp.constant(LAWS.index("neo_hookean"))
VON_MISES = wp.constant(LAWS.index("von_mises"))
DRUCKER_PRAGER = wp.constant(LAWS.index("drucker_prager"))
FLUID = wp.constant(LAWS.index("fluid"))
SNOW = wp.constant(LAWS.index("snow"))

LEAST_STRETCH = wp.constant(0.05)
MOST_STRETCH = wp.constant(20.0)
"""Singular values are kept within these before a logarithm is taken."""
LEAST_VOLUME = wp.constant(0.05)
"""J of neo-Hookean matter is kept above this."""
FLUID_LEAST_VOLUME = wp.constant(0.2)
FLUID_MOST_VOLUME = wp.constant(1.1)
"""J of fluid is kept within these: it cavitates instead of being stretched."""
SNOW_HARDENING = wp.constant(10.0)
SNOW_LEAST_FACTOR = wp.constant(0.1)
SNOW_MOST_FACTOR = wp.constant(SNOW_STIFFENING)
NEWTON_LIMIT = wp.constant(0.02)
"""Below this J the rotation comes from singular values, for there Newton's iteration takes long, or finds a reflection."""


@wp.func
def cofactor(m: wp.mat33):
    return wp.mat33(
        m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1], m[1, 2] * m[2, 0] - m[1, 0] * m[2, 2], m[1, 0] * m[2, 1] - m[1, 1] * m[2, 0],
        m[2, 1] * m[0, 2] - m[2, 2] * m[0, 1], m[2, 2] * m[0, 0] - m[2, 0] * m[0, 2], m[2, 0] * m[0, 1] - m[2, 1] * m[0, 0],
        m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1], m[0, 2] * m[1, 0] - m[0, 0] * m[1, 2], m[0, 0] * m[1, 1] - m[0, 1] * m[1, 0],
    )  # fmt: skip


@wp.func
def newton_rotation(f: wp.mat33):
    """The polar factor of F with J well above 0, and whether the iteration settled."""
    r = f
    settled = wp.bool(False)
    step = wp.int32(0)
    while step < 12 and not settled:
        # R <- (R + R^-T) / 2 converges quadratically.
        change = 0.5 * (cofactor(r) / wp.determinant(r) - r)
        r = r + change
        settled = wp.ddot(change, change) < 1.0e-8
        step += 1
    return r, settled


@wp.func
def logarithm(s: wp.vec3):
    return wp.vec3(
        wp.log(wp.clamp(s[0], LEAST_STRETCH, MOST_STRETCH)),
        wp.log(wp.clamp(s[1], LEAST_STRETCH, MOST_STRETCH)),
        wp.log(wp.clamp(s[2], LEAST_STRETCH, MOST_STRETCH)),
    )


@wp.func
def recompose(u: wp.mat33, s: wp.vec3, v: wp.mat33):
    return u * wp.diag(s) * wp.transpose(v)


@wp.func
def hencky_stress(u: wp.mat33, e: wp.vec3, mu: float, lam: float):
    trace = e[0] + e[1] + e[2]
    t = 2.0 * mu * e + wp.vec3(lam * trace, lam * trace, lam * trace)
    return recompose(u, t, u)


@wp.func
def exponential(e: wp.vec3):
    return wp.vec3(wp.exp(e[0]), wp.exp(e[1]), wp.exp(e[2]))


@wp.func
def von_mises(f: wp.mat33, u: wp.mat33, s: wp.vec3, v: wp.mat33, plastic: float, parameters: wp.vec4):
    mu = parameters[0]
    lam = parameters[1]
    e = logarithm(s)
    mean = (e[0] + e[1] + e[2]) / 3.0
    dev = e - wp.vec3(mean, mean, mean)
    size = wp.max(wp.length(dev), 1.0e-10)
    strength = wp.sqrt(2.0 / 3.0) * (parameters[2] + plastic)
    excess = size - strength / (2.0 * mu)
    grown = plastic
    elastic = f
    if excess > 0.0:
        # Hardening takes its share of the step, so that the stress ends on the grown surface.
        excess = excess / (1.0 + wp.sqrt(2.0 / 3.0) * parameters[3])
        grown = plastic + 2.0 * mu * parameters[3] * excess
        e = e - (excess / size) * dev
        elastic = recompose(u, exponential(e), v)
    return elastic, grown, hencky_stress(u, e, mu, lam)


@wp.func
def drucker_prager(u: wp.mat33, s: wp.vec3, v: wp.mat33, plastic: float, parameters: wp.vec4):
    mu = parameters[0]
    lam = parameters[1]
    before = logarithm(s)
    # Volume gained while it flew apart is taken back first; else sand would swell for good.
    e = before + wp.vec3(plastic, plastic, plastic) / 3.0
    trace = e[0] + e[1] + e[2]
    if trace >= 0.0:
        e = wp.vec3(0.0, 0.0, 0.0)
    else:
        dev = e - wp.vec3(trace, trace, trace) / 3.0
        size = wp.max(wp.length(dev), 1.0e-10)
        excess = size + (3.0 * lam + 2.0 * mu) / (2.0 * mu) * trace * parameters[2]
        if excess > 0.0:
            e = e - (excess / size) * dev
    gained = plastic + (before[0] + before[1] + before[2]) - (e[0] + e[1] + e[2])
    return recompose(u, exponential(e), v), gained, hencky_stress(u, e, mu, lam)


@wp.func
def snow(u: wp.mat33, s: wp.vec3, v: wp.mat33, plastic: float, parameters: wp.vec4):
    low = 1.0 - parameters[2]
    high = 1.0 + parameters[3]
    c = wp.vec3(wp.clamp(s[0], low, high), wp.clamp(s[1], low, high), wp.clamp(s[2], low, high))
    volume = wp.clamp(plastic * (s[0] * s[1] * s[2]) / (c[0] * c[1] * c[2]), 0.05, 20.0)
    factor = wp.clamp(wp.exp(SNOW_HARDENING * (1.0 - volume)), SNOW_LEAST_FACTOR, SNOW_MOST_FACTOR)
    j = c[0] * c[1] * c[2]
    push = factor * parameters[1] * j * (j - 1.0)
    pull = 2.0 * factor * parameters[0]
    t = wp.vec3(pull * (c[0] - 1.0) * c[0] + push, pull * (c[1] - 1.0) * c[1] + push, pull * (c[2] - 1.0) * c[2] + push)
    return recompose(u, c, v), volume, recompose(u, t, u)


@wp.func
def fluid(plastic: float, affine: wp.mat33, dt: float, parameters: wp.vec4):
    trace = wp.trace(affine)
    j = wp.clamp(plastic * (1.0 + dt * trace), FLUID_LEAST_VOLUME, FLUID_MOST_VOLUME)
    pressure = parameters[1] * (wp.pow(j, -parameters[2]) - 1.0)
    eta = parameters[0]
    push = -j * pressure - (2.0 / 3.0) * j * eta * trace
    side = wp.pow(j, 1.0 / 3.0)
    one = wp.identity(n=3, dtype=float)
    return side * one, j, push * one + (j * eta) * (affine + wp.transpose(affine))


@wp.func
def fixed_corotated(f: wp.mat33, r: wp.mat33, parameters: wp.vec4):
    j = wp.determinant(f)
    tau = 2.0 * parameters[0] * ((f - r) * wp.transpose(f))
    tau = 0.5 * (tau + wp.transpose(tau))
    return tau + parameters[1] * j * (j - 1.0) * wp.identity(n=3, dtype=float)


@wp.func
def neo_hookean(f: wp.mat33, parameters: wp.vec4):
    one = wp.identity(n=3, dtype=float)
    j = wp.max(wp.determinant(f), LEAST_VOLUME)
    return parameters[0] * (f * wp.transpose(f) - one) + parameters[1] * wp.log(j) * one


@wp.func
def respond(law: int, trial: wp.mat33, plastic: float, affine: wp.mat33, dt: float, parameters: wp.vec4):
    """F_e, plastic number and Kirchhoff stress after a step that would have led to F_e = trial."""
    elastic = trial
    after = plastic
    tau = wp.mat33()
    r = trial
    settled = wp.bool(False)
    if law == FIXED_COROTATED and wp.determinant(trial) > NEWTON_LIMIT:
        r, settled = newton_rotation(trial)
    # One decomposition in the code for all who need it: it is most of what has to be compiled.
    u = wp.mat33()
    s = wp.vec3()
    v = wp.mat33()
    if law == VON_MISES or law == DRUCKER_PRAGER or law == SNOW or (law == FIXED_COROTATED and not settled):  # noqa: SIM109
        u, s, v = wp.svd3(trial)
    if law == FIXED_COROTATED:
        if not settled:
            r = u * wp.transpose(v)
        tau = fixed_corotated(trial, r, parameters)
    elif law == NEO_HOOKEAN:
        tau = neo_hookean(trial, parameters)
    elif law == VON_MISES:
        elastic, after, tau = von_mises(trial, u, s, v, plastic, parameters)
    elif law == DRUCKER_PRAGER:
        elastic, after, tau = drucker_prager(u, s, v, plastic, parameters)
    elif law == FLUID:
        elastic, after, tau = fluid(plastic, affine, dt, parameters)
    else:
        elastic, after, tau = snow(u, s, v, plastic, parameters)
    return elastic, after, tau
