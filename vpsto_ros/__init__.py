"""Real-time planning of contact: optimal trajectories, stochastic search over via-points, contact models and filters."""

__version__ = "0.1.0"
