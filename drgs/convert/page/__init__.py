"""An asset as one HTML file that relights it in any browser: shrink_mesh.py, bake_transfer.py, page_lights.py, pack_arrays.py; encode_page.py joins them.

page.html, beside these files, is the program of the page (web/src/page/), in one file; web/build.py builds it.
"""
