"""What is moved takes the rest along. In: moved vertices or particles. Out: deformation gradients, and where surfels and other points go.

Begin with carry_gaussians.py (surfels under a deformation gradient), then drive_mesh.py (a mesh and what is bound to it) and gmls.py (particles and
what is near them). surface_gradients.py is for a mesh that moves again and again.
"""
