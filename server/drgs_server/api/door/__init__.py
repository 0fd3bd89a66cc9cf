"""What a request passes, and what is checked of the files that it brings. Begin with security.py: who may ask.

connections.py and text_streams.py are uvicorn's protocols with what they lack, rate_limit.py says how often callers may ask, body_limit.py how large
a body may be, and while_connected.py ends the work for callers that have left. receive_upload.py takes a file in at once, incoming.py in parts;
zip_guard.py unpacks it.
"""
