"""The model of the air-hockey world: table, puck, mallet and arm, with what their contacts are made of.

The planners never see this file's numbers: they are the plant. MuJoCo's world frame is the robot's base
frame.
"""

import math
from dataclasses import dataclass

import mujoco
import numpy as np

from sim_bridge.arm_world import TIMESTEP
from sim_bridge.hockey import table as t
from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.robot.iiwa import JOINT_NAMES, MODEL_PATH

START_JOINTS = (0.0, -0.196, 0.0, -1.844, 0.0, 0.970, 0.0)  # [rad]; the mallet is then at (0.65, 0)
SURFACES = ("left", "right", "near", "far")
"""The rims: left (+y), right (-y), near (the robot's end) and far."""
MALLET_JOINTS = ("mallet_pitch", "mallet_roll")  # about y and about x of the rod's end; 0 is along the rod
MALLET_TORQUE = 10.0  # largest torque of each of the two [Nm]

# Collision bits: the puck meets rims and mallet; nothing else meets anything.
_PUCK, _FIXED = 1, 0
_RIM_HALF_WIDTH = 0.045
_SIDE_RIM_HEIGHT, _END_RIM_HEIGHT = 0.03, 0.02
_RIM_PERIOD, _MALLET_PERIOD = 0.00075, 0.006  # time constant times damping ratio, the softness [s]
_RIM_IMPEDANCE = (0.99, 0.999, 0.001, 0.5, 2.0)
_RIM_FRICTION = (10000.0, 0.0, 0.0)

_SURFACE_COLOUR = (0.93, 0.95, 0.97, 1.0)
_RIM_COLOUR = (0.30, 0.34, 0.40, 1.0)
_POST_COLOUR = (0.55, 0.58, 0.62, 1.0)
_GOAL_COLOUR = (0.16, 0.66, 0.36, 0.6)
_PUCK_COLOUR = (0.86, 0.16, 0.16, 1.0)
_MARK_COLOUR = (1.0, 1.0, 1.0, 1.0)
_MALLET_COLOUR = (0.13, 0.30, 0.62, 1.0)


@documented
@dataclass(frozen=True)
class AirHockeyScene:
    """Everything an air-hockey world starts from.

    The contacts are springs with damping that cannot pull: a damping ratio ζ gives a restitution of about
    exp(-2 ζ / √(1 - ζ²) atan(√(1 - ζ²) / ζ)), relative to the other body's speed at the end; on the rims
    with scatter, because they are stiff for the time step, and above 0.15 the scatter would be all there is.
    Real tables have less drag (0.35 /s) and livelier rims (restitution 0.92, damping 0.0265) and mallets
    (0.8 and 0.075) than the defaults.

    Raises:
        ConfigurationError: naming the field, its value and what is allowed.
    """

    puck: tuple[float, float, float] = option(
        (1.0, 0.0, 0.0), "start pose of the puck (x, y, yaw), base frame", unit="m, rad",
        minimum=-10.0, maximum=10.0,
    )  # fmt: skip
    joints: tuple[float, ...] = option(
        START_JOINTS, "joint positions of the arm at the start", unit="rad", minimum=-4.0, maximum=4.0
    )
    drag: float = option(0.5, "drag of the sliding puck", unit="1/s", minimum=0.0, maximum=5.0)
    spin_drag: float = option(0.4, "drag of the spinning puck", unit="1/s", minimum=0.0, maximum=5.0)
    rim_damping: float = option(0.1, "damping ratio of contacts of rims and puck", minimum=0.02, maximum=0.15)
    mallet_damping: float = option(
        0.3, "damping ratio of contacts of mallet and puck", minimum=0.005, maximum=1.0
    )
    joint_friction: float = option(1.0, "scale of the dry friction of the joints", minimum=0.0, maximum=10.0)
    joint_damping: float = option(
        1.0, "scale of the viscous friction of the joints", minimum=0.0, maximum=10.0
    )

    def __post_init__(self) -> None:
        """Check the ranges."""
        validate(self)


def build(scene: AirHockeyScene) -> mujoco.MjModel:
    """Compile the world for MuJoCo; its frame is the robot's base frame.

    Names: joints of the arm (first in the state), of the mallet (see MALLET_JOINTS), ``puck_x``, ``puck_y``
    (table frame) and ``puck_yaw``; bodies ``puck`` and ``mallet``; geoms ``rim_left`` and so on; actuators
    as the joints they turn; site ``universal_joint``.
    """
    return specify(scene).compile()


