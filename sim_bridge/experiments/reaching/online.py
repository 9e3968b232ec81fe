"""Closed loop among obstacles that move or appear: the motion is planned anew twenty times a second.

The arm follows what it is told perfectly, with the latency of one period: what is decided from a measurement
takes effect one period later. The motion that was executed is judged as a whole, at every instant.
"""

import dataclasses
import itertools
import math
import time

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.reaching.cells import ReachTask
from vpsto_ros.collision.arm import ArmCollision
from vpsto_ros.collision.arm_cost import ArmPathCost
from vpsto_ros.collision.shapes import Capsule, Shape, Sphere
from vpsto_ros.planning.joint_space import JointSpaceMpc, JointSpaceMpcConfig, JointSpacePlan
from vpsto_ros.planning.stitching import extended, remainder
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
_SLICE = 0.005  # in which the intruder counts as all that it sweeps when a run is judged [s]
_TOLERANCE = 1e-4  # of the proofs then [m]
AT_GOAL, AT_REST = 1e-3, 1e-6  # of every joint at the end [rad, rad/s]
LARGEST_STEP = 1e-9  # between what two plans say about the same instant [rad, rad/s]
CONTROLLER = JointSpaceMpcConfig(spread=0.4)
"""Without a deadline: the search has its iterations, so that a run is the same on every machine."""


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
        return self.swept(time, time + _FORESIGHT)

    def swept(self, begin: float, end: float) -> Capsule:
        """What it sweeps from one time to another."""
        a, b = self.at(begin).centre, self.at(end).centre
        return Capsule(a, b, _RADIUS, "intruder")


@dataclasses.dataclass(frozen=True, eq=False)
class OnlineRun:
    """What happened.

    Attributes:
        motion: everything that was executed, stitched together.
        reached: whether the arm came to rest at the goal in time.
        contact: what could not be proven free of collision, and when, in words; None if all of it was.
        broken: limits exceeded at any instant, and steps in position or velocity, in words.
        blocked: whether the intruder was in the way of a motion that was being executed.
        step_seconds: processor time of every planning step [s].
    """

    motion: Trajectory
    reached: bool
    contact: str | None
    broken: list[str]
    blocked: bool
    step_seconds: NDArray[np.float64]


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
    mpc = JointSpaceMpc(limits, CONTROLLER, np.random.default_rng(seed))
    mpc.begin(task.start, 0.0)
    mpc.accept(JointSpacePlan(first, "explore", "explore", True, first.duration))
    cell, blocked = ArmCollision(None, task.obstacles), False
    show = first.duration * rng.uniform(0.1, 0.4) if intruder is None else intruder.time
    pieces: list[Trajectory] = []
    seconds = []
    for k in range(round(TIMEOUT / PERIOD)):
        now, after = k * PERIOD, (k + 1) * PERIOD
        if now >= show and intruder is None:
            intruder = random_intruder(task, mpc.reference, now, rng, moving=moving)
            if intruder is None:
                return None
        begin = time.thread_time()
        checker = cell.with_obstacles(_seen(task.obstacles, intruder, now, after))
        plan = _planned(mpc, checker, task, after)
        seconds.append(time.thread_time() - begin)
        if now >= show:
            blocked = blocked or not checker.free_along(remainder(mpc.reference, now)).free
        pieces.append(_period(mpc.reference, now, after))
        mpc.accept(plan)
        if plan.mode == "hold" and now > show:
            break
    motion = stitched(pieces)
    contact = first_contact(motion, cell, intruder)
    return OnlineRun(
        motion, at_rest_at(motion, task.goal), contact, broken(motion, limits), blocked, np.array(seconds)
    )


def _planned(mpc: JointSpaceMpc, checker: ArmCollision, task: ReachTask, takeover: float) -> JointSpacePlan:
    """New plans keep a margin; the present one may come closer before it is given up."""
    careful = ArmPathCost(checker.with_margin(MARGIN), proof_margin=0.5 * MARGIN)
    just = ArmPathCost(checker.with_margin(KEPT_MARGIN))
    return mpc.step(takeover, task.goal, (careful,), tolerated=(just,))


def _seen(
    obstacles: tuple[Shape, ...], intruder: Intruder | None, now: float, then: float
) -> tuple[Shape, ...]:
    """What the planner knows at `now` about the time from `then` on."""
    if intruder is None or now < intruder.time:
        return obstacles
    return (*obstacles, intruder.ahead(then))


def _period(motion: Trajectory, begin: float, end: float) -> Trajectory:
    """What is executed in one period."""
    rest = extended(remainder(motion, begin), end)
    return rest.clipped(rest.start_time, end)


def stitched(pieces: list[Trajectory]) -> Trajectory:
    """One motion from pieces that follow each other in time, whatever their steps."""
    times = np.concatenate([[pieces[0].start_time], *(piece.times[1:] for piece in pieces)])
    return Trajectory(times, np.concatenate([piece.coefficients for piece in pieces]))


def at_rest_at(motion: Trajectory, goal: NDArray) -> bool:
    """Whether a motion ends at a posture (7,) [rad], without velocity."""
    position, velocity, _ = motion.state(motion.end_time)
    return bool(np.abs(position - goal).max() < AT_GOAL and np.abs(velocity).max() < AT_REST)


def broken(motion: Trajectory, limits: Limits) -> list[str]:
    """Limits that a motion exceeds at any instant, and its steps in position and velocity, in words."""
    position, velocity = (float(jump.max(initial=0.0)) for jump in motion.jumps())
    steps = [f"steps of {position:.3g} rad and {velocity:.3g} rad/s"]
    return motion.violations(limits) + (steps if max(position, velocity) > LARGEST_STEP else [])


def first_contact(motion: Trajectory, cell: ArmCollision, intruder: Intruder | None) -> str | None:
    """What a motion collides with first, in words; None if it is proven not to, at every instant.

    The obstacles that stand still at once; the intruder slice by slice of the time, as all that it sweeps in
    a slice.
    """
    found = cell.free_along(motion, tolerance=_TOLERANCE)
    if not found.free:
        return f"{', '.join(map(str, found.contacts))} at {found.time:.3f} s"
    if intruder is None or intruder.time >= motion.end_time:
        return None
    count = math.ceil((motion.end_time - intruder.time) / _SLICE)
    times = np.linspace(max(intruder.time, motion.start_time), motion.end_time, count + 1)
    for begin, end in itertools.pairwise(times):
        found = cell.with_obstacles([intruder.swept(begin, end)]).free_along(
            motion.clipped(begin, end), tolerance=_TOLERANCE
        )
        if not found.free:
            return f"{', '.join(map(str, found.contacts))} at {found.time:.3f} s"
    return None
