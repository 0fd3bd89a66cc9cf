"""Builds that benchmarks start, of presets and of variants of them, and the curves of their progress; none knows what will be measured."""