def specify(scene: AirHockeyScene) -> mujoco.MjSpec:
    """The same before it is compiled, for those who add what is only seen."""
    spec = mujoco.MjSpec.from_file(str(MODEL_PATH))
    spec.modelname = "air_hockey"
    _set_options(spec)
    _add_motors(spec, scene)
    _hang_mallet(spec, scene)
    table = spec.worldbody.add_body(name="table", pos=t.TABLE_ORIGIN)
    _add_surface(table)
    _add_rims(table, scene)
    _add_puck(table, scene)
    return spec


def _set_options(spec: mujoco.MjSpec) -> None:
    # With this step a bounce off a rim lasts two steps: where in a step it begins decides its restitution,
    # mostly 0.70 to 0.77. When it begins in the last fifth, the second step is cut short and its damping
    # is missing: up to 1.04. That is the scatter of this table, and part of what planners must cope with.
    spec.option.timestep = TIMESTEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_EULER
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = 1.0


def _add_motors(spec: mujoco.MjSpec, scene: AirHockeyScene) -> None:
    """Torque motors of the arm, within its limits, and the joints' friction as scaled."""
    for name in JOINT_NAMES:
        joint = spec.joint(name)
        joint.frictionloss *= scene.joint_friction
        joint.damping *= scene.joint_damping
        _add_motor(spec, name, float(joint.actfrcrange[1]))


def _add_motor(spec: mujoco.MjSpec, joint: str, limit: float) -> None:
    motor = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
    motor.set_to_motor()
    motor.ctrlrange = [-limit, limit]


def _spring(period: float, damping: float) -> list[float]:
    """Contact parameters of one stiffness whatever the damping ratio.

    MuJoCo's stiffness goes with the inverse square of time constant times damping ratio: with less damping
    alone the contact would become too stiff for the step, and unstable.
    """
    return [period / damping, damping]


def _hang_mallet(spec: mujoco.MjSpec, scene: AirHockeyScene) -> None:
    """The mallet on two hinges at the end of the rod, in place of the load that stands for it there."""
    spec.delete(spec.body("mallet_load"))
    mallet = spec.body("mallet_link").add_body(name="mallet")
    mallet.explicitinertial = True
    mallet.mass = t.MALLET_MASS
    mallet.ipos = [0.0, 0.0, t.MALLET_COM_OFFSET]
    mallet.inertia = np.full(3, t.MALLET_INERTIA)
    for name, axis in zip(MALLET_JOINTS, ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0]), strict=True):
        hinge, reach = mujoco.mjtJoint.mjJNT_HINGE, math.pi / 2
        mallet.add_joint(name=name, type=hinge, axis=axis, range=[-reach, reach])
        _add_motor(spec, name, MALLET_TORQUE)
    mallet.add_geom(
        name="mallet", type=mujoco.mjtGeom.mjGEOM_CYLINDER, pos=[0.0, 0.0, t.MALLET_OFFSET],
        size=[t.MALLET_RADIUS, t.MALLET_HALF_HEIGHT, 0.0], rgba=_MALLET_COLOUR, group=2,
        contype=_FIXED, conaffinity=_PUCK, condim=4, friction=[0.0, 0.0, 0.0],
        solref=_spring(_MALLET_PERIOD, scene.mallet_damping),
    )  # fmt: skip


def _add_puck(table, scene: AirHockeyScene) -> None:
    puck = table.add_body(name="puck", pos=[0.0, 0.0, t.PUCK_HEIGHT / 2])
    slide, hinge = mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE
    drag, spin_drag = scene.drag * t.PUCK_MASS, scene.spin_drag * t.PUCK_INERTIA
    for name, kind, axis, damping in (
        ("puck_x", slide, [1.0, 0.0, 0.0], drag),
        ("puck_y", slide, [0.0, 1.0, 0.0], drag),
        ("puck_yaw", hinge, [0.0, 0.0, 1.0], spin_drag),
    ):
        puck.add_joint(name=name, type=kind, axis=axis, damping=[damping, 0.0, 0.0])
    puck.explicitinertial = True
    puck.mass = t.PUCK_MASS
    puck.inertia = np.full(3, t.PUCK_INERTIA)  # it turns about z only
    puck.add_geom(
        name="puck", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[t.PUCK_RADIUS, t.PUCK_HEIGHT / 2, 0.0],
        rgba=_PUCK_COLOUR, group=2, contype=_PUCK, conaffinity=_FIXED, condim=4,
        friction=[1.0, 0.005, 0.0001], solref=_spring(_MALLET_PERIOD, scene.mallet_damping),
    )  # fmt: skip
    _decorate(puck, [0.6 * t.PUCK_RADIUS, 0.0, t.PUCK_HEIGHT / 2], [0.008, 0.003, 0.0005], _MARK_COLOUR)


