"""One push repeated there and back, without sensors, until the object is lost (6.6.2).

A plan pushes a disc from one place to another. Turned by half a turn about the middle between both places it
pushes the disc back; a rectangle looks the same then. Between two pushes the hand backs off and goes round.
"""

import dataclasses
import itertools

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, synthesize

BACK_OFF = 0.09
"""How far the hand backs off before it goes round [m]."""
_LIMITS = Limits(np.array([0.3, 0.3, 1.5]), np.array([1.0, 1.0, 5.0]))
_PAUSE = 0.3


@dataclasses.dataclass(frozen=True)
class ThereAndBack:
    """A plan between two places, and the way round in between.

    Attributes:
        motion: of the hand (x, y, yaw) that pushes from the first place to the second.
        begin: the first place, shape (2,) [m].
        end: the second place, shape (2,) [m].
        aside: x of the lane in which the hand goes round [m].
    """

    motion: Trajectory
    begin: NDArray
    end: NDArray
    aside: float

    def push(self, number: int) -> Trajectory:
        """Push number 0, 1, ..: there, back, there, ..; from time 0 on."""
        motion = self.motion.shifted(-self.motion.start_time)
        if number % 2 == 0:
            return motion
        coefficients = motion.coefficients.copy()
        coefficients[..., :2] *= -1.0
        coefficients[:, 0, :2] += self.begin + self.end
        return Trajectory(motion.times, coefficients)

    def goal(self, number: int) -> NDArray:
        """Where push number 0, 1, .. leads, shape (2,) [m]."""
        return self.end if number % 2 == 0 else self.begin

    def way_round(self, number: int) -> Trajectory:
        """From the end of push `number` to the start of the next one: back off, turn, aside, along, in."""
        last, first = self.push(number), self.push(number + 1)
        here, there = last(last.end_time), first(0.0)
        forth = np.sign(self.goal(number)[1] - self.goal(number + 1)[1])
        back = min(here[1] * forth, self.goal(number)[1] * forth - 0.08) - BACK_OFF
        far = max(there[1] * forth, self.goal(number)[1] * forth + 0.13)
        keys = [
            here,
            (here[0], back * forth, here[2]),
            (here[0], back * forth, there[2]),
            (self.aside, back * forth, there[2]),
            (self.aside, far * forth, there[2]),
            (there[0], far * forth, there[2]),
            there,
        ]
        return _through(np.array(keys, dtype=float))


def _through(keys: NDArray) -> Trajectory:
    """Straight from key to key, resting at each."""
    rest, motion = np.zeros(3), None
    for here, there in itertools.pairwise(keys):
        begin = 0.0 if motion is None else motion.end_time
        if np.abs(there - here).max() < 1e-6:
            continue
        leg = synthesize(
            OptimalBasis.uniform(0), np.stack([here, there]), rest, rest, _LIMITS, start_time=begin
        )
        motion = leg if motion is None else motion.followed_by(leg)
    assert motion is not None, "the ways round never begin where they end"
    return motion
