"""The filter of an air-hockey puck behind the state estimator: the camera's positions, and hits foreseen."""

import math
import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import JointState

from vpsto_ros.contact.puck import SHIPPED, PuckModel
from vpsto_ros.estimation.measurement import Outcome
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.estimation.particle_filter_config import FilterStatus
from vpsto_ros.estimation.puck_filter import PuckFilter, PuckFilterConfig
from vpsto_ros.nodes.estimators import Bridging
from vpsto_ros.nodes.joint_conversions import read_joint_state
from vpsto_ros.nodes.lifecycle import ManagedNode
from vpsto_ros.nodes.table_frame import HockeyTableConfig
from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.robot.iiwa import iiwa14
from vpsto_ros.robot.mallet_observer import MalletObserver
from vpsto_ros.robot.mallet_tilt import MalletTilt


def puck_model(path: str) -> PuckModel:
    """The model in a file, or the one that comes with the package where no path is given.

    Raises:
        ConfigurationError: there is no such file, or it is no model.
    """
    return PuckModel.load(pathlib.Path(path) if path else SHIPPED)


class PuckEstimator:
    """Predicts the puck to the present, off walls and off the mallet, which the arm's joints place."""

    with_frames = False

    def __init__(
        self, model: PuckModel, config: PuckFilterConfig, mallet: MalletTilt, table: HockeyTableConfig,
        bridging: Bridging, rng: np.random.Generator,
    ) -> None:  # fmt: skip
        """Compile the filter; `mallet` is how the mallet swings."""
        self._filter, self._table, self._bridging, self._rng = PuckFilter(model, config), table, bridging, rng
        self._mallet = MalletObserver(mallet)
        self._warm_up()
        self.reset()

    @property
    def frame_stamp(self) -> float:
        """When the last frame that was used is of [s]."""
        return self._frame_stamp

    def listen(self, node: ManagedNode) -> None:
        """Subscribe to the arm's joints."""
        names = iiwa14().joint_names

        def receive(message: JointState) -> None:
            position, velocity = read_joint_state(message, names)
            outcome = self.move(node.seconds(message.header.stamp), position, velocity)
            if outcome.kind not in ("accepted", "stale"):
                node.complaints.add("mallet", f"mallet not used, {outcome.kind}: {outcome.reason}")

        node.subscribe(JointState, "joint_states", receive)

    def move(self, stamp: float, position: NDArray, velocity: NDArray) -> Outcome:
        """Note where the mallet is at joint positions and velocities (7,) [rad, rad/s]."""
        mallet = self._mallet.observe(stamp, position, velocity)
        return self._filter.observe_mallet(stamp, self._table.to_table(mallet[:2]), mallet[2:])

    def reset(self) -> None:
        """Forget puck and mallet."""
        self._filter.reset()
        self._mallet.reset()
        self._frame_stamp = -math.inf

    def update(self, stamp: float, pose: NDArray, covariance: NDArray) -> Outcome:
        """Take in a measured pose, of which the position counts."""
        outcome = self._filter.update(stamp, self._table.to_table(pose[:2]), covariance[:2, :2])
        if outcome.kind in ("accepted", "reinitialized"):
            self._frame_stamp = stamp
        return outcome

    def state(self, now: float) -> ObjectState | None:
        """The puck predicted to the present; None if it was not seen for too long."""
        if now - self._frame_stamp > self._bridging.fresh + self._bridging.prediction:
            return None
        state = self._filter.state(now)
        return None if state is None else self._table.object_state(state)

    def belief(self, state: ObjectState, count: int) -> NDArray:
        """Samples of where the puck is."""
        poses = np.zeros((count, 3))
        factor = np.linalg.cholesky(state.covariance[:2, :2] + 1e-18 * np.eye(2))
        poses[:, :2] = state.pose[:2] + self._rng.standard_normal((count, 2)) @ factor.T
        return poses

    def status(self, now: float) -> FilterStatus:
        """How the filter is doing."""
        return self._filter.status(now)

    def figures(self) -> dict[str, Any]:
        """What the puck met."""
        state = None if math.isinf(self._frame_stamp) else self._filter.state(self._frame_stamp)
        if state is None:
            return {}
        return {"contacts": state.contacts, "touching": state.touching or "nothing"}

    def _warm_up(self) -> None:
        """Compile whatever a puck and a mallet use."""
        for index in range(4):
            self.move(0.01 * index, np.array(PlayRules().home), np.zeros(7))
        self._filter.reset()
        self._filter.warm_up()
