"""Experiments on robust pushing with simulated arms (6.6)."""
