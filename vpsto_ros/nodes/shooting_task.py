"""Shots at a goal as a task of the contact planner: a puck's object_state in, the touch of the mallet out."""

import dataclasses

import numpy as np
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from std_msgs.msg import Float64
from visualization_msgs.msg import Marker

from vpsto_ros.estimation.puck_filter import PuckState
from vpsto_ros.nodes import markers
from vpsto_ros.nodes.contact_planner_config import OWN_SETTING, ContactPlannerNodeConfig
from vpsto_ros.nodes.conversions import contact_message, read_contact, read_state, withdrawal_message
from vpsto_ros.nodes.inputs import CONTACT_AHEAD
from vpsto_ros.nodes.lifecycle import ManagedNode, reliable
from vpsto_ros.nodes.puck_estimator import puck_model
from vpsto_ros.nodes.table_frame import MALLET
from vpsto_ros.planning.contact import ContactPlan
from vpsto_ros.planning.hockey.shooting import SETTINGS, ShootingPlanner, Shot
from vpsto_ros.planning.hockey.shooting_policy import ShootingPolicy
from vpsto_ros.planning.hockey.shot_preview import ShotPreview, preview
from vpsto_ros.planning.hockey.strikes import StrikeTable
from vpsto_ros.planning.hockey.touch import same_touch
from vpsto_ros.robot.iiwa import iiwa14

_LEAST_VARIANCE = 1e-8  # of where to touch, so that the covariance stays positive definite [m²]
_DOTS = 3  # every so many states of the puck's way get an ellipse


class ShootingContacts:
    """The mallet of an iiwa and a puck of which object_state says how it moves."""

    def __init__(self, node: ManagedNode, config: ContactPlannerNodeConfig) -> None:
        """Set up the planner and listen."""
        strikes = StrikeTable.load()
        self._node, self._config, self._table = node, config, config.hockey.table(strikes)
        shooting = config.shooting
        if config.setting != OWN_SETTING:
            shooting = dataclasses.replace(shooting, objective=SETTINGS[config.setting])
        self._model = puck_model(config.puck_model)
        policy = ShootingPolicy.load(config.setting, self._model, strikes) if config.policy else None
        self.planner = ShootingPlanner(self._model, strikes, shooting, policy)
        self.planner.warm_up(strikes.rules.home)
        self.forget()
        self._chances = node.advertise(Float64, "~/goal_probability", reliable(1))
        node.subscribe(Odometry, "object_state", self._receive_object)
        node.subscribe(Odometry, "refused_contact", self._receive_refusal)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the arm's joints."""
        return iiwa14().joint_names

    @property
    def surface(self) -> float:
        """Height of the table [m]."""
        return self._table.surface

    def forget(self) -> None:
        """Forget puck and shot."""
        self.puck: PuckState | None = None
        self._told = False  # whether contact_plan says that there is a shot
        self.planner.forget()

    def missing(self, now: float, limit: float) -> str:
        """What keeps it from planning."""
        if self.puck is None or now - self.puck.stamp > limit:
            self.puck = None
            return f"no object_state within {limit} s"
        return ""

    def plan(self, now: float, joints: NDArray) -> list[Odometry]:
        """Where, when and how fast the mallet shall touch; once that it shall not when a shot is dropped."""
        assert self.puck is not None, "`missing` says so"
        shot = self.planner.plan(now, self.puck, joints)
        if shot is None:
            return self._no_shot()
        self._told = True
        self._chances.publish(Float64(data=shot.goal))
        covariance = self._spread(self.puck, shot) + _LEAST_VARIANCE * np.eye(2)
        place, frame = self._table.to_base(shot.mallet[:2]), self._config.base_frame
        touch = ContactPlan(shot.time, place, shot.mallet[2:], covariance)
        return [contact_message(touch, self._node.time_base, frame, MALLET)]

    def withdraw(self) -> list[Odometry]:
        """Drop the shot, and say so: without puck or arm it would not follow the puck any more."""
        self.planner.forget()
        return self._no_shot()

    def _no_shot(self) -> list[Odometry]:
        """What calls off the shot that was told last; nothing if that was done."""
        told, self._told = self._told, False
        stamp = self._node.get_clock().now().to_msg()
        return [withdrawal_message(stamp, self._config.base_frame)] if told else []

    def status(self) -> str:
        """What is intended, or why nothing is."""
        shot = self.planner.committed
        return f"no shot: {self.planner.reason}" if shot is None else describe(shot)

    def _touch(self, make: markers.MarkerFactory, shot: Shot | None) -> list[Marker]:
        """The mallet at the touch, and the way that it moves on."""
        mallet = np.zeros((0, 2)) if shot is None else self._table.to_base(shot.mallet[None, :2])
        stroke = np.zeros((0, 2)) if shot is None else mallet + 0.15 * np.outer((0.0, 1.0), shot.mallet[2:])
        radii = np.full(len(mallet), self._model.table.mallet_radius)
        return [
            make.circles("touch", mallet, radii, markers.CONTACT),
            make.line("stroke", stroke, markers.CONTACT),
        ]

    def _spread(self, puck: PuckState, shot: Shot) -> NDArray:
        """Covariance (2, 2) of where the puck is touched [m²]."""
        ahead = np.array([max(shot.time - puck.stamp, 0.0)])
        return self._model.predict(puck.mean, puck.covariance, ahead)[1][0, :2, :2]

    def _seen(self, shot: Shot | None) -> ShotPreview | None:
        if self.puck is None:
            return None
        return preview(self._model, self.planner.config, self.puck, shot)

    def _receive_object(self, message: Odometry) -> None:
        self._node.seconds(message.header.stamp)
        state = read_state(message, self._node.time_base, self._config.base_frame)
        self.puck = self._table.puck_state(state)

    def _receive_refusal(self, message: Odometry) -> None:
        """Drop a shot that the arm has no motion for; what comes later is another one."""
        self._node.seconds(message.header.stamp, CONTACT_AHEAD)
        plan = read_contact(message, self._node.time_base, self._config.base_frame)
        mallet, shot = np.append(self._table.to_table(plan.position), plan.velocity), self.planner.committed
        if shot is not None and same_touch(plan.stamp, mallet, shot.time, shot.mallet):
            self.planner.refuse()
            words = "the arm has no motion for the shot; another is sought"
            self._node.complaints.add("refused_contact", words)

    def markers(self, make: markers.MarkerFactory) -> list[Marker]:
        """The way of the puck that is expected, and the shot with ellipses of two standard deviations."""
        shot, seen = self.planner.committed, self._seen(self.planner.committed)
        way, spreads, touch = np.zeros((0, 2)), np.zeros((0, 2, 2)), 0
        if seen is not None:
            way, spreads = self._table.to_base(seen.mean[:, :2]), 4.0 * seen.covariance[:, :2, :2]
            touch = seen.touch
        after = slice(touch, None, _DOTS)
        where = self._table.to_base(np.array([-0.3, 0.62]))
        words = self.status() if seen is not None else "no puck"
        return [
            make.line("puck_path", way[:touch], markers.PREDICTION),
            make.line("shot_path", way[touch:], markers.PLAN),
            make.ellipses("shot_spread", way[after], spreads[after], markers.PREDICTION),
            *self._touch(make, shot),
            make.text("shot", words, (*where, self.surface + 0.1), 0.05),
        ]


def describe(shot: Shot) -> str:
    """A shot in words."""
    banks = {0: "direct", 1: "1 bank"}.get(shot.banks, f"{shot.banks} banks")
    return f"{100.0 * shot.goal:.0f} % to score, {banks}, {shot.goal_speed:.1f} m/s at the goal"
