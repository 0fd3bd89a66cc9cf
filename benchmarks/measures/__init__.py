"""What `quality` and `ablate` measure, one figure or family of figures a file; none of them knows how an asset was made."""
