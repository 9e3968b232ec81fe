"""What is simulated: the arm with its rod, a table, one object that slides on it, and how all of that looks.

The planners never see this file's numbers: they are the plant.
"""

import math
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim_bridge.looks import add_looks
from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.contact.geometry import Disc, PlanarShape, Rectangle
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import MODEL_PATH, TOOL_LENGTH, fr3_pusher

TIMESTEP = 0.001
TOOL_RADIUS = 0.015

# Friction and damping of the real joints that is left after the maker's compensation; no controller here
# knows them.
_JOINT_FRICTION = (0.3, 0.3, 0.3, 0.3, 0.15, 0.1, 0.1)  # [Nm]
_JOINT_DAMPING = (0.5, 0.5, 0.5, 0.5, 0.2, 0.1, 0.005)  # [Nm s/rad]

_FOOT_RADIUS = 0.004
_ROBOT, _ROD = 1, 4  # collision bits; the object only meets what asks for it by an explicit pair or by these
_OBJECT_COLOUR = (0.93, 0.58, 0.16, 1.0)
_GOAL_COLOUR = (0.16, 0.66, 0.36, 0.45)


@documented
@dataclass(frozen=True)
class ObjectPlant:
    """The object as it really is.

    Args:
        shape: outline seen from above, in the object frame.
        height: height [m].
        mass: mass [kg].
        table_friction: friction coefficient between object and table.
        tool_friction: friction coefficient between object and rod.
        com_offset: centre of mass relative to the centre of the outline's area [m], object frame.
        support: where the object touches the table: "corners" or "spread" evenly.

    Raises:
        ConfigurationError: naming the field, its value and what is allowed.
    """

    shape: PlanarShape = field(default_factory=lambda: PlanarShape.box(0.12, 0.12))
    height: float = option(0.06, "height of the object", unit="m", minimum=0.03, maximum=0.3)
    mass: float = option(0.5, "mass of the object", unit="kg", minimum=0.01, maximum=10.0)
    table_friction: float = option(0.35, "friction coefficient on the table", minimum=0.01, maximum=2.0)
    tool_friction: float = option(0.25, "friction coefficient against the rod", minimum=0.0, maximum=2.0)
    com_offset: tuple[float, float] = option(
        (0.0, 0.0), "centre of mass relative to the centre of area", unit="m", minimum=-0.1, maximum=0.1
    )
    support: str = option("corners", "where the object touches the table", choices=("corners", "spread"))

    def __post_init__(self) -> None:
        """Check the ranges, and that the centre of mass is above the supported area."""
        validate(self)
        com = self.shape.centroid() + self.com_offset
        if not _inside_hull(self.feet(), com):
            raise ConfigurationError(
                f"ObjectPlant.com_offset = {self.com_offset} puts the centre of mass beyond the feet; the "
                "object would tip over"
            )

    def feet(self) -> NDArray[np.float64]:
        """Where the object touches the table, shape (F, 2) [m], object frame.

        Corners: the corners of the outline (four points on the rim of a disc). Spread: the centre of each
        primitive and four points around it, such that equal loads have the second moments of an evenly
        spread pressure.
        """
        points = [foot for p in self.shape.primitives for foot in _primitive_feet(p, self.support)]
        feet = np.array(points)
        if self.support == "corners" and len(self.shape.primitives) > 1:
            feet = feet[self.shape.signed_distance(feet) > -1e-6]
        return feet[_first_of_each(feet)]


