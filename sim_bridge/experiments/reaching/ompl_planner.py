"""The same moves with OMPL: RRT-Connect, its path simplified, then timed like our own motions.

OMPL is optional; without it :func:`available` is false. Its paths are polygons in joint space. The smoothest
motion through their corners cuts them, so the polygon is divided ever finer until the motion through its
points is proven free; between any two points the limits then set the speed, as for our own motions.
"""

import dataclasses
import importlib.util
import time

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.collision.arm import ArmCollision
from vpsto_ros.trajectory import Limits, OptimalBasis, Trajectory, synthesize

_RESOLUTION = 0.005  # of OMPL's check along an edge, as a share of the extent of the space
_FINEST = 160  # points along a polygon


@dataclasses.dataclass(frozen=True)
class OmplPlan:
    """Outcome of OMPL.

    Attributes:
        path: corners (K, 7) [rad] after simplification, None if it found none.
        trajectory: the motion along them, None if there is no path or no motion could be proven free.
        seconds: processor time of solving and simplifying [s].
    """

    path: NDArray[np.float64] | None
    trajectory: Trajectory | None
    seconds: float


def available() -> bool:
    """Whether the package is installed."""
    return importlib.util.find_spec("ompl") is not None


def plan_with_ompl(
    checker: ArmCollision, limits: Limits, start: NDArray, goal: NDArray, *, seconds: float
) -> OmplPlan:
    """RRT-Connect from start to goal with the checker's margin, simplified and timed.

    OMPL lets its random numbers be seeded only once per process, so its outcome is not reproducible.

    Args:
        checker: the arm in its cell; its margin is kept by the polygon, the motion has to be free without it.
        limits: of the joints.
        start: posture (7,) [rad].
        goal: posture (7,) [rad].
        seconds: time it may take [s].
    """
    import ompl.base as ob
    import ompl.geometric as og
    import ompl.util as ou

    ou.setLogLevel(ou.LogLevel.LOG_ERROR)
    space, bounds = ob.RealVectorStateSpace(7), ob.RealVectorBounds(7)
    lower, upper = limits.position_range
    for joint in range(7):
        bounds.setLow(joint, float(lower[joint]))
        bounds.setHigh(joint, float(upper[joint]))
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)
    setup.setStateValidityChecker(lambda state: not checker.in_collision([state[j] for j in range(7)]))
    information = setup.getSpaceInformation()
    information.setStateValidityCheckingResolution(_RESOLUTION)
    setup.setStartAndGoalStates(_state(space, start), _state(space, goal))
    setup.setPlanner(og.RRTConnect(information))
    begin = time.thread_time()
    if not setup.solve(seconds) or not setup.haveExactSolutionPath():
        return OmplPlan(None, None, time.thread_time() - begin)
    setup.simplifySolution()
    elapsed = time.thread_time() - begin
    found = setup.getSolutionPath()
    states = [found.getState(k) for k in range(found.getStateCount())]
    path = np.array([[state[j] for j in range(7)] for state in states])
    return OmplPlan(path, timed(path, checker, limits), elapsed)


def timed(path: NDArray, checker: ArmCollision, limits: Limits) -> Trajectory | None:
    """The motion along a polygon (K, 7), as fast as the limits allow, free without a margin; None if none is.

    Phases are proportional to the time that the velocity limits ask for on each edge.
    """
    steps = np.abs(np.diff(path, axis=0) / limits.velocity).max(axis=1)
    phases = np.concatenate([[0.0], np.cumsum(np.maximum(steps, 1e-6))])
    phases /= phases[-1]
    count = len(path) + 1
    while count <= _FINEST:
        even = np.linspace(0.0, 1.0, count)
        keys = np.stack([np.interp(even, phases, path[:, j]) for j in range(path.shape[1])], axis=1)
        motion = synthesize(OptimalBasis.uniform(count - 2), keys, np.zeros(7), np.zeros(7), limits)
        if checker.free_along(motion, margin=0.0).free and not motion.violations(limits):
            return motion
        count = count * 3 // 2 + 1
    return None


def _state(space, posture: NDArray):
    state = space.allocState()
    for joint in range(7):
        state[joint] = float(posture[joint])
    return state
