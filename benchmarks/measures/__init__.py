"""What `quality`, `ablate` and their like measure, one figure or family of figures a file; none of them knows how an asset was made."""
