"""Commits held against each other: the same benchmarks run by each in turns, so that what is slower is seen before it lands."""