def _add_rims(table, scene: AirHockeyScene) -> None:
    """Side rims, and end rims left and right of each goal's mouth with rounded posts."""
    box, half = mujoco.mjtGeom.mjGEOM_BOX, _RIM_HALF_WIDTH
    length = t.HALF_LENGTH + 2 * half
    for side, name in ((1.0, "left"), (-1.0, "right")):
        pos = [0.0, side * (t.HALF_WIDTH + half), _SIDE_RIM_HEIGHT / 2]
        _add_rim(table, scene, f"rim_{name}", box, pos, [length, half, _SIDE_RIM_HEIGHT / 2])
    for end, name in ((1.0, "far"), (-1.0, "near")):
        for side, which in ((1.0, "left"), (-1.0, "right")):
            _add_end_rim(table, scene, f"rim_{name}_{which}", end, side)


def _add_end_rim(table, scene: AirHockeyScene, name: str, end: float, side: float) -> None:
    """A box for the face, one that is set back by the post's radius for the goal's side, and the post."""
    box, cylinder = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER
    x, r, z = t.HALF_LENGTH, t.POST_RADIUS, _END_RIM_HEIGHT / 2
    back, outer = x + 2 * _RIM_HALF_WIDTH, t.HALF_WIDTH
    face = (x, back, t.GOAL_HALF_WIDTH + r, outer)
    mouth = (x + r, back, t.GOAL_HALF_WIDTH, t.GOAL_HALF_WIDTH + r)
    for part, (x0, x1, y0, y1) in (("", face), ("_mouth", mouth)):
        pos = [end * (x0 + x1) / 2, side * (y0 + y1) / 2, z]
        _add_rim(table, scene, name + part, box, pos, [(x1 - x0) / 2, (y1 - y0) / 2, z])
    post = [end * (x + r), side * (t.GOAL_HALF_WIDTH + r), z]
    _add_rim(table, scene, name + "_post", cylinder, post, [r, z, 0.0])


def _add_rim(table, scene: AirHockeyScene, name: str, kind, pos, size) -> None:
    # A puck at a post touches two surfaces at once. If it stuck to both, where one's tangent is almost the
    # other's normal, the solver would throw it off at many times its speed: only faces have friction.
    corner = name.endswith(("_post", "_mouth"))
    table.add_geom(
        name=name, type=kind, pos=pos, size=size, rgba=_RIM_COLOUR, group=2, contype=_FIXED,
        conaffinity=_PUCK, condim=1 if corner else 6, priority=1, friction=_RIM_FRICTION,
        solref=_spring(_RIM_PERIOD, scene.rim_damping), solimp=_RIM_IMPEDANCE,
    )  # fmt: skip


def _add_surface(table) -> None:
    """What is only seen: the playing surface, and a line across the mouth of each goal."""
    x, y, half = t.HALF_LENGTH, t.HALF_WIDTH, 2 * _RIM_HALF_WIDTH
    _decorate(table, [0.0, 0.0, -0.0105], [x + half, y + half, 0.01], _SURFACE_COLOUR)
    for end in (1.0, -1.0):
        _decorate(table, [end * x, 0.0, -0.0004], [0.004, t.GOAL_HALF_WIDTH, 0.0004], _GOAL_COLOUR)
    _decorate(table, [0.0, 0.0, -0.0004], [0.002, y, 0.0004], _POST_COLOUR)


def _decorate(body, pos, size, colour) -> None:
    body.add_geom(
        type=mujoco.mjtGeom.mjGEOM_BOX, pos=pos, size=size, rgba=colour, group=2, contype=0, conaffinity=0,
        mass=0.0,
    )  # fmt: skip
