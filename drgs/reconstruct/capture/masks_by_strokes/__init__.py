"""Masks of all pictures from a few strokes over some: masks_by_strokes.py is the step.

color_shares.py tells colours of the object from those around it, cut_picture.py draws the line between them in one picture, vote_volume.py asks all
pictures which places in the world are the object's.
"""

from drgs.reconstruct.capture.masks_by_strokes.masks_by_strokes import StrokeSettings, check_strokes, masks_by_strokes

__all__ = ["StrokeSettings", "check_strokes", "masks_by_strokes"]
