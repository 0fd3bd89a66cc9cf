"""What workers do. A request (requests.py) waits in the queue (queue.py) until a worker runs its workflow (workflows.py) step by step (steps/).

builders.py finds the function that builds assets, progress.py is what jobs say meanwhile; file_tool.py reads and writes untrusted files in a
process of its own, which begin_tool.py begins and tool_parent.py forks.
"""
