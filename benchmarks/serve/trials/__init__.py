"""What `python -m benchmarks abuse` tries: one file for each way in. Nothing here imports the server; it is asked as anybody could ask it."""