@documented
@dataclass(frozen=True)
class Scene:
    """Everything a simulation starts from.

    Args:
        plant: the object.
        object_pose: where its frame starts, (x, y, yaw) [m, rad].
        start_joints: joint positions at the start [rad], or None: rod upright at start_tool.
        start_tool: where the rod starts on the table if start_joints is None [m].
        tool_height: height of the rod's tip above the table [m].
        joint_friction: scale of the joints' dry friction; 1 is 0.1 to 0.3 Nm.
        joint_damping: scale of the joints' viscous friction.

    Raises:
        ConfigurationError: naming the field, its value and what is allowed.
    """

    plant: ObjectPlant = field(default_factory=ObjectPlant)
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
    joint_friction: float = option(1.0, "scale of the dry friction of the joints", minimum=0.0, maximum=10.0)
    joint_damping: float = option(
        1.0, "scale of the viscous friction of the joints", minimum=0.0, maximum=10.0
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        validate(self)

    def joints(self) -> NDArray[np.float64]:
        """Joint positions at the start [rad], shape (7,).

        Raises:
            ConfigurationError: start_joints has not seven entries within the limits, or start_tool is out
                of reach.
        """
        robot = fr3_pusher()
        if self.start_joints is None:
            table = TableMap(robot, self.tool_height)
            if not table.contains(self.start_tool):
                low, high = table.radius_range
                raise ConfigurationError(
                    f"Scene.start_tool = {self.start_tool} is out of reach; its distance from the base must "
                    f"be {low:.2f} to {high:.2f} m"
                )
            return table.joints([self.start_tool])[0]
        q = np.array(self.start_joints, dtype=float)
        lower, upper = robot.position_range
        if q.shape != (7,) or not np.all((q >= lower) & (q <= upper)):
            raise ConfigurationError(
                f"Scene.start_joints = {self.start_joints} must be 7 angles within the joint limits"
            )
        return q


def build(scene: Scene) -> mujoco.MjModel:
    """Compile the scene for MuJoCo.

    Names: joints ``fr3_joint1..7`` and ``object``, bodies ``object`` and ``goal`` (a see-through marker),
        cameras ``overview``,
    ``top`` and ``side``, site ``tool_tip``.
    """
    spec = mujoco.MjSpec.from_file(str(MODEL_PATH))
    spec.modelname = "push_box"
    _set_options(spec)
    _prepare_robot(spec, scene)
    _add_table(spec)
    _add_object(spec, scene)
    _add_goal(spec, scene.plant)
    add_looks(spec)
    return spec.compile()


def _set_options(spec: mujoco.MjSpec) -> None:
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    # The elliptic cone has isotropic friction; impratio > 1 makes friction stiffer than the normal, against
    # creep.
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 10.0
    spec.option.iterations = 20
    spec.option.tolerance = 1e-8


def _prepare_robot(spec: mujoco.MjSpec, scene: Scene) -> None:
    robot = fr3_pusher()
    for name, limit, friction, damping in zip(
        robot.joint_names, robot.torque_limits, _JOINT_FRICTION, _JOINT_DAMPING, strict=True
    ):
        joint = spec.joint(name)
        joint.frictionloss = friction * scene.joint_friction
        joint.damping = np.array([damping * scene.joint_damping, 0.0, 0.0])
        motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.set_to_motor()
        motor.ctrlrange = [-limit, limit]
    # A capsule meets boxes in MuJoCo's exact, fast routine; above its round end (1.5 cm) it is the rod.
    spec.body("tool").add_geom(
        name="rod",
        type=mujoco.mjtGeom.mjGEOM_CAPSULE,
        fromto=[0, 0, 0.05, 0, 0, TOOL_LENGTH - TOOL_RADIUS],
        size=[TOOL_RADIUS, 0, 0],
        mass=0.0,
        group=3,
        contype=_ROD,
        conaffinity=0,
    )


def _add_table(spec: mujoco.MjSpec) -> None:
    spec.worldbody.add_geom(
        name="table",
        type=mujoco.mjtGeom.mjGEOM_PLANE,
        size=[2, 2, 0.1],
        group=3,
        contype=0,
        conaffinity=_ROBOT | _ROD,
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
    for i, (kind, pos, size, quat) in enumerate(_solids(plant.shape, plant.height)):
        body.add_geom(
            name=f"object{i}", type=kind, pos=pos, size=size, quat=quat, rgba=_OBJECT_COLOUR, group=2,
            contype=0, conaffinity=_ROBOT,
        )  # fmt: skip
        _add_pair(spec, "rod", f"object{i}", plant.tool_friction, time_constant=0.01)
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
    for kind, pos, size, quat in _solids(plant.shape, 0.002):
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


def _solids(shape: PlanarShape, height: float):
    """Type, position, size and quaternion of one geom per primitive, standing on the object frame's z = 0."""
    for p in shape.primitives:
        pos = [*p.center, height / 2]
        if isinstance(p, Disc):
            yield mujoco.mjtGeom.mjGEOM_CYLINDER, pos, [p.radius, height / 2, 0.0], [1.0, 0.0, 0.0, 0.0]
        else:
            turn = [math.cos(p.angle / 2), 0.0, 0.0, math.sin(p.angle / 2)]
            yield mujoco.mjtGeom.mjGEOM_BOX, pos, [*p.half_size, height / 2], turn


def _primitive_feet(primitive: Rectangle | Disc, support: str) -> NDArray[np.float64]:
    """Feet under one primitive, in the object frame; see :meth:`ObjectPlant.feet`."""
    signs = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])
    if isinstance(primitive, Disc):
        half, angle = np.full(2, primitive.radius * math.sqrt(0.5)), 0.0
        # Four fifths of the load at this share of the radius: the second moment of a disc, r²/2.
        share = math.sqrt(5.0 / 8.0)
    else:
        half, angle = np.array(primitive.half_size), primitive.angle
        share = math.sqrt(5.0 / 12.0)  # likewise for a rectangle: half²/3 along each axis
    local = signs * half if support == "corners" else np.vstack([signs * half * share, np.zeros((1, 2))])
    turn = np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])
    return local @ turn.T + primitive.center


def _first_of_each(points: NDArray) -> list[int]:
    """Indices of points that do not repeat an earlier one."""
    return [i for i, p in enumerate(points) if i == 0 or np.linalg.norm(points[:i] - p, axis=1).min() > 1e-6]


def _inside_hull(points: NDArray, query: NDArray) -> bool:
    """Whether a point is inside the hull of others: seen from it, no gap between them spans 180 degrees."""
    angles = np.sort(np.arctan2(points[:, 1] - query[1], points[:, 0] - query[0]))
    gaps = np.diff(np.append(angles, angles[0] + 2.0 * np.pi))
    return bool(gaps.max() < np.pi - 1e-3)
