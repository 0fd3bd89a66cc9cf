"""Primary visibility of surfels: maps of what a camera sees. CPU: tiled SIMD through Warp's compiler; CUDA: plain Warp."""

from drgs.render.visible.rasterize.gbuffer import face_camera, facing_normals, rasterize_gbuffer
from drgs.render.visible.rasterize.rasterize import PUBLISHED_FILTER_SIGMA, RasterMaps, RasterSettings, rasterize

__all__ = ["PUBLISHED_FILTER_SIGMA", "RasterMaps", "RasterSettings", "face_camera", "facing_normals", "rasterize", "rasterize_gbuffer"]
