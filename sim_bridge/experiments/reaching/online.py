"""Closed loop among obstacles that move or appear: the motion is planned anew twenty times a second."""

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.reaching.cells import ReachTask
from vpsto_ros.collision.arm import ArmCollision
from vpsto_ros.collision.arm_cost import ArmPathCost
from vpsto_ros.collision.shapes import Capsule, Shape, Sphere
from vpsto_ros.planning.joint_space import JointSpaceMpc, JointSpaceMpcConfig, JointSpacePlan
from vpsto_ros.robot.kinematics import forward_kinematics_batch
from vpsto_ros.trajectory import Limits, Trajectory

PERIOD = 0.05  # between two plans [s]
TIMEOUT = 15.0  # [s]
MARGIN = 0.02  # of new plans [m]
KEPT_MARGIN = 0.005  # of the motion that is being executed [m]
_RADIUS = 0.07  # of the intruder [m]
_ROOM = 0.12  # between the intruder and the arm in the beginning, and its goal posture [m]
_REACTION = 0.3  # time in which the motion stays that far away [s]
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
        replanned: whether the intruder was in the way of a motion that was being executed.
    """

    reached: bool
    collisions: int
    duration: float
    replanning_ms: list[float]
    replanned: bool


def random_intruder(
    task: ReachTask, motion: Trajectory, now: float, rng: np.random.Generator, *, moving: bool
) -> Intruder | None:
    """A ball that shows up now, in the way of the motion that is being executed; None if there is no room.

    It will be where the tool would pass. What the arm cannot avoid is no test of a planner: for the next
    0.3 s, in which the planner has to see it and the arm to brake, the motion stays 12 cm away from it, and
    it leaves the goal posture as much room.
    """
    bare = ArmCollision(None, ())
    soon = motion(now + np.linspace(0.0, _REACTION, 7))
    for _ in range(500):
        meet = rng.uniform(now + 0.4, max(now + 0.4, motion.end_time - 0.1))
        centre = forward_kinematics_batch(motion(meet)[None])[0] + rng.normal(0.0, 0.05, 3)
        velocity = np.zeros(3)
        if moving:
            direction = rng.normal(size=3) * [1.0, 1.0, 0.3]
            velocity = rng.uniform(0.1, 0.25) * direction / np.linalg.norm(direction)
        intruder = Intruder(now, centre - (meet - now) * velocity, velocity)
        if bare.with_obstacles([intruder.ahead(now)]).distance(soon).min() < _ROOM:
            continue
        later = (0.0, 0.5, 1.0, 2.0, 3.0) if moving else (0.0,)
        passing = [bare.with_obstacles([intruder.at(meet + wait)]).distance(task.goal) for wait in later]
        if min(passing) > _ROOM:
            return intruder
    return None


def run_online(
    task: ReachTask,
    first: Trajectory,
    limits: Limits,
    seed: int,
    *,
    moving: bool = False,
    intruder: Intruder | None = None,
) -> OnlineRun | None:
    """Execute a first plan and correct it; None if there was no room for an intruder.

    Args:
        task: cell and goal.
        first: plan to begin with.
        limits: of the joints.
        seed: of the planner and the intruder.
        moving: whether the intruder moves.
        intruder: instead of a random one, which shows up after 10 to 40 % of the first plan.
    """
    rng = np.random.default_rng([seed, 1])
    mpc = JointSpaceMpc(limits, JointSpaceMpcConfig(spread=0.4), np.random.default_rng(seed))
    mpc.begin(task.start, 0.0)
    mpc.accept(JointSpacePlan(first, "explore", "explore", True, first.duration))
    cell, blocked = ArmCollision(None, task.obstacles), False
    show = first.duration * rng.uniform(0.1, 0.4) if intruder is None else intruder.time
    now, collisions, times = 0.0, 0, []
    while now < TIMEOUT:
        if now >= show and intruder is None:
            intruder = random_intruder(task, mpc.reference, now, rng, moving=moving)
            if intruder is None:
                return None
        seen = _seen(task.obstacles, intruder, now, now + PERIOD)
        begin = time.thread_time()
        checker = cell.with_obstacles(seen)
        plan = mpc.step(
            now + PERIOD, task.goal, (ArmPathCost(checker.with_margin(MARGIN), proof_margin=0.5 * MARGIN),),
            tolerated=(ArmPathCost(checker.with_margin(KEPT_MARGIN)),),
            deadline=begin + 0.8 * PERIOD, clock=time.thread_time,
        )  # fmt: skip
        times.append(1e3 * (time.thread_time() - begin))
        if now >= show:
            blocked = blocked or not checker.free_along(mpc.reference.clipped(now, TIMEOUT + 1.0)).free
        collisions += _collisions(cell, task.obstacles, intruder, mpc.reference, now)
        mpc.accept(plan)
        now += PERIOD
        if plan.mode == "hold" and now > show:
            break
    at_goal = bool(np.abs(mpc.reference(now) - task.goal).max() < 1e-3)
    return OnlineRun(at_goal, collisions, now, times, blocked)


def _seen(
    obstacles: tuple[Shape, ...], intruder: Intruder | None, now: float, then: float
) -> tuple[Shape, ...]:
    """What the planner knows at `now` about the time from `then` on."""
    if intruder is None or now < intruder.time:
        return obstacles
    return (*obstacles, intruder.ahead(then))


def _collisions(
    cell: ArmCollision,
    obstacles: tuple[Shape, ...],
    intruder: Intruder | None,
    motion: Trajectory,
    now: float,
) -> int:
    """Postures in collision during one period of the executed motion."""
    hits = 0
    for time_ in now + np.linspace(0.0, PERIOD, _CHECKS)[1:]:
        there = (intruder.at(time_),) if intruder is not None and time_ >= intruder.time else ()
        hits += bool(cell.with_obstacles((*obstacles, *there)).in_collision(motion(time_)))
    return hits
