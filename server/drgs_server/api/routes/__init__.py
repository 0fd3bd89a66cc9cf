"""What can be asked, one file a subject. Begin with assets.py, then sessions.py: an asset that is looked at and edited.

Assets are made by jobs.py from captures.py, whose large files come by uploads.py. views.py has the photographs that an asset was built from,
variants.py the material variants of a session, weights.py the painted weights that edits refer to. drgs_server/app.py puts all of them together.
"""
