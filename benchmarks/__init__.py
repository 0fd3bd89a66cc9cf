"""Measurements: too slow or too noisy for tests. `python -m benchmarks NAME`; results are rows of benchmarks/README.md.

Benchmarks lie with the part that they measure: reconstruct/ → deform/ → render/ → convert/ → serve/, paper/, which makes the paper's evidence,
and commits/, which runs the others in two commits.
What they share goes the way of a measurement: scenes/ (with truth) → builds/ (assets of them) → measures/ (how good those are).
"""
