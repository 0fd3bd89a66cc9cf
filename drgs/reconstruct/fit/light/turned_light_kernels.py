"""Kernels of turned_light.py: what is hidden of the sky and what is met instead, and the share that arrives where the surface faces as it is fitted."""

import warp as wp

from drgs.reconstruct.fit.light.split_sum_kernels import looked_up, lookup_gradient

wp.set_module_options({"enable_backward": False})

SUM_ROWS = 48
"""Of the table of what the open sky sends about a normal, summed over the same directions as what is hidden of it."""
_SUM_ROWS = wp.constant(SUM_ROWS)
_DARK = wp.constant(1.0e-6)
"""Such a sum of which no share is taken."""


@wp.kernel
def direct_kernel(
    first: int,
    first_met: wp.array[int],
    met_direction: wp.array[wp.int16],
    met_cosine: wp.array[float],
    radiance: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    sums: wp.array[wp.vec3],
    # outputs
    direct: wp.array[wp.vec3],
):
    """What arrives from the sky where the surface faces as its faces do: all of it, less what is hidden."""
    i = first + wp.tid()
    hidden = wp.vec3(0.0, 0.0, 0.0)
    for k in range(first_met[i], first_met[i + 1]):
        hidden += met_cosine[k] * radiance[int(met_direction[k])]
    direct[i] = wp.max(looked_up(normals[i], 0, _SUM_ROWS, sums) - hidden, wp.vec3(0.0, 0.0, 0.0))


@wp.kernel
def bounce_kernel(
    first: int,
    first_met: wp.array[int],
    met_cosine: wp.array[float],
    sender: wp.array[int],
    sent: wp.array[wp.vec3],
    # outputs
    sent_back: wp.array[wp.vec3],
):
    """What arrives from what is met."""
    i = first + wp.tid()
    found = wp.vec3(0.0, 0.0, 0.0)
    for k in range(first_met[i], first_met[i + 1]):
        found += met_cosine[k] * sent[sender[k]]
    sent_back[i] = found


@wp.kernel
def share_kernel(
    first: int,
    first_met: wp.array[int],
    met_direction: wp.array[wp.int16],
    directions: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
    sent_back: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    sums: wp.array[wp.vec3],
    most: float,
    # outputs
    share: wp.array[wp.vec3],
    hidden: wp.array[wp.vec3],
):
    """Many arguments because a struct of them would be filled anew, array by array, for each launch."""
    i = first + wp.tid()
    value = wp.vec3(1.0, 1.0, 1.0)
    behind = wp.vec3(0.0, 0.0, 0.0)
    if first_met[i + 1] > first_met[i]:
        normal = normals[i]
        sky = looked_up(normal, 0, _SUM_ROWS, sums)
        for k in range(first_met[i], first_met[i + 1]):
            d = int(met_direction[k])
            behind += wp.max(wp.dot(normal, directions[d]), 0.0) * radiance[d]
        for c in range(3):
            arriving = wp.max(sky[c] - behind[c], 0.0) + sent_back[i][c]
            value[c] = wp.clamp(arriving / wp.max(sky[c], _DARK), 0.0, most)
    share[i] = value
    hidden[i] = behind


@wp.kernel
def share_adjoint(
    first: int,
    first_met: wp.array[int],
    met_direction: wp.array[wp.int16],
    directions: wp.array[wp.vec3],
    radiance: wp.array[wp.vec3],
    sent_back: wp.array[wp.vec3],
    normals: wp.array[wp.vec3],
    sums: wp.array[wp.vec3],
    most: float,
    hidden: wp.array[wp.vec3],
    share_gradient: wp.array[wp.vec3],
    # outputs
    normal_gradient: wp.array[wp.vec3],
    radiance_gradients: wp.array[wp.vec3],
    sum_gradients: wp.array[wp.vec3],
):
    """Many arguments because a struct of them would be filled anew, array by array, for each launch."""
    i = first + wp.tid()
    g = share_gradient[i]
    slope = wp.vec3(0.0, 0.0, 0.0)
    if wp.dot(g, g) > 0.0 and first_met[i + 1] > first_met[i]:  # of what no photograph shows there is no slope
        normal = normals[i]
        sky = looked_up(normal, 0, _SUM_ROWS, sums)
        g_sky = wp.vec3(0.0, 0.0, 0.0)
        g_hidden = wp.vec3(0.0, 0.0, 0.0)
        for c in range(3):
            left = wp.max(sky[c] - hidden[i][c], 0.0)
            value = (left + sent_back[i][c]) / wp.max(sky[c], _DARK)
            if value <= most and sky[c] > _DARK:
                g_arriving = g[c] / sky[c]
                g_left = wp.where(left > 0.0, g_arriving, 0.0)
                g_sky[c] = g_left - g_arriving * value
                g_hidden[c] = -g_left
        for k in range(first_met[i], first_met[i + 1]):
            d = int(met_direction[k])
            cosine = wp.dot(normal, directions[d])
            if cosine > 0.0:
                slope += wp.dot(g_hidden, radiance[d]) * directions[d]
                wp.atomic_add(radiance_gradients, d, cosine * g_hidden)
        slope += lookup_gradient(g_sky, normal, 0, _SUM_ROWS, sums, sum_gradients)
    normal_gradient[i] = slope
