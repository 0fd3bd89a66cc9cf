"""What moves an object. In: an asset and edits. Out: a PosedScene, which is all that rendering sees.

Begin with pose_scene.py, which applies edits in their order (sort_edits.py; keep_pose.py has what a long list of them has made). displace/ (what a
deform edit says), rig/ (an animation of another program) and matter/ (simulated) say where things go → carry/ takes the mesh's vertices and the
Gaussians there. clip.py is what rig/ and matter/ give, frame by frame, and how it is stored.
"""
