"""Judgements in figures: of a capture before it is built (doctor.py), and of an asset or a picture (evaluate_asset.py, metrics.py)."""
