"""How long tests wait for what must come."""

PATIENCE_SECONDS = 240.0
"""For an answer, a process, a picture. No test is faster for less of it, none measures with it, and on a busy machine everything takes its time."""
