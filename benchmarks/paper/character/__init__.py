"""A character of our own: modelled, painted, rigged and made to dance by formulas, so that nobody else has rights in it (CC0).

`skeleton.py` has its joints, `body.py` its closed surface and its paint, `skin_weights.py` says which joints move which vertex, `dance.py` how they
turn, `rigged_glb.py` writes all that as a skinned glTF, and `photograph.py` makes a capture of it. z is up, the character looks along -y and has its
left hand at +x; lengths are world units, of which it is about one and a half high.
"""
