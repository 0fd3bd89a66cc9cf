"""Sessions that people look at. Begin with stream.py (one connection) and sessions.py (one asset, one log of edits, many viewers).

messages.py and frame_header.py have what passes over the wire, edit_log.py the edits, session_store.py what of them is in the database,
viewer.py what one client sees, pace.py how large moving pictures may be.
"""
