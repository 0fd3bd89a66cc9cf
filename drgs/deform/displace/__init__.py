"""Where a deform edit says that points go. In: points of an object, and a formula, handles or a file. Out: moved points, with their
deformation gradients where the edit knows more than the places of vertices.

Begin with maps.py (formulas) or hold_handles.py, which calls arap.py; vertex_sequence.py reads what another program has moved.
"""
