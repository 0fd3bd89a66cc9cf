"""An animation of another program moves an object. In: a glTF or FBX file, an asset and how they are bound. Out: ClipFrames (drgs/deform/clip.py).

Begin with rig_clip.py: skeleton.py says where the rig's own meshes are at a time, proxy.py what of the object follows them.
"""
