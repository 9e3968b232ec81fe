"""A touch of the mallet, and when two are the same one, told anew: one rule for all who have to know."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.exceptions import InvalidInputError

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


@dataclasses.dataclass(frozen=True, eq=False)
class MalletContact:
    """What the contact planner asks for.

    Attributes:
        time: of the touch [s].
        mallet: x, y, vx, vy of the mallet's centre then, table frame, shape (4,) [m, m/s].

    Raises:
        InvalidInputError: a number is not finite, or the mallet stands still.
    """

    time: float
    mallet: NDArray[np.float64]

    def __post_init__(self) -> None:
        mallet = np.array(self.mallet, dtype=float)
        if mallet.shape != (4,) or not (np.isfinite(mallet).all() and np.isfinite(self.time)):
            raise InvalidInputError(f"a contact needs a time and a state (4,), finite, got {self.mallet!r}")
        if np.hypot(mallet[2], mallet[3]) < 1e-3:
            raise InvalidInputError("a contact needs a mallet that moves")
        mallet.setflags(write=False)
        object.__setattr__(self, "mallet", mallet)

    @property
    def angle(self) -> float:
        """Direction of the motion [rad]."""
        return float(np.arctan2(self.mallet[3], self.mallet[2]))

    def continues(self, other: "MalletContact | None") -> bool:
        """Whether it is another one, told anew."""
        return other is not None and same_touch(self.time, self.mallet, other.time, other.mallet)
