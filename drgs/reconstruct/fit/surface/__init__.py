"""The mesh fitted to photographs: normals by shading, positions from them, passes, and stage 2 on it."""
