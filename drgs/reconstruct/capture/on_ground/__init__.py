"""Where an object is that stands on something flat, from the cameras, the pictures and the capture's sparse points.

Begin with stands_on_ground.py; ground_plane.py and ground_picture.py serve it.
"""
