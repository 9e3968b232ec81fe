"""Estimating where an object is while it is being pushed (6.6.4, 7.2.3)."""
