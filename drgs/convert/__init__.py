"""Assets from other programs' files and back: import_mesh.py (with import_splats.py) and export_asset.py, on the formats of drgs/exchange.

bake_edits.py puts edits into an asset for good.
"""
