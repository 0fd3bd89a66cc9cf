"""Frames that get better. In: a scene, a camera, settings, and the frame before. Out: a FrameState (frame_state.py) with running sums.

Begin with start_frame.py (with invalidate.py: what the frame before still gives, reproject.py: what it says of a moved camera, and
kept_light/: diffuse light that stays on the mesh meanwhile), then refine.py; mean_radiance.py reads the sums, converge.py says where rays still go.
"""
