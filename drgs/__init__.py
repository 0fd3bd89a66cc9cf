"""DR-GS: relightable, deformable, editable 2D Gaussians. See docs/roadmap.md for what works."""

__version__ = "0.1.0"
