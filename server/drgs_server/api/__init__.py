"""REST. Begin with routes/, one file a subject; rest_records.py has their bodies, answers.py fills them from the database, context.py is what they
work with. door/ stands before them: who may ask, how much and how often, and what is let in.

problems.py makes every error a sentence, metrics.py counts requests, environments.py (with made_environments.py) stores environments.
openapi_document.py describes all this to programs, docs_page.py to people.
"""
