"""The service and its viewer: under the load of a team, under attack, over ten thousand changes, and in a browser."""
