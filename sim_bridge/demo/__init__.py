"""Demos: the nodes as separate processes, a scenario that keeps them busy, and a verdict."""
