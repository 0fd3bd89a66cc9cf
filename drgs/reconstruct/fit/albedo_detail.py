"""Albedo as fine as the photographs show it: solved for each vertex from all views at once, and put into what stage 2 found.

Stage 2 looks at a few thousand points a step, so it decides what is large and leaves fine patterns blurred. Under its light, and with its
normals, roughness and metallic, split sum's radiance is linear in a vertex's albedo a, channel by channel: L = B + a A. So least squares over
all photographs that show the vertex has a closed form,

    a = (sum w A (photo - B) + hold a0 W) / (sum w A^2 + hold W)        w = cos^2 / (photo + DARK)^2

with a0 of stage 2 and W the median of sum w A^2. What of log(a / a0) varies slowly is left out: it is split sum's error against traced light, or a
light that was not the same in all photographs, and stage 2 knows better. Before, faces are divided until their edges are as long as a pixel or so.

In: the mesh through its tracer, photographs, light. Out: albedo. Source: ratio images' use for texture is old (Debevec et al. 1998 after Marschner
and Greenberg 1997); the linear form is the split sum's own.
"""

LEAST, MOST = 0.005, 0.995
"""Albedo, as logits_of_shares keeps it."""
MOST_RATIO = 4.0
"""By which a vertex may differ from stage 2: beyond, it was seen wrongly."""
