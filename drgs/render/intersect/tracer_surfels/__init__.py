"""Rays against surfels (the paper's 2DGRT): ordered blended radiance, and its gradient.

In: a SurfelScene and rays. Out: radiance, opacity and depth of what the rays meet. It does not know
cameras, meshes or materials. Source: DR-GS section 3.2 and IRGS (Gu et al. 2025) for tracing 2D Gaussians; Moenne-Loccoz et
al. 2024 for the k-buffer (docs/sources.md). Unlike those: no proxy triangles, order by the surfel's own t with ties by index.
"""

from drgs.render.intersect.tracer_surfels.surfel_scene import SurfelScene, build_surfel_scene
from drgs.render.intersect.tracer_surfels.tracer_surfels import trace_surfel_radiance

__all__ = ["SurfelScene", "build_surfel_scene", "trace_surfel_radiance"]
