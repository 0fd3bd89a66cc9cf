"""From depth maps to a closed triangle mesh: fuse into a truncated signed distance field, march, clean, simplify.

In: depth, coverage and optionally normals of posed views, and a box. Out: vertices and faces, wound outward. It does not
know Gaussians, materials or files. Source: Curless and Levoy 1996 (fusion), Lewiner et al. 2003 (marching cubes),
Taubin 1995 (smoothing), Garland and Heckbert 1997 (simplification); docs/sources.md.
"""

from drgs.reconstruct.geometry.extract_mesh.clean_mesh import MeshReport, clean_mesh, mesh_report
from drgs.reconstruct.geometry.extract_mesh.extract_mesh import extract_mesh
from drgs.reconstruct.geometry.extract_mesh.fuse_depth import DistanceField, fuse_depth
from drgs.reconstruct.geometry.extract_mesh.records import FAST_MESH, FULL_MESH, DepthMap, MeshSettings

__all__ = [
    "FAST_MESH",
    "FULL_MESH",
    "DepthMap",
    "DistanceField",
    "MeshReport",
    "MeshSettings",
    "clean_mesh",
    "extract_mesh",
    "fuse_depth",
    "mesh_report",
]
