"""Measurements: too slow or too noisy for tests. `python -m benchmarks NAME`; results are rows of benchmarks/README.md.

Benchmarks lie with the part that they measure: reconstruct/ → deform/ → render/ → convert/ → serve/, and paper/, which makes the paper's evidence.
What they share goes the way of a measurement: scenes/ (with truth) → builds/ (assets of them) → measures/ (how good those are).
"""
