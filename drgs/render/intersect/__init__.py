"""What a ray meets. In: rays, and a mesh or surfels. Out: first hits, visibility, or blended radiance; no shading.

Begin with tracer.py, the interface; tracer_embree.py and tracer_warp.py trace meshes, tracer_surfels/ traces Gaussians.
"""
