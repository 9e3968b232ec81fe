"""Hands that meddle with the object: constant wrenches and moves to another place."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim_bridge.object_plant import ObjectPlant

_HAND_FREQUENCY = 60.0  # of the servoed hand [rad/s]
_HAND_FORCE = 25.0  # what the hand pushes with at most, beyond the object's weight [N]


@dataclass
class Push:
    """A constant wrench (force [N], torque [Nm]) on the object until a time [s]."""

    end: float
    wrench: NDArray[np.float64]


@dataclass
class Hand:
    """A hand that moves the object from one point to another [m]."""

    begin: float
    duration: float
    origin: NDArray[np.float64]
    displacement: NDArray[np.float64]


class Disturbances:
    """What acts on the object at present.

    Attributes:
        active: pushes and hands that are not over.
    """

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, plant: ObjectPlant):
        """Act on the body ``object`` of a model."""
        self.active: list[Push | Hand] = []
        self._model, self._data, self._plant = model, data, plant
        self._body = model.body("object").id
        self._wrench = data.xfrc_applied[self._body]
        self._com = data.xipos[self._body]

    def apply(self, now: float) -> None:
        """Add up the disturbances of this instant; drop those that are over."""
        self._wrench[:] = 0.0
        running: list[Push | Hand] = []
        for disturbance in self.active:
            if isinstance(disturbance, Push) and now < disturbance.end:
                self._wrench += disturbance.wrench
                running.append(disturbance)
            elif isinstance(disturbance, Hand) and now < disturbance.begin + disturbance.duration:
                self._wrench[:2] += self._hand_force(disturbance, now)
                running.append(disturbance)
        self.active = running

    def _hand_force(self, hand: Hand, now: float) -> NDArray[np.float64]:
        """Critically damped servo along a minimum-jerk path."""
        s = (now - hand.begin) / hand.duration
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
        rate = 30.0 * (s * (1.0 - s)) ** 2 / hand.duration
        bend = 60.0 * s * (1.0 - s) * (1.0 - 2.0 * s) / hand.duration**2
        w, plant = _HAND_FREQUENCY, self._plant
        offset = hand.origin + share * hand.displacement - self._com[:2]
        velocity = np.empty(6)
        mujoco.mj_objectVelocity(self._model, self._data, mujoco.mjtObj.mjOBJ_BODY, self._body, velocity, 0)
        slip = rate * hand.displacement - velocity[3:5]
        along = slip + w * offset
        grip = plant.table_friction * plant.mass * 9.81 * along / (np.linalg.norm(along) + 0.02)
        force = plant.mass * (bend * hand.displacement + 2.0 * w * slip + w * w * offset) + grip
        most = _HAND_FORCE + plant.mass * 9.81
        return force * min(1.0, most / max(float(np.linalg.norm(force)), 1e-9))
