"""What the camera sees. In: a posed scene and a camera. Out: a G-buffer, and the points on the mesh that rays leave from.

Begin with rasterize/ for Gaussians or trace_primary.py for meshes; lift_points.py then brings splatted points onto the mesh.
"""
