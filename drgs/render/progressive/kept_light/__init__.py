"""Diffuse light that stays on a mesh while the camera moves. In: the points of a moving picture, and what is kept of the pictures before.
Out: their light, with diffuse rays traced only where what is kept is not good enough, and more of it for the next picture.

Begin with kept_light.py (what is kept), then shade_moving.py, which reads like the way: read_light.py, lend_specular.py, gather_light.py.
"""
