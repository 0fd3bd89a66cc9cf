"""The evidence of drgs2026 made anew: other systems' ways as variants behind one interface, its tables and its figures.

The command is command.py. `variant.py` has the interface, `variants/` one file a way, `splats.py` what all that draw Gaussians share and
`harmonics.py` how their radiance is baked; `cells.py` keeps what is finished, `tables.py` and `figures.py` make it, `perceptual.py` adds LPIPS, `pages.py` writes it down.
`laws.py` and `dances.py` have the figures that move for longer, `danced_ways.py` the others' dance and `poor_mesh.py` what binding learns; `wires.py` draws edges over
pictures, `traced.py` says how ours is traced. `character/` is a scene of our own.
"""
