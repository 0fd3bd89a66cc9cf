"""HTTP and WebSocket service: assets, jobs, sessions and the frame stream. Imports no torch at module level."""
