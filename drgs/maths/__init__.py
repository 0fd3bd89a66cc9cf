"""Pure functions on arrays. Imports nothing else of drgs."""
