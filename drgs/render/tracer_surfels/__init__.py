"""Rays against surfels (the paper's 2DGRT): order-free visibility, ordered blended radiance, and its gradient.

In: a SurfelScene and rays. Out: transmittance, or radiance, opacity and depth of what the rays meet. It does not know
cameras, meshes or materials. Source: DR-GS section 3.2 and IRGS (Gu et al. 2025) for tracing 2D Gaussians; Moenne-Loccoz et
al. 2024 for the k-buffer (docs/sources.md). Unlike those: no proxy triangles, order by the surfel's own t with ties by index.
"""

from drgs.render.tracer_surfels.surfel_scene import SurfelScene, build_surfel_scene, with_radiance
from drgs.render.tracer_surfels.tracer_surfels import trace_surfel_radiance, trace_surfel_visibility

__all__ = ["SurfelScene", "build_surfel_scene", "trace_surfel_radiance", "trace_surfel_visibility", "with_radiance"]
