"""Noise out of a picture: which filter is a setting."""

from drgs.render.film.denoise.denoise import denoise

__all__ = ["denoise"]
