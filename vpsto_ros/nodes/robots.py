"""What the nodes are told about the robot, and about what may differ between hypotheses about an object."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import Disc
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.nodes.scene import ModelConfig
from vpsto_ros.planning.belief_space.config import RobustContactConfig
from vpsto_ros.planning.belief_space.contacts import ContactRule
from vpsto_ros.robot.bimanual_plane import LEAST_DISTANCE
from vpsto_ros.robot.kinds import TOOL_KINDS, ToolKind
from vpsto_ros.robot.tip_kinematics import BALL_RADIUS
from vpsto_ros.robot.tool_plane import ToolPlane

PUSHING, ROBUST_PUSHING, SHOOTING = "pushing", "robust_pushing", "shooting"
TASKS = (PUSHING, ROBUST_PUSHING, SHOOTING)
"""What planners can do: push with the rod towards a goal pose, push an uncertain object with any tools, or
shoot a puck at a goal."""


@documented
@dataclasses.dataclass(frozen=True)
class RobotConfig:
    """Which robot moves, and how high above the table its tools are."""

    kind: str = option("rod", "robot with its tools", choices=tuple(TOOL_KINDS))
    tool_height: float = option(
        0.0,
        "height of the tips above the table (kind = pushing has planner.tool_height); 0 takes the usual one, "
        + ", ".join(f"{kind.height:g} for {name}" for name, kind in TOOL_KINDS.items()),
        unit="m",
        minimum=0.0,
        maximum=1.0,
    )

    def __post_init__(self) -> None:
        validate(self)

    @property
    def tools(self) -> ToolKind:
        """The robot's tools and their plane."""
        return TOOL_KINDS[self.kind]

    def plane(self) -> ToolPlane:
        """The plane in which the tools move.

        Raises:
            ConfigurationError: no posture holds the tools at this height.
        """
        height = self.tool_height or self.tools.height
        try:
            return self.tools.plane(self.tools.load(), height)
        except InvalidInputError as error:
            raise ConfigurationError(
                f"robot.tool_height = {height:g} m does not do for robot.kind = '{self.kind}': {error}"
            ) from error


def check_task(kind: str, robot: RobotConfig, goal_orientation: str) -> None:
    """Raise ConfigurationError when a task and a robot do not fit together."""
    if kind == PUSHING and robot.kind != "rod":
        raise ConfigurationError(
            f"robot.kind = '{robot.kind}' needs kind = '{ROBUST_PUSHING}'; kind = '{PUSHING}' moves the rod"
        )
    if kind == ROBUST_PUSHING and robot.kind == "rod":
        raise ConfigurationError(
            f"kind = '{ROBUST_PUSHING}' needs tools that gather what is uncertain, robot.kind = 'two_balls' "
            f"or 'hand'; robot.kind = 'rod' only spreads it: use kind = '{PUSHING}'"
        )
    if kind == ROBUST_PUSHING and goal_orientation == "use":
        raise ConfigurationError(
            f"goal_orientation = 'use' needs kind = '{PUSHING}'; '{ROBUST_PUSHING}' brings objects to a "
            "place, whatever their yaw: set it to 'ignore'"
        )


@documented
@dataclasses.dataclass(frozen=True)
class BeliefModelConfig:
    """How pushes may differ from what a nominal model says."""

    friction: tuple[float, float] = option(
        (0.0, 0.5), "range of the friction coefficient between tools and object", minimum=0.0, maximum=2.0
    )
    center_std: float = option(
        0.005,
        "standard deviation of the centre of friction from the centre of the outline, in x and in y",
        unit="m",
        minimum=0.0,
        maximum=0.1,
    )
    way_variance: float = option(
        1e-4, "variance that the place gains per metre pushed", unit="m", minimum=0.0, maximum=0.1
    )

    def __post_init__(self) -> None:
        validate(self)
        if self.friction[0] > self.friction[1]:
            raise ConfigurationError(
                f"friction = {list(self.friction)}: the first must not be above the second"
            )

    def draw(self, count: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
        """Friction (count,) and centre of friction (count, 2) [m] of hypotheses."""
        return rng.uniform(*self.friction, count), self.center_std * rng.standard_normal((count, 2))


def effectors_of(robot: RobotConfig, model: ModelConfig) -> EndEffectors:
    """What touches; the radius of a rod is a parameter, other tools are as they are."""
    return EndEffectors.discs(model.tool_radius) if robot.kind == "rod" else robot.tools.effectors


def belief_dynamics(robot: RobotConfig, model: ModelConfig, way_variance: float) -> BeliefDynamics:
    """How hypotheses about an object move when tools push it, see :class:`BeliefDynamics`."""
    return BeliefDynamics(
        model.object.shape(), effectors_of(robot, model), friction=True, step_variance=0.0,
        way_variance=way_variance, pressure_radius=model.pressure_radius or None,
    )  # type: ignore[arg-type]  # fmt: skip


def contact_rule(robot: RobotConfig, model: ModelConfig, planning: RobustContactConfig) -> ContactRule:
    """Where the tools of a robot touch an object.

    Raises:
        ConfigurationError: side by side behind the object, the tools would touch each other; or they may
            come nearer to each other than their arms can.
    """
    effectors, shape, two_arms = effectors_of(robot, model), model.object.shape(), robot.tools.two_arms
    rule = ContactRule.of(planning, effectors, shape, two_arms=two_arms)
    least = LEAST_DISTANCE - 2.0 * BALL_RADIUS
    if two_arms and planning.separation < least - 1e-9:
        raise ConfigurationError(
            f"separation = {planning.separation:g} m lets the arms of robot.kind = '{robot.kind}' touch; at "
            f"least {least:g} m is needed"
        )
    gap = _narrowest_gap(rule)
    if gap < planning.separation:
        raise ConfigurationError(
            f"model.object.size = {list(model.object.size)} m is too small for robot.kind = '{robot.kind}': "
            f"{planning.contact_angle:g} rad (contact_angle) to both sides, the tools behind it would be "
            f"{1e3 * gap:.0f} mm apart, allowed are {1e3 * planning.separation:g} mm or more (separation); "
            "raise contact_angle or take a robot with one tool"
        )
    return rule


def _narrowest_gap(rule: ContactRule) -> float:
    """Smallest distance [m] between neighbouring discs behind the object, for any direction of pushing."""
    radii = [shape.radius for shape in rule.effectors.shapes if isinstance(shape, Disc)]
    if len(radii) < 2 or len(radii) < rule.effectors.count:
        return float("inf")
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    present = np.zeros(rule.effectors.dof)
    places = [
        rule.configuration(np.zeros(3), np.array([np.cos(a), np.sin(a)]), present).reshape(-1, 2)
        for a in angles
    ]
    pairs = [(i, j) for i in range(len(radii)) for j in range(i)]
    return min(
        float(np.hypot(*(where[i] - where[j]))) - radii[i] - radii[j] for where in places for i, j in pairs
    )
