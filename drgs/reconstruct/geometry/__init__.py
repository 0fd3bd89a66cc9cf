"""The mesh of an asset. In: depth and normals of the fitted Gaussians. Out: a closed mesh, surfels bound to it, materials on its vertices.

Begin with extract_mesh/; mesh_surfels.py, bind_gaussians.py and bake_materials.py work on what it makes.
"""
