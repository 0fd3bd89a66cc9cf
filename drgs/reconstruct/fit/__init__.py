"""Gradient descent against photographs. In: Views. Out: Gaussians, then a surface with materials, and an environment.

Begin with fit_loop.py, which runs all fits, then surfels/fit_gaussians.py (stage 1), surface/surface_passes.py (the mesh becomes the surface) and
surface/fit_mesh_materials.py (materials and light). light/ shades, evidence/ asks photographs about places of the mesh; surfels/ also has the
paper's ways: fit_mesh_surfels.py fits surfels on faces, fit_materials.py materials on surfels.
"""
