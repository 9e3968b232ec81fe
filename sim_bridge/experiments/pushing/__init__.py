"""Pushing with one tool, in closed loop (4.5.2)."""
