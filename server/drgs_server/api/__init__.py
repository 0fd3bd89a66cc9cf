"""REST. Begin with routes_*.py, one file a subject; rest_records.py has their bodies and context.py what they work with.

security.py and rate_limit.py stand around all of it, problems.py makes every error a sentence, uploads.py and zip_guard.py take files in.
"""
