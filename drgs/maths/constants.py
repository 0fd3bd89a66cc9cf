"""Numbers on which several files must agree. Each is written here, and nowhere else (tests/maths/test_constants.py looks for copies).

Plain Python, so that the server can read them without torch. Warp kernels use them as they are: a float of the kernel's module is a
float32 constant there. Native C++ snippets get them through `native_source`, the viewer through `web/src/session/constants.gen.ts`.
"""

# How surfaces reflect light (drgs/maths/brdf.py).
F0 = 0.04
"""Reflectance of a dielectric at normal incidence: a refractive index of 1.5, as in glTF, three.js and Blender's default."""
MIN_ROUGHNESS = 0.03
"""Below this the GGX lobe is narrower than a texel of a 2k environment, and float32 loses the peak of D."""

# Colour (drgs/maths/color.py).
LUMINANCE_RED = 0.2126
"""Share of linear Rec.709 red in luminance (ITU-R BT.709); the three sum to 1."""
LUMINANCE_GREEN = 0.7152
LUMINANCE_BLUE = 0.0722
SRGB_SLOPE = 12.92
"""sRGB's straight part near black (IEC 61966-2-1) ..."""
SRGB_LINEAR_END = 0.0031308
"""... which ends at this linear value ..."""
SRGB_ENCODED_END = 0.04045
"""... and at this encoded one; the power curve beyond is SRGB_SCALE * linear^(1 / SRGB_GAMMA) - SRGB_OFFSET."""
SRGB_SCALE = 1.055
SRGB_OFFSET = 0.055
SRGB_GAMMA = 2.4

MIDDLE_GREY = 0.18
"""Linear reflectance of a grey card: what thumbnails are exposed for, and their ground."""

STILL_BOUNCES = 4
"""Indirect bounces of pictures that are waited for (drgs render, drgs eval, stills and render jobs); live frames have one."""

# How surfels cover what lies behind them (drgs/render/visible/rasterize, drgs/render/intersect/tracer_surfels).
MIN_ALPHA = 1.0 / 255.0
"""Opacity below which a surfel counts as absent: the least that an 8-bit picture can show."""
MAX_ALPHA = 0.99
"""Opacity is capped here: 1 / (1 - alpha) in the gradient stays bounded."""
MIN_TRANSMITTANCE = 1e-4
"""Blending ends when less than this is left: what follows could change a picture by at most this share."""
MIN_COVERAGE = 1.0 / 255.0
"""Pixels covered by no more than this show no surface and get no light: they could not change an 8-bit picture."""

# Rays that meet nothing (drgs/render/intersect), and other searches of a mesh.
UNBOUNDED = 1e30
"""Stands for an endless distance [world units]: beyond any scene, and finite, so that 0 times it is 0."""
VOID_ORIGIN = 1e15
"""Coordinates of the origin of a ray that must meet nothing [world units]: far outside, so it misses at the root of the tree ..."""
VOID_BEYOND = 1e14
"""... and a ray from beyond this need not be traced at all. Meshes end well before (trace_rays.EXTENTS and MAX_OFFSET)."""
