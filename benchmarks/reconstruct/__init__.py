"""Builds of assets from photographs and films: time, quality, and what becomes of either under other settings and captures."""
