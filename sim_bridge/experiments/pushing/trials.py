"""Random pushing trials and how they are judged; shared by the experiments on boxes and on the T."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from sim_bridge.camera import CameraConfig
from sim_bridge.experiments.pushing.loop import PushingLoop
from sim_bridge.scene import ObjectPlant, Scene
from sim_bridge.simulation import Simulation
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.planning.goal import PlanarGoal, wrap_angle
from vpsto_ros.planning.workspace import Workspace

CHECK = 0.05
"""Period at which success is judged on the ground truth [s]."""

KNOCK_MARGIN = 0.03
"""A hand lets the object go at least so far from the border of the workspace [m]."""


@dataclasses.dataclass(frozen=True)
class Trial:
    """One random trial; everything but the shape and the goal is unknown to the planner.

    Attributes:
        seed: of everything random in the run.
        plant: the object as it is.
        start: object pose at the beginning (3,).
        goal: goal pose (3,).
        knock: displacement by hand (2,) [m], None for no knock.
        knock_time: when [s].
        time_limit: end of the trial [s].
        position_tolerance: within which the object must be [m].
        yaw_tolerance: the same for its orientation [rad], None if any will do.
    """

    seed: int
    plant: ObjectPlant
    start: NDArray
    goal: NDArray
    knock: NDArray | None
    knock_time: float
    time_limit: float
    position_tolerance: float = 0.010
    yaw_tolerance: float | None = None

    @property
    def planar_goal(self) -> PlanarGoal:
        """The goal as the planner gets it."""
        return PlanarGoal(self.goal[:2], None if self.yaw_tolerance is None else float(self.goal[2]))

    def reached(self, pose: NDArray) -> bool:
        """Whether an object pose counts as at the goal."""
        near = np.hypot(*(pose[:2] - self.goal[:2])) <= self.position_tolerance
        turned = abs(float(wrap_angle(pose[2] - self.goal[2])))
        return bool(near and (self.yaw_tolerance is None or turned <= self.yaw_tolerance))


@dataclasses.dataclass(frozen=True)
class TrialResult:
    """How a trial went; times count from the end of the knock (from the start without one)."""

    seed: int
    success: bool
    time_to_goal: float | None
    time_to_goal_before_knock: float | None
    final_error: float
    final_yaw_error: float
    limit_violations: int
    left_workspace: bool
    planned_height_error: float
    tool_height_error: float
    rejected: int
    compute: tuple[float, ...]
    modes: tuple[str, ...]
    times: NDArray
    object_path: NDArray
    tool_path: NDArray


def random_plant(shape: PlanarShape, offset_scale: NDArray, rng: np.random.Generator) -> ObjectPlant:
    """Mass 0.2-1 kg, table friction 0.2-0.6, tool friction 0.1-0.5, mass off centre by 20 % of a scale."""
    return ObjectPlant(
        shape=shape,
        mass=float(rng.uniform(0.2, 1.0)),
        table_friction=float(rng.uniform(0.2, 0.6)),
        tool_friction=float(rng.uniform(0.1, 0.5)),
        com_offset=tuple(rng.uniform(-0.2, 0.2, 2) * offset_scale),
        support=str(rng.choice(["corners", "spread"])),
    )


def random_knock(rng: np.random.Generator) -> NDArray:
    """A displacement of 5-10 cm in any direction."""
    length, angle = rng.uniform(0.05, 0.10), rng.uniform(-np.pi, np.pi)
    return length * np.array([np.cos(angle), np.sin(angle)])


def start_joints(planner_map, object_pose: NDArray, shape: PlanarShape) -> NDArray:
    """Joint positions with the tool in the plane, beside the object on the robot's side."""
    direction = -object_pose[:2] / np.hypot(*object_pose[:2])
    tool = object_pose[:2] + (shape.bounding_radius + 0.06) * direction
    radius = np.hypot(*tool)
    return planner_map.joints((tool * max(radius, 0.31) / radius)[None])[0]


def simulate(trial: Trial, joints: NDArray) -> Simulation:
    """The cell of a trial: camera 2 mm / 1 degree, 40 ms late, 5 % drop-outs."""
    scene = Scene(
        plant=trial.plant, object_pose=tuple(trial.start.tolist()), start_joints=tuple(joints.tolist())
    )
    return Simulation(scene, seed=trial.seed, camera=CameraConfig())


def run_trial(trial: Trial, loop: PushingLoop, workspace: Workspace) -> TrialResult:
    """Run the closed loop until the goal is held after the knock, or until the time is up."""
    sim, dwell = loop.simulation, 0.0
    begin: float | None = 0.0 if trial.knock is None else None
    reached_at: float | None = None
    before_knock: float | None = None
    inside = True
    while sim.time < trial.time_limit and dwell < 1.0 - 1e-9:
        if trial.knock is not None and begin is None and sim.time >= trial.knock_time:
            before_knock = reached_at
            begin = _knock(loop, trial.knock, workspace)
            reached_at, dwell = None, 0.0
        loop.advance(CHECK)
        pose = np.asarray(sim.object_pose())
        inside &= workspace.contains_object(pose)
        if trial.reached(pose):
            reached_at = sim.time if reached_at is None else reached_at
            dwell = sim.time - reached_at if begin is not None else 0.0
        else:
            reached_at, dwell = None, 0.0
    success = dwell >= 1.0 - 1e-9
    held_since = reached_at - begin if success and reached_at is not None and begin is not None else None
    pose = np.asarray(sim.object_pose())
    record = loop.recording
    return TrialResult(
        seed=trial.seed, success=success, time_to_goal=held_since,
        time_to_goal_before_knock=before_knock,
        final_error=float(np.hypot(*(pose[:2] - trial.goal[:2]))),
        final_yaw_error=abs(float(wrap_angle(pose[2] - trial.goal[2]))),
        limit_violations=sim.limits.violations, left_workspace=not inside,
        planned_height_error=record.planned_height_error, tool_height_error=sim.tool_height_deviation,
        rejected=len(record.rejected), compute=tuple(record.compute), modes=tuple(record.mode),
        times=np.array(record.time),
        object_path=np.array(record.object_pose), tool_path=np.array(record.tool),
    )  # fmt: skip


def _knock(loop: PushingLoop, knock: NDArray, workspace: Workspace) -> float:
    """Let a hand move the object, away from the border; returns the time at which the hand lets go."""
    sim = loop.simulation
    center, length = np.asarray(sim.object_pose())[:2], np.hypot(*knock)
    bearing = np.arctan2(knock[1], knock[0])
    # The first direction, from the drawn one on, that ends well inside.
    for turn in np.arange(0.0, 2.0 * np.pi, 0.1):
        knock = length * np.array([np.cos(bearing + turn), np.sin(bearing + turn)])
        if float(workspace.object_excess(np.append(center + knock, 0.0)[None], KNOCK_MARGIN)) == 0.0:
            break
    else:
        middle = np.array([np.mean(workspace.object_x), np.mean(workspace.object_y)])
        knock = length * (middle - center) / np.hypot(*(middle - center))
    sim.knock(knock, duration=0.25)
    loop.advance(0.25)
    return sim.time
