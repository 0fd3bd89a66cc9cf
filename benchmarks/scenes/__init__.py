"""Scenes with truth, before anything is built: read as the benchmark lays them out, drawn, or photographed another way."""
