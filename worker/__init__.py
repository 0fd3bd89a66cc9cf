"""Durable builds: the data directory, its database and the job queue. Imports no torch at module level."""
