"""From photographs to an asset. build_asset.py reads like the method; stages.py makes each part go on after an interruption.

capture/ (read the photographs) → fit/ (Gaussians, then materials and light) → geometry/ (the mesh, and what is bound to it).
"""
