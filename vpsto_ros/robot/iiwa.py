"""The KUKA LBR iiwa 14 that plays air hockey: its limits, and its model up to the mallet's joint."""

from functools import lru_cache
from pathlib import Path

import numpy as np

from vpsto_ros.robot.kinematics import Robot

MODEL_PATH = Path(__file__).parent / "models" / "iiwa14.xml"
JOINT_NAMES = tuple(f"iiwa_joint_{i}" for i in range(1, 8))
UNIVERSAL_JOINT = "universal_joint"  # the frame at the end of the rod; its z axis points along the rod

# Limits that the MJCF cannot hold [rad/s, rad/s²]; none is known for the rates of the torques.
VELOCITY_LIMITS = tuple(np.deg2rad((85.0, 85.0, 100.0, 75.0, 130.0, 135.0, 135.0)).tolist())
ACCELERATION_LIMITS = tuple(10.0 * limit for limit in VELOCITY_LIMITS)
TORQUE_RATE_LIMITS = (np.inf,) * 7


@lru_cache(maxsize=1)
def iiwa14() -> Robot:
    """The arm with its rod and the weight of its mallet, read once and shared (but not by threads).

    Its tip is the universal joint of the mallet.
    """
    return Robot.from_mjcf(
        MODEL_PATH,
        velocity=VELOCITY_LIMITS,
        acceleration=ACCELERATION_LIMITS,
        torque_rate=TORQUE_RATE_LIMITS,
        tip=UNIVERSAL_JOINT,
    )
