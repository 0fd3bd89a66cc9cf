"""Measurements: too slow or too noisy for tests. `python -m benchmarks NAME`; results are rows of benchmarks/README.md."""
