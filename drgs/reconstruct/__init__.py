"""From photographs to an asset. build_asset.py reads like the method; stages.py makes each part go on after an interruption.

pose/ (where plain photographs were taken from) and capture/ (read the posed ones) → fit/ (Gaussians, then materials and light) → geometry/ (the mesh, and what is bound to it).
"""
