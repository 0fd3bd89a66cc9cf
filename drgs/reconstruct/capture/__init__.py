"""What photographs say before anything is fitted. In: a capture folder. Out: Views with masks, and points to begin with.

Begin with load_views/; on_ground/ and find_masks.py, or masks_by_strokes/, visual_hull.py and initial_points.py follow.
"""
