"""What the puck touched, when, and what that did to it."""

from collections.abc import Callable
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim_bridge.hockey.mallet import MalletState
from sim_bridge.hockey.scene import SURFACES

MALLET = "mallet"
ONE_TOUCH = 0.3
"""The mallet may touch the puck again so shortly after the first touch [s]; later it is another shot."""


@dataclass(frozen=True)
class PuckContact:
    """One contact of the puck, from its first to its last step, in the robot's base frame.

    Attributes:
        surface: "mallet", or the rim: "left", "right", "near" or "far" (with its posts).
        start: time of the first step with contact [s].
        end: time of the first step without [s].
        pose: of the puck at the start (x, y, yaw) [m, rad], shape (3,).
        velocity_before: of the puck at the start (vx, vy, yaw rate) [m/s, rad/s], shape (3,).
        velocity_after: likewise at the end.
        mallet: the mallet at the start, tilt included, if it is what was touched.
    """

    surface: str
    start: float
    end: float
    pose: NDArray[np.float64]
    velocity_before: NDArray[np.float64]
    velocity_after: NDArray[np.float64]
    mallet: MalletState | None = None

    @property
    def duration(self) -> float:
        """How long it lasted [s]."""
        return self.end - self.start


@dataclass(frozen=True)
class _Begun:
    start: float
    pose: NDArray[np.float64]
    velocity: NDArray[np.float64]
    mallet: MalletState | None


class ContactLog:
    """Collects the contacts of the puck with rims and mallet.

    Attributes:
        contacts: those that have ended, in the order of their ends.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData):
        """Sort the geoms by surface."""
        self._data = data
        self._surface = [_surface(model.geom(i).name) for i in range(model.ngeom)]
        self.clear()

    def clear(self) -> None:
        """Forget everything."""
        self.contacts: list[PuckContact] = []
        self._begun: dict[str, _Begun] = {}

    @property
    def touching(self) -> tuple[str, ...]:
        """Surfaces that the puck touched in the last step."""
        return tuple(self._begun)

    def observe(
        self, time: float, pose: NDArray, velocity: NDArray, mallet: Callable[[], MalletState]
    ) -> None:
        """Take in the contacts that MuJoCo found for the state at a time [s].

        Args:
            time: now [s].
            pose: of the puck (x, y, yaw), shape (3,).
            velocity: of the puck, before this step's forces, shape (3,).
            mallet: gives the mallet's state.
        """
        if not (self._data.ncon or self._begun):
            return
        touched = {self._surface[geom] for geom in self._data.contact.geom.ravel()} - {None}
        for surface in [name for name in self._begun if name not in touched]:
            begun = self._begun.pop(surface)
            before = begun.start, time, begun.pose, begun.velocity
            self.contacts.append(PuckContact(surface, *before, velocity.copy(), begun.mallet))
        for surface in touched - self._begun.keys():
            state = mallet() if surface == MALLET else None
            self._begun[surface] = _Begun(time, pose.copy(), velocity.copy(), state)


def _surface(geom: str) -> str | None:
    if geom == MALLET:
        return MALLET
    return next((name for name in SURFACES if geom.startswith(f"rim_{name}")), None)
