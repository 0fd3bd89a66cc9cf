"""Gradient descent against photographs. In: Views. Out: Gaussians, then materials and an environment.

Begin with fit_loop.py, which runs all fits, then fit_gaussians.py (stage 1) and fit_materials.py (stage 2); fit_mesh_surfels.py fits surfels
that are bound to a mesh.
"""
