"""The durable steps of each kind of job. Begin with job_run.py: what every kind offers, and what it works with."""
