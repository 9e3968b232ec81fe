"""Experiments on the air-hockey table."""
