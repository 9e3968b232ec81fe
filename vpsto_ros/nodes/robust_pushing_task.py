"""Robust pushing as a task of the node that moves the arms: object_belief in place of object_state."""

import numpy as np
from numpy.typing import NDArray
from visualization_msgs.msg import Marker

from vpsto_ros.nodes import markers
from vpsto_ros.nodes.inputs import BeliefInput, ContactInput, TargetInput
from vpsto_ros.nodes.lifecycle import ManagedNode
from vpsto_ros.nodes.mpc_planner_config import MpcPlannerConfig
from vpsto_ros.nodes.planning_task import OnTable
from vpsto_ros.nodes.robots import belief_dynamics, contact_rule
from vpsto_ros.planning.belief_space.mpc import RobustPushingMpc
from vpsto_ros.planning.running_reference import MpcStep


class RobustPushingTask(OnTable):
    """Any tools push an uncertain object of which object_belief has hypotheses to goal_pose."""

    def __init__(self, node: ManagedNode, config: MpcPlannerConfig) -> None:
        """Set up the planner and listen."""
        self._config = config
        rng = np.random.default_rng(config.seed)
        dynamics = belief_dynamics(config.robot, config.model, config.belief.way_variance)
        rule = contact_rule(config.robot, config.model, config.robust.planning)
        self.tools = config.robot.plane()
        self.planner = RobustPushingMpc(config.robust, dynamics, self.tools, rule, rng)
        self.planner.warm_up()
        frame, robust = config.base_frame, config.robust
        self.goal = TargetInput(node, frame, robust.workspace_x, robust.workspace_y)
        # Its own randomness: plans must not depend on how many messages came.
        self.belief = BeliefInput(node, frame, config.belief, rng.spawn(1)[0])
        self.contact = ContactInput(node, frame, dynamics.effectors, config.robot.tools.frames, self.belief)

    def forget(self) -> None:
        """Forget what carries a time; the goal stays."""
        self.belief.forget()
        self.contact.forget()

    def pending(self, now: float) -> bool:
        """Whether there is a goal and a fresh belief."""
        timeout, known = self._config.robust.object_timeout, self.belief.latest
        return self.goal.target is not None and known is not None and now - known.stamp <= timeout

    def step(self, now: float, position: NDArray, velocity: NDArray, deadline: float) -> MpcStep:
        """Plan once."""
        contact = self.contact.fresh(now, self._config.contact_timeout_in_force)
        inputs = (now, position, velocity, self.belief.latest, self.goal.target, contact)
        return self.planner.step(*inputs, deadline=deadline)

    def stamps(self) -> dict[str, float]:
        """When the inputs are of."""
        return {"object_belief": self.belief.stamp, "contact_plan": self.contact.received}

    def markers(self, make: markers.MarkerFactory, step: MpcStep) -> list[Marker]:
        """The belief and what the plan makes of it, the expected object and its goal."""
        shape, known, target = self.planner.pusher.dynamics.shape, self.belief.latest, self.goal.target
        pose = None if known is None else known.belief.mean
        drawn = [
            make.shape("object", shape, pose, markers.ESTIMATE),
            make.circles("predicted_spread", step.object_path[::8, :2], step.spread[::8], markers.PREDICTION),
        ]
        if target is not None:
            drawn.append(make.shape("goal", shape, np.append(target.position, 0.0), markers.GOAL))
        return drawn
