"""Assets from other programs' files and back: import_mesh.py (with import_splats.py) and export_asset.py, on the formats of drgs/exchange.

Meshes with textures are made by bake_textures.py, with shrink_mesh.py and bake_transfer.py. page/ makes the one of these files that is a program, too: the
asset in a browser, or in a notebook. bake_edits.py puts edits into an asset for good.
"""
