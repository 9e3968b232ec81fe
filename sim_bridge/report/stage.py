"""What a run is drawn on: the cell with robot and object, and where one looks at it from."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Protocol

import mujoco
import numpy as np

from sim_bridge.hockey import scene as hockey
from sim_bridge.hockey import table
from sim_bridge.hockey.mallet import Mallet
from sim_bridge.looks import add_camera, add_light, set_quality
from sim_bridge.scene import Scene, build
from vpsto_ros.robot.iiwa import JOINT_NAMES

if TYPE_CHECKING:
    from sim_bridge.report.view import Frame

CAMERA = "overview"
"""Name of the camera from which videos are made."""
Point = tuple[float, float, float]


@dataclasses.dataclass(frozen=True)
class Viewpoint:
    """From where a viewer looks at first.

    Attributes:
        eye: of the viewer [m].
        target: in the middle of the picture [m].
        field: of view, up and down [rad].
    """

    eye: Point
    target: Point
    field: float


class Stage(Protocol):
    """A cell to be drawn; it goes to another process for videos."""

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The robot's joints, in the order of a frame's positions."""

    @property
    def viewpoint(self) -> Viewpoint:
        """From where one looks."""

    @property
    def height(self) -> float:
        """Of the object, above which what nodes draw is shown [m]."""

    def build(self) -> mujoco.MjModel:
        """The model, with a camera named :data:`CAMERA`."""

    def place(self, model: mujoco.MjModel, data: mujoco.MjData, frame: Frame) -> None:
        """Put everything but the robot's joints where a frame says."""


@dataclasses.dataclass(frozen=True)
class PushingStage:
    """A robot, an object on a table and the marker of its target."""

    scene: Scene
    viewpoint = Viewpoint((1.42, -0.92, 0.92), (0.36, 0.0, 0.17), math.radians(42.0))

    @property
    def joint_names(self) -> tuple[str, ...]:
        """The robot's joints."""
        return self.scene.kind.load().joint_names

    @property
    def height(self) -> float:
        """Of the object [m]."""
        return self.scene.plant.height

    def build(self) -> mujoco.MjModel:
        """The model of the simulation, which has furniture and cameras."""
        return build(self.scene)

    def place(self, model: mujoco.MjModel, data: mujoco.MjData, frame: Frame) -> None:
        """Put object and target marker where they are."""
        start, goal = model.joint("object").qposadr[0], model.body("goal").mocapid[0]
        if frame.object_pose is not None:
            x, y, yaw = frame.object_pose
            data.qpos[start : start + 7] = (x, y, 0.0, math.cos(yaw / 2), 0.0, 0.0, math.sin(yaw / 2))
        # A target is drawn turned like the object, for it has no orientation; else it hides below the table.
        place = (0.5, 0.0, -0.5)
        if frame.target is not None and np.all(np.isfinite(frame.target[:2])):
            place = (*frame.target[:2], 0.0005)
        data.mocap_pos[goal] = place
        data.mocap_quat[goal] = data.qpos[start + 3 : start + 7]


@dataclasses.dataclass(frozen=True)
class AirHockeyStage:
    """An air-hockey table with its robot; the mallet is drawn hanging vertically."""

    scene: hockey.AirHockeyScene
    joint_names = JOINT_NAMES
    height = table.PUCK_HEIGHT
    viewpoint = Viewpoint((0.4, -1.9, 1.8), (1.12, 0.0, 0.17), math.radians(44.0))

    def build(self) -> mujoco.MjModel:
        """The model of the simulation with light and a camera."""
        spec = hockey.specify(self.scene)
        set_quality(spec, (1.4, 0.0, 0.2), 2.0)
        add_light(spec)
        add_camera(
            spec.worldbody, CAMERA, self.viewpoint.eye, self.viewpoint.target,
            math.degrees(self.viewpoint.field),
        )  # fmt: skip
        return spec.compile()

    def place(self, model: mujoco.MjModel, data: mujoco.MjData, frame: Frame) -> None:
        """Put the puck where it is, and hang the mallet below the rod."""
        if frame.object_pose is not None:
            puck = model.joint("puck_x").qposadr[0]
            data.qpos[puck : puck + 2] = table.to_table(frame.object_pose[:2])
            data.qpos[puck + 2] = frame.object_pose[2]
        mujoco.mj_kinematics(model, data)
        Mallet(model, data).hang()
