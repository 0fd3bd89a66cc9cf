"""The service's door to drgs. Begin with interface.py (what the stream asks of a loaded asset) and thread.py (all of it runs there).

drgs_renderer.py implements the interface; the other files are its channels and encodings.
"""
