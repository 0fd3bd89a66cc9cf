"""Surfels fitted to photographs: stage 1, on faces, and the paper's stage 2."""
