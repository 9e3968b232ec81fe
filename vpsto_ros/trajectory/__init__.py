"""Trajectories from optimal basis functions and their minimal duration (ch. 3)."""
