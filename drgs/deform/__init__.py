"""What moves an object. In: an asset and edits. Out: a PosedScene, which is all that rendering sees.

Begin with pose_scene.py, which applies edits in order. maps, arap, skeleton and mpm/ (through simulate.py) say where things go; drive_mesh
and carry_gaussians take the mesh's vertices and the Gaussians there.
"""
