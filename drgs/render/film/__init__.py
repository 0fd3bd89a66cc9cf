"""From sums to a picture. In: the mean radiance and G-buffer of a frame. Out: a denoised, tone-mapped Frame.

Begin with resolve_frame.py; it calls denoise/ and tonemap.py.
"""
