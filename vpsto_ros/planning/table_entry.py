"""Getting a standing arm from any posture above the table into the plane in which it pushes."""

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact.pushing import PushingModel
from vpsto_ros.exceptions import InfeasibleError
from vpsto_ros.planning.table_path import TablePath
from vpsto_ros.planning.workspace import Workspace
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import forward_kinematics_batch
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, synthesize

RAISED = 0.15
"""Height above the plane at which the tool passes over objects [m]."""
CAREFULLY = 0.25
"""Share of the joint limits that is used on the way into the plane."""


def free_spots(workspace: Workspace, model: PushingModel, pose: NDArray) -> NDArray:
    """Tool positions on a coarse grid inside the workspace and clear of the object, shape (K, 2) [m]."""
    x, y = np.meshgrid(
        np.arange(0.1, workspace.radius_max, 0.03), np.arange(-workspace.side, workspace.side + 0.01, 0.03)
    )
    spots = np.column_stack([x.ravel(), y.ravel()])
    inside = workspace.tool_excess(spots[:, None]) <= 0.0
    clear = np.hypot(*(spots - pose[:2]).T) > model.shape.bounding_radius + model.tool.bounding_radius + 0.02
    return spots[inside & clear]


def enter_plane(
    path: TablePath, model: PushingModel, workspace: Workspace, position: NDArray, pose: NDArray, start: float
) -> Trajectory:
    """Over the table to a free spot near the tool, then straight down into the plane, resting in between.

    Args:
        path: the plane and the arm.
        model: shapes of object and tool.
        workspace: region of the tool.
        position: joint positions of the standing arm, shape (7,) [rad].
        pose: object pose, shape (3,).
        start: start time [s].

    Raises:
        InfeasibleError: there is no free spot, or the way there would sweep below the plane or through the
            object.
    """
    spots = free_spots(workspace, model, pose)
    if not len(spots):
        raise InfeasibleError("no free spot on the table to lower the tool to")
    tool = path.robot.forward(position)[0][:2]
    spot = spots[np.hypot(*(spots - tool).T).argmin()][None]
    raised = TableMap(path.robot, path.table_map.height + RAISED).joints(spot)[0]
    limits = path.robot.limits
    slow = Limits(CAREFULLY * limits.velocity, CAREFULLY * limits.acceleration, limits.lower, limits.upper)
    over = _move(position, raised, slow, start)
    _check_clearance(over, path, model, pose)
    return over.followed_by(_move(raised, path.table_map.joints(spot)[0], slow, over.end_time))


def _move(start: NDArray, end: NDArray, limits: Limits, start_time: float) -> Trajectory:
    rest = np.zeros_like(start)
    trajectory = synthesize(
        OptimalBasis.uniform(0), np.stack([start, end]), rest, rest, limits, start_time=start_time
    )
    broken = trajectory.violations(limits)
    if broken:
        raise InfeasibleError("the arm cannot move into its plane from here: " + "; ".join(broken))
    return trajectory


def _check_clearance(motion: Trajectory, path: TablePath, model: PushingModel, pose: NDArray) -> None:
    tips = forward_kinematics_batch(motion(np.linspace(motion.start_time, motion.end_time, 200)))
    near = (
        np.hypot(*(tips[:, :2] - pose[:2]).T)
        < model.shape.bounding_radius + model.tool.bounding_radius + 0.02
    )
    height = tips[:, 2] - path.table_map.height
    if (height < -path.height_tolerance).any() or (near & (height < 0.6 * RAISED)).any():
        raise InfeasibleError(
            "on its way into the plane the tool would touch the table or the object; raise the arm first"
        )
