"""Closed loop among obstacles that move or appear: the motion is planned anew twenty times a second."""

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.reach_cells import ReachTask
from vpsto_ros.collision.arm import ArmCollision
from vpsto_ros.collision.arm_cost import ArmPathCost
from vpsto_ros.collision.shapes import Capsule, Shape, Sphere
from vpsto_ros.planning.joint_space import JointSpaceMpc, JointSpaceMpcConfig, JointSpacePlan
from vpsto_ros.trajectory import Limits, Trajectory

PERIOD = 0.05  # between two plans [s]
TIMEOUT = 15.0  # [s]
MARGIN = 0.02  # of new plans [m]
KEPT_MARGIN = 0.005  # of the motion that is being executed [m]
_RADIUS = 0.07  # of the intruder [m]
_ROOM = 0.12  # between the intruder and the arm when it shows up, and its goal posture [m]
_FORESIGHT = 0.5  # how far ahead the intruder's straight motion is kept clear [s]
_CHECKS = 11  # postures checked per period, 5 ms apart


@dataclasses.dataclass(frozen=True)
class Intruder:
    """A ball that shows up at some time and then moves uniformly.

    Attributes:
        time: when it shows up [s].
        centre: where, shape (3,) [m].
        velocity: shape (3,), zero if it stays [m/s].
    """

    time: float
    centre: NDArray[np.float64]
    velocity: NDArray[np.float64]

    def at(self, time: float) -> Sphere:
        """The ball at a time."""
        return Sphere(self.centre + (time - self.time) * self.velocity, _RADIUS, "intruder")

    def ahead(self, time: float) -> Capsule:
        """What it sweeps in the near future."""
        a = self.centre + (time - self.time) * self.velocity
        return Capsule(a, a + _FORESIGHT * self.velocity, _RADIUS, "intruder")


@dataclasses.dataclass(frozen=True)
class OnlineRun:
    """What happened.

    Attributes:
        reached: whether the arm came to rest at the goal in time.
        collisions: postures in collision of those checked every 5 ms, with the ball where it is then.
        duration: until the goal [s].
        replanning_ms: processor times of the planning steps.
        replanned: whether the first plan collides with the intruder.
    """

    reached: bool
    collisions: int
    duration: float
    replanning_ms: list[float]
    replanned: bool


def random_intruder(
    task: ReachTask, plan: Trajectory, rng: np.random.Generator, *, moving: bool
) -> Intruder | None:
    """A ball in the way of a plan: it will be where a part of the arm will pass; None if there is no room.

    It shows up at least 12 cm from the arm, and where it stays it leaves the goal posture as much room.
    """
    from vpsto_ros.robot.kinematics import forward_kinematics_batch

    bare = ArmCollision(None, ())
    for _ in range(500):
        show, meet = plan.duration * rng.uniform(0.1, 0.4), plan.duration * rng.uniform(0.4, 0.9)
        centre = forward_kinematics_batch(plan(meet)[None])[0] + rng.normal(0.0, 0.05, 3)
        velocity = np.zeros(3)
        if moving:
            direction = rng.normal(size=3) * [1.0, 1.0, 0.3]
            velocity = rng.uniform(0.1, 0.25) * direction / np.linalg.norm(direction)
        intruder = Intruder(show, centre - (meet - show) * velocity, velocity)
        room = [bare.with_obstacles([intruder.at(show)]).distance(plan(show)) > _ROOM]
        later = (0.0, 0.5, 1.0, 2.0, 3.0) if moving else (0.0,)
        room += [
            bare.with_obstacles([intruder.at(meet + wait)]).distance(task.goal) > _ROOM for wait in later
        ]
        if all(room):
            return intruder
    return None


def run_online(
    task: ReachTask, first: Trajectory, intruder: Intruder, limits: Limits, seed: int
) -> OnlineRun:
    """Execute a first plan and correct it."""
    mpc = JointSpaceMpc(limits, JointSpaceMpcConfig(spread=0.4), np.random.default_rng(seed))
    mpc.begin(task.start, 0.0)
    mpc.accept(JointSpacePlan(first, "explore", "explore", True, first.duration))
    cell = ArmCollision(None, task.obstacles)
    now, collisions, times = 0.0, 0, []
    while now < TIMEOUT:
        takeover = now + PERIOD
        seen = _seen(task.obstacles, intruder, now, takeover)
        begin = time.thread_time()
        checker = cell.with_obstacles(seen)
        plan = mpc.step(
            takeover, task.goal, (ArmPathCost(checker.with_margin(MARGIN), proof_margin=0.5 * MARGIN),),
            tolerated=(ArmPathCost(checker.with_margin(KEPT_MARGIN)),),
            deadline=begin + 0.8 * PERIOD, clock=time.thread_time,
        )  # fmt: skip
        times.append(1e3 * (time.thread_time() - begin))
        collisions += _collisions(cell, task.obstacles, intruder, mpc.reference, now)
        mpc.accept(plan)
        now = takeover
        if plan.mode == "hold" and now > intruder.time:
            break
    ahead = cell.with_obstacles(_seen(task.obstacles, intruder, intruder.time, intruder.time))
    blocked = not ahead.free_along(first).free
    at_goal = bool(np.abs(mpc.reference(now) - task.goal).max() < 1e-3)
    return OnlineRun(at_goal, collisions, now, times, blocked)


def _seen(obstacles: tuple[Shape, ...], intruder: Intruder, now: float, then: float) -> tuple[Shape, ...]:
    """What the planner knows at `now` about the time from `then` on."""
    return (*obstacles, intruder.ahead(then)) if now >= intruder.time else obstacles


def _collisions(
    cell: ArmCollision, obstacles: tuple[Shape, ...], intruder: Intruder, motion: Trajectory, now: float
) -> int:
    """Postures in collision during one period of the executed motion."""
    hits = 0
    for time_ in now + np.linspace(0.0, PERIOD, _CHECKS)[1:]:
        there = (intruder.at(time_),) if time_ >= intruder.time else ()
        hits += bool(cell.with_obstacles((*obstacles, *there)).in_collision(motion(time_)))
    return hits
