"""HTTP and WebSocket service: assets, jobs, sessions and the frame stream. Imports no torch at module level.

run.py            `drgs serve`: settings, the server, and a worker beside it
app.py            the application: what is made at start, routes and layers around them
api/              REST: routes, the records that they speak, and who may ask
live/             sessions: their edits, their viewers, and the WebSocket to each
render/           the one thread that renders, and the door to drgs
client.py         the same service from Python, client_stream.py its live connection; generate_types.py, from TypeScript

What is kept on disk, and the queue of jobs, are the worker's (worker/drgs_worker).
"""
