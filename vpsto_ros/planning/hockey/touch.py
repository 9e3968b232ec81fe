"""When two touches of the mallet are the same one, told anew: one rule for all who have to know."""

import numpy as np
from numpy.typing import NDArray

SAME_TIME = 0.02
"""Times of the same touch differ by less [s]; contact times that are searched are farther apart."""
SAME_PLACE = 0.06
"""And places of the mallet [m]; a little more than a shot may jump from step to step."""
SAME_ANGLE = 0.35
"""And directions of its motion [rad]."""


def same_touch(time: float, mallet: NDArray, other_time: float, other_mallet: NDArray) -> bool:
    """Whether a touch is another one, told anew.

    Args:
        time: of the touch [s].
        mallet: x, y, vx, vy of the mallet's centre then, shape (4,) [m, m/s]; it moves.
        other_time: of the other touch [s].
        other_mallet: likewise, in the same frame.
    """
    if abs(time - other_time) >= SAME_TIME or np.hypot(*(mallet - other_mallet)[:2]) >= SAME_PLACE:
        return False
    angle, other = (np.arctan2(state[3], state[2]) for state in (mallet, other_mallet))
    turned = (angle - other + np.pi) % (2.0 * np.pi) - np.pi
    return bool(abs(turned) < SAME_ANGLE)
