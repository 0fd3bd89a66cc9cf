"""Primary visibility of surfels: maps of what a camera sees. CPU: tiled SIMD through Warp's compiler; CUDA: plain Warp."""

from drgs.render.rasterize_gbuffer.gbuffer import face_camera, facing_normals, rasterize_gbuffer
from drgs.render.rasterize_gbuffer.rasterize import RasterMaps, RasterSettings, rasterize

__all__ = ["RasterMaps", "RasterSettings", "face_camera", "facing_normals", "rasterize", "rasterize_gbuffer"]
