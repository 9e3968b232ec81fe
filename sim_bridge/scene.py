"""What is simulated: the robot, a table, one object that slides on it, and how all of that looks.

The planners never see this file's numbers: they are the plant.
"""

import math
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim_bridge.arm_world import TIMESTEP
from sim_bridge.looks import add_looks
from sim_bridge.object_plant import ObjectPlant, solids
from sim_bridge.robots import CUBE, KINDS, LINK, ROD, RobotKind, robot_spec
from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.robot.tool_plane import ToolPlane

GRAVITY = 9.81
CUBE_SIDE = 0.015
"""Of the small wooden cubes that may lie in the way [m]."""

_CUBE_DENSITY = 700.0  # 2.4 g each
_CUBE_FRICTION = 0.4
_FOOT_RADIUS = 0.004
_OBJECT_COLOUR = (0.93, 0.58, 0.16, 1.0)
_GOAL_COLOUR = (0.16, 0.66, 0.36, 0.45)
_CUBE_COLOUR = (0.62, 0.44, 0.26, 1.0)


@documented
@dataclass(frozen=True)
class HandStart:
    """Where the hand starts."""

    start: tuple[float, float, float] = option(
        (0.36, -0.22, 1.5708), "start of the hand (x, y, yaw)", unit="m, rad", minimum=-4.0, maximum=4.0
    )
    height: float = option(
        0.05, "height of the hand's centre above the table", unit="m", minimum=0.032, maximum=0.2
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        validate(self)


@documented
@dataclass(frozen=True)
class BallsStart:
    """Where the two balls start."""

    start: tuple[float, float, float, float] = option(
        (0.38, 0.12, 0.38, -0.12), "start of the balls (left x, y, right x, y)", unit="m",
        minimum=-1.0, maximum=1.0,
    )  # fmt: skip
    height: float = option(
        0.035, "height of the balls' centres above the table", unit="m", minimum=0.032, maximum=0.2
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        validate(self)


@documented
@dataclass(frozen=True)
class Scene:
    """Everything a simulation starts from.

    Args:
        plant: the object.
        robot: which robot: one arm with a rod, one arm with a hand, or two arms with balls.
        object_pose: where its frame starts, (x, y, yaw) [m, rad].
        start_joints: joint positions at the start [rad], or None: tools upright at start_tool, hand.start or
            balls.start.
        start_tool: where the rod starts on the table if start_joints is None [m].
        tool_height: height of the rod's tip above the table [m].
        hand: start and height of the hand.
        balls: start and height of the balls.
        joint_friction: scale of the joints' dry friction; 1 is 0.1 to 0.3 Nm.
        joint_damping: scale of the joints' viscous friction.
        slope: angles by which the table, and the robot on it, is tilted down towards x and y [rad]; the
            controller takes it for level.
        cubes: where small loose cubes of wood lie on the table, pairs (x, y) [m].

    Raises:
        ConfigurationError: naming the field, its value and what is allowed.
    """

    plant: ObjectPlant = field(default_factory=ObjectPlant)
    robot: str = option("rod", "robot with its tools", choices=tuple(KINDS))
    object_pose: tuple[float, float, float] = option(
        (0.5, 0.0, 0.0), "start pose of the object (x, y, yaw)", unit="m, rad", minimum=-10.0, maximum=10.0
    )
    start_joints: tuple[float, ...] | None = None
    start_tool: tuple[float, float] = option(
        (0.38, -0.22), "start of the rod on the table", unit="m", minimum=-1.0, maximum=1.0
    )
    tool_height: float = option(
        0.02, "height of the rod's tip above the table", unit="m", minimum=0.002, maximum=0.2
    )
    hand: HandStart = field(default_factory=HandStart)
    balls: BallsStart = field(default_factory=BallsStart)
    joint_friction: float = option(1.0, "scale of the dry friction of the joints", minimum=0.0, maximum=10.0)
    joint_damping: float = option(
        1.0, "scale of the viscous friction of the joints", minimum=0.0, maximum=10.0
    )

    slope: tuple[float, float] = option(
        (0.0, 0.0), "tilt of the table down towards x and y", unit="rad", minimum=-0.1, maximum=0.1
    )
    cubes: tuple[tuple[float, float], ...] = ()

    def __post_init__(self) -> None:
        """Check the ranges."""
        validate(self)
        cubes = np.array(self.cubes, dtype=float)
        if cubes.size and (cubes.ndim != 2 or cubes.shape[1] != 2 or not np.isfinite(cubes).all()):
            raise ConfigurationError(f"Scene.cubes = {self.cubes} must be pairs (x, y) of finite numbers")

    @property
    def kind(self) -> RobotKind:
        """The robot."""
        return KINDS[self.robot]

    @property
    def height(self) -> float:
        """Height of the tips of the robot's tools above the table [m]."""
        return {"rod": self.tool_height, "hand": self.hand.height, "two_balls": self.balls.height}[self.robot]

    def plane(self) -> ToolPlane:
        """The plane of the robot's tools.

        Raises:
            InvalidInputError: no posture holds them at this height.
        """
        return self.kind.plane(self.kind.load(), self.height)

    def joints(self) -> NDArray[np.float64]:
        """Joint positions at the start [rad], shape (n,).

        Raises:
            ConfigurationError: start_joints has not n entries within the limits, or the start of the tools
                is out of reach.
        """
        if self.start_joints is None:
            return self._upright_start()
        q = np.array(self.start_joints, dtype=float)
        lower, upper = self.kind.load().position_range
        if q.shape != lower.shape or not np.all((q >= lower) & (q <= upper)):
            raise ConfigurationError(
                f"Scene.start_joints = {self.start_joints} must be {len(lower)} angles within the joint "
                "limits"
            )
        return q

    def _upright_start(self) -> NDArray[np.float64]:
        starts: dict[str, tuple[str, tuple[float, ...]]] = {
            "rod": ("start_tool", self.start_tool),
            "hand": ("hand.start", self.hand.start),
            "two_balls": ("balls.start", self.balls.start),
        }
        name, start = starts[self.robot]
        plane = self.plane()
        if not plane.contains(np.array(start)):
            low, high = plane.radius_range
            raise ConfigurationError(
                f"Scene.{name} = {start} is out of reach; the distance of each flange from its base must be "
                f"{low:.2f} to {high:.2f} m"
            )
        return plane.joints([start])[0]


def build(scene: Scene) -> mujoco.MjModel:
    """Compile the scene for MuJoCo.

    Names: joints of the robot (first in the state), then ``object``; bodies ``object``, ``goal`` (a
    see-through marker) and ``cube0`` ...; cameras ``overview``, ``top`` and ``side``; sites ``tool_tip``.
    """
    spec = robot_spec(scene.kind, scene.joint_friction, scene.joint_damping)
    spec.modelname = "push_box"
    _set_options(spec, scene.slope)
    _add_table(spec)
    _add_object(spec, scene)
    _add_goal(spec, scene.plant)
    _add_cubes(spec, scene.cubes)
    add_looks(spec)
    return spec.compile()


def _set_options(spec: mujoco.MjSpec, slope: tuple[float, float]) -> None:
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # The elliptic cone has isotropic friction; impratio > 1 makes friction stiffer than the normal, against
    # creep.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.iterations = 20
    spec.option.tolerance = 1e-8
    if any(slope):
        down = np.array([math.tan(slope[0]), math.tan(slope[1]), -1.0])
        spec.option.gravity = GRAVITY * down / np.linalg.norm(down)


def _add_table(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[2, 2, 0.1],
        group=3,
        contype=0,
        conaffinity=LINK | ROD | CUBE,
    )


def _add_object(spec: mujoco.MjSpec, scene: Scene) -> None:
    plant = scene.plant
    x, y, yaw = scene.object_pose
    body = spec.worldbody.add_body(
        name="object", pos=[x, y, 0.0], quat=[math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2)]
    )
    body.add_freejoint(name="object")
    body.explicitinertial = True
    body.mass = plant.mass
    body.ipos = np.array([*(plant.shape.centroid() + plant.com_offset), plant.height / 2])
    # Evenly filled about the vertical axis; how the moment splits between the level axes matters only for
    # tipping.
    turn = plant.mass * plant.shape.polar_radius**2
    tip = turn / 2 + plant.mass * plant.height**2 / 12
    body.inertia = np.array([tip, tip, turn])
    for i, (kind, pos, size, quat) in enumerate(solids(plant.shape, plant.height)):
        body.add_geom(
            name=f"object{i}", type=kind, pos=pos, size=size, quat=quat, rgba=_OBJECT_COLOUR, group=2,
            contype=0, conaffinity=LINK | CUBE,
        )  # fmt: skip
        for arm in scene.kind.arms:
            _add_pair(spec, arm.tool, f"object{i}", plant.tool_friction, time_constant=0.01)
    for i, (fx, fy) in enumerate(plant.feet()):
        body.add_geom(
            name=f"foot{i}",
            type=mujoco.mjtGeom.mjGEOM_SPHERE,
            pos=[fx, fy, _FOOT_RADIUS],
            size=[_FOOT_RADIUS, 0, 0],
            group=3,
            contype=0,
            conaffinity=0,
        )
        _add_pair(spec, "table", f"foot{i}", plant.table_friction, time_constant=0.01)


def _add_pair(spec: mujoco.MjSpec, first: str, second: str, friction: float, *, time_constant: float) -> None:
    """A contact with exactly this friction coefficient; without any friction, one of a single direction.

    The time constant is the softness: 10 ms for the rod is a thin coat of rubber (at 0.35 m/s it dents by
    0.5 mm).
    """
    spec.add_pair(
        geomname1=first,
        geomname2=second,
        condim=3 if friction > 0.0 else 1,
        friction=[friction, friction, 0.0, 0.0, 0.0],
        solref=[time_constant, 1.0],
        solimp=[0.95, 0.99, 0.0005, 0.5, 2.0],
    )


def _add_goal(spec: mujoco.MjSpec, plant: ObjectPlant) -> None:
    """A flat, see-through outline on the table; below the table until it is placed."""
    goal = spec.worldbody.add_body(name="goal", mocap=True, pos=[0.5, 0.0, -0.5])
    for kind, pos, size, quat in solids(plant.shape, 0.002):
        goal.add_geom(
            type=kind,
            pos=pos,
            size=size,
            quat=quat,
            rgba=_GOAL_COLOUR,
            group=1,
            contype=0,
            conaffinity=0,
            mass=0.0,
        )


def _add_cubes(spec: mujoco.MjSpec, positions: tuple[tuple[float, float], ...]) -> None:
    half = CUBE_SIDE / 2
    for i, (x, y) in enumerate(positions):
        body = spec.worldbody.add_body(name=f"cube{i}", pos=[x, y, half])
        body.add_freejoint(name=f"cube{i}")
        body.add_geom(
            name=f"cube{i}", type=mujoco.mjtGeom.mjGEOM_BOX, size=[half] * 3, density=_CUBE_DENSITY,
            rgba=_CUBE_COLOUR, group=2, contype=CUBE, conaffinity=CUBE | LINK | ROD,
            friction=[_CUBE_FRICTION, 0.005, 1e-4], priority=1, solref=[0.01, 1.0],
        )  # fmt: skip
