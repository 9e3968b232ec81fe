"""Trajectories from optimal basis functions and their minimal duration (ch. 3)."""

import vpsto_ros.kernel_cache  # noqa: F401 (before the first kernel)
from vpsto_ros.trajectory.basis import OptimalBasis
from vpsto_ros.trajectory.key_timing import KeyTimingConfig, TimedKeys, time_key_positions
from vpsto_ros.trajectory.synthesis import braking_trajectory, synthesize
from vpsto_ros.trajectory.timing import (
    MINIMUM_DURATION,
    Limits,
    TrajectoryBatch,
    minimal_duration,
    synthesize_batch,
)
from vpsto_ros.trajectory.trajectory import Trajectory

__all__ = [
    "MINIMUM_DURATION",
    "KeyTimingConfig",
    "Limits",
    "OptimalBasis",
    "TimedKeys",
    "Trajectory",
    "TrajectoryBatch",
    "braking_trajectory",
    "minimal_duration",
    "synthesize",
    "synthesize_batch",
    "time_key_positions",
]
