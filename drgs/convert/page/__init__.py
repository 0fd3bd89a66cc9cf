"""An asset as one HTML file that relights it in any browser: encode_page.py, with page_lights.py, pack_arrays.py and what all exports share; view.py
shows that in a notebook.

page.html, beside these files, is the program of the page (web/src/page/), in one file; web/build.py builds it.
"""
