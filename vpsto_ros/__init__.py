"""Real-time planning of contact: optimal trajectories, search over via-points, contact models, filters."""

__version__ = "0.1.0"
