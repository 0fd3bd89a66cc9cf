"""An asset as one HTML file that relights it in any browser: page_lights.py, pack_arrays.py; encode_page.py joins them
with what exports share: fewer faces, and shadows baked for any light.

page.html, beside these files, is the program of the page (web/src/page/), in one file; web/build.py builds it.
"""
