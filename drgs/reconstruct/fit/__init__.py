"""Gradient descent against photographs. In: Views. Out: Gaussians, then materials and an environment.

Begin with fit_loop.py, which runs all fits, then fit_gaussians.py (surfels), surface_passes.py (the mesh becomes the surface) and
fit_mesh_materials.py (materials and light); fit_mesh_surfels.py fits surfels on faces, fit_materials.py materials on surfels, as in the paper.
"""
