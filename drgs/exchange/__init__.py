"""Formats to plain arrays and back: each file reads and writes one kind of file, and knows no scene."""
