"""Demos in which a robot pushes an object to a target that jumps and drifts, while a hand knocks it away."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped, WrenchStamped
from numpy.typing import NDArray
from rclpy.qos import QoSProfile

from sim_bridge.demo.observer import Observer, message_stamp
from sim_bridge.demo.scenario import Orders, Phase, Scenario
from sim_bridge.demo.settings import Settings
from sim_bridge.demo.verdict import Chart, Demo
from sim_bridge.report.charts import compute_chart, distance_chart, joint_chart, top_view
from sim_bridge.report.page import Table, push_tables
from sim_bridge.report.recording import GOAL_POSE, Recording
from sim_bridge.report.stage import PushingStage, Stage
from sim_bridge.report.summary import PLANNER, RunFacts, summarize
from vpsto_ros.nodes.markers import arm_bases
from vpsto_ros.robot.tool_plane import ToolPlane

DISTURBANCE = "/disturbance"
GOAL_PERIOD, GOAL_REPEAT = 0.05, 0.5
"""How often a moving target is published, and one that stands, lest its one message be lost [s]."""


@dataclass(frozen=True)
class PushingDemo(Demo):
    """A demo that is told by a scenario.

    Attributes:
        scenario: what happens, from a source of randomness and the longest it may take [s].
        achieved: what a good run achieved, in words, from its summary.
        strict: whether contacts of the arms and refused trajectories are failures as well.
    """

    scenario: Callable[[np.random.Generator, float], Scenario]
    achieved: Callable[[dict[str, Any]], str]
    strict: bool = False

    def script(self, settings: Settings, rng: np.random.Generator, duration: float) -> PushingScript:
        """The scenario, acted out."""
        return PushingScript(self.scenario(rng, duration), settings.tools, settings.base_frame)

    def stage(self, settings: Settings) -> Stage:
        """Robot, object and target."""
        return PushingStage(settings.scene)

    def summarize(
        self, recording: Recording, script: PushingScript, settings: Settings, facts: RunFacts
    ) -> dict[str, Any]:
        """The figures of a run."""
        return summarize(recording, script.scenario, settings.tools, facts, strict=self.strict)

    def success(self, summary: dict[str, Any]) -> str:
        """What a good run achieved."""
        return self.achieved(summary)

    def target(self, script: PushingScript) -> NDArray | None:
        """Where the object is to go."""
        return script.goal

    def tables(self, summary: dict[str, Any]) -> list[Table]:
        """The report's tables."""
        return push_tables(summary)

    def charts(
        self, out: Path, recording: Recording, summary: dict[str, Any], settings: Settings
    ) -> list[Chart]:
        """Distance to the target, paths on the table, joints and compute times."""
        tools, phases = settings.tools, summary["phases"]
        marks = ", ".join(dict.fromkeys(phase["name"] for phase in phases))
        charts = [
            (out / "distance.png", f"Distance between object and target. Vertical lines: {marks}."),
            (
                out / "top_view.png",
                "Seen from above: paths of object, target and tools; object at the start (faint) and at "
                "the end.",
            ),
            (out / "joints.png", "Joint velocities and torques as shares of their limits."),
            (out / "compute.png", "Compute time of a planning step as the planner reports it."),
        ]
        distance_chart(charts[0][0], recording, phases, summary["reached_distance_m"])
        shape = settings.scene.plant.shape
        tips, corners = tools.tips(recording.joints.position), shape.transform(np.zeros(3))
        top_view(charts[1][0], recording, tips, corners, arm_bases(tools))
        joint_chart(charts[2][0], recording, tools.robot.limits, tools.robot.torque_limits)
        compute_chart(charts[3][0], recording, PLANNER)
        return charts


class PushingScript:
    """Acts out a scenario: publishes the target, lends the hand that knocks the object.

    Attributes:
        scenario: with the phases as they went.
        goal: the target's position (2,) [m], None before the first one.
    """

    def __init__(self, scenario: Scenario, tools: ToolPlane, frame: str = "fr3_link0") -> None:
        """Prepare.

        Args:
            scenario: what happens.
            tools: the robot's tools, which the hand avoids.
            frame: of all poses.
        """
        self.scenario = scenario
        self.goal: NDArray | None = None
        self._tools, self._frame = tools, frame
        self._goal_published = -math.inf
        self._announced: set[str] = set()

    def connect(self, observer: Observer) -> None:
        """Make the publishers of target and hand."""
        self._observer = observer
        self._goals = observer.create_publisher(PoseStamped, GOAL_POSE, QoSProfile(depth=1))
        self._forces = observer.create_publisher(WrenchStamped, DISTURBANCE, QoSProfile(depth=5))

    @property
    def start(self) -> float:
        """When the first phase began [s]."""
        return self.scenario.phases[0].start

    @property
    def end(self) -> float:
        """When the last phase was over [s]."""
        return self.scenario.phases[-1].end if self.finished else math.nan

    @property
    def finished(self) -> bool:
        """Whether every phase is over."""
        return self.scenario.finished

    @property
    def progress(self) -> float:
        """Share of the phases that are over."""
        return self.scenario.progress

    def ready(self) -> bool:
        """Whether both planners listen to the target; the observer itself does, too."""
        return self._goals.get_subscription_count() - 1 >= 2

    def asked(self) -> bool:
        """Whether there is a target."""
        return self.goal is not None

    def act(self, now: float) -> None:
        """Go on in the scenario."""
        box, joints = self._observer.object_pose(), self._observer.joints()
        if joints is not None and box is not None and not self.finished:
            tools = self._tools.tips(joints)[:, :2]
            self.carry_out(self.scenario.step(now, box[:2], tools), now)

    def carry_out(self, orders: Orders, now: float) -> None:
        """Publish target and force."""
        changed = self.goal is None or not np.allclose(orders.goal, self.goal, atol=1e-9)
        age = now - self._goal_published
        if age >= GOAL_REPEAT or (changed and (not orders.goal_moves or age >= GOAL_PERIOD)):
            self.goal, self._goal_published = orders.goal, now
            message = PoseStamped()
            message.header.frame_id, message.header.stamp = self._frame, message_stamp(now)
            message.pose.position.x, message.pose.position.y = map(float, orders.goal)
            message.pose.orientation.w = 1.0
            self._goals.publish(message)
        if orders.force is not None:
            wrench = WrenchStamped()
            wrench.header.frame_id, wrench.header.stamp = self._frame, message_stamp(now)
            wrench.wrench.force.x, wrench.wrench.force.y = map(float, orders.force)
            self._forces.publish(wrench)

    def label(self) -> str:
        """The phase and how far the object is from its target."""
        pose = self._observer.object_pose()
        if pose is None or self.goal is None:
            return ""
        distance = float(np.linalg.norm(pose[:2] - self.goal)) * 1e3
        return f"{self.scenario.phase.name:9s} {distance:5.0f} mm to target"

    def news(self) -> list[str]:
        """A sentence about every phase that is over."""
        over = [phase for phase in self.scenario.phases if math.isfinite(phase.end)]
        fresh = [phase for phase in over if phase.name not in self._announced]
        self._announced |= {phase.name for phase in fresh}
        return [self._sentence(phase) for phase in fresh]

    def _sentence(self, phase: Phase) -> str:
        if not phase.judged:
            median = float(np.median(self.scenario.drift_distances)) * 1e3
            return f"  {phase.name:9s}  the target moved at 2 cm/s; median distance {median:.0f} mm"
        if math.isnan(phase.reached):
            return f"  {phase.name:9s}  NOT reached within {phase.timeout:.0f} s"
        return f"  {phase.name:9s}  reached after {phase.time_to_reach:.1f} s"
