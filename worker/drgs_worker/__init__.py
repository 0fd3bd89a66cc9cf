"""Durable jobs, and what the service keeps. Imports no torch at module level.

run.py        `drgs worker`: claim a name, take jobs from the queue, stop in order (__main__.py: the same as `python -m drgs_worker`)
store/        what is kept: settings, the data directory, the database's tables, and the store that machines share
jobs/         what is done: requests.py (what can be asked for) → queue.py → workflows.py (each job, durably) → steps/ (each kind's work)
logs.py       lines on stderr

The server uses store/ and the requests and queue of jobs/; only workers import jobs/workflows.py.
"""
