"""A ray's way from the camera to the picture; render_frame.py walks it, records.py holds what passes between its parts.

visible/ (what the camera sees) → intersect/ (what a ray meets) → integrate/ (what a point sends back) → progressive/ (frames that get
better) → film/ (from sums to a picture).
"""
