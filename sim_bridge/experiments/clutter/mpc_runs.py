"""One run in the cluttered plane under model-predictive control, and what is counted about it.

The plant follows what it is told perfectly, with the latency of one control period: what is decided from a
measurement takes effect one period later, when the decision has been computed.
"""

import dataclasses
import time
from collections import Counter
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.clutter.moving_discs import BouncingDisc, measured, random_discs, stays
from sim_bridge.experiments.clutter.mppi import Mppi, MppiConfig
from sim_bridge.experiments.clutter.world import CLUTTER, GOAL, LIMITS, STARTS, homotopy_class
from vpsto_ros.collision.planar_discs import DiscMargin, MovingDisc
from vpsto_ros.planning.joint_space import JointSpaceMpc
from vpsto_ros.planning.joint_space_problem import JointSpaceMpcConfig
from vpsto_ros.planning.stitching import extended, remainder
from vpsto_ros.trajectory import Trajectory

PERIOD = 0.05
"""Control period [s]: 20 Hz."""

LONGEST = 20.0
"""End of a run that has not reached the goal [s]: four times what the best controller needs."""

REACHED_DISTANCE, REACHED_SPEED = 0.005, 0.01
"""At the goal: within this distance [m] and slower than this on both axes [m/s]."""

START_SPREAD = 0.005
"""The start is moved by up to this on either axis [m]."""

ALL_STARTS = {**STARTS, "open": np.array([0.25, 0.3])}
"""The starts of the thesis's figure, and one from which nothing is in the way [m]."""

MPPI_MARGIN = 0.004
"""What the baseline keeps away from obstacles [m]: it looks at points up to 7 mm apart, not in between."""


@dataclasses.dataclass(frozen=True)
class Task:
    """One run.

    Attributes:
        controller: options of the controller; their type says which one it is.
        name: what the controller is called.
        start: name of the start, one of ``ALL_STARTS``.
        moving: whether there are moving discs.
        seed: of start, discs, noise and controller.
        longest: end of the run [s] if the goal is not reached.
    """

    controller: JointSpaceMpcConfig | MppiConfig
    name: str
    start: str
    moving: bool
    seed: int
    longest: float = LONGEST


@dataclasses.dataclass(frozen=True)
class Result:
    """What came of a run.

    Attributes:
        task: which run.
        motion: everything that was executed, stitched together.
        time_to_goal: when the goal was reached [s], None if it was not.
        contact: obstacle and time of the first collision, checked at every instant; None if there was none.
        broken: limits exceeded at any instant, and steps in position or velocity, in words.
        path_class: obstacles that the path passes above.
        modes: how often the planner was in which mode.
        step_seconds: processor time of every control step [s].
        discs: that moved through the world.
    """

    task: Task
    motion: Trajectory
    time_to_goal: float | None
    contact: tuple[str, float] | None
    broken: list[str]
    path_class: str
    modes: dict[str, int]
    step_seconds: NDArray
    discs: tuple[BouncingDisc, ...]

    @property
    def success(self) -> bool:
        """At the goal without collision and within the limits."""
        return self.time_to_goal is not None and self.contact is None and not self.broken


class Controller(Protocol):
    """Decides, one period ahead, how the motion goes on."""

    mode: str

    def step(self, takeover: float, discs: list[MovingDisc]) -> None:
        """Decide what is executed from a time [s] on; discs as measured one period earlier."""

    def executed(self, begin: float, end: float) -> Trajectory:
        """The motion of the period before that time, which was decided one step earlier."""


def run_task(task: Task) -> Result:
    """Simulate one run."""
    rng = np.random.default_rng([task.seed, list(ALL_STARTS).index(task.start), int(task.moving)])
    start = ALL_STARTS[task.start] + rng.uniform(-START_SPREAD, START_SPREAD, 2)
    discs = random_discs(rng, start, task.longest) if task.moving else ()
    sensor, search = rng.spawn(2)
    controller = _controller(task.controller, start, search)
    pieces: list[Trajectory] = []
    modes: Counter[str] = Counter()
    seconds = []
    for k in range(round(task.longest / PERIOD)):
        now, after = k * PERIOD, (k + 1) * PERIOD
        seen = measured(discs, now, sensor)
        begin = time.thread_time()
        controller.step(after, seen)
        seconds.append(time.thread_time() - begin)
        modes[controller.mode] += 1
        pieces.append(controller.executed(now, after))
        if _at_goal(pieces[-1]):
            break
    motion = _stitched(pieces)
    return _result(task, motion, modes, np.array(seconds), discs)


def _controller(
    config: JointSpaceMpcConfig | MppiConfig, start: NDArray, rng: np.random.Generator
) -> Controller:
    if isinstance(config, MppiConfig):
        return MppiController(config, start, rng)
    return VpstoController(config, start, rng)


class VpstoController:
    """Online VP-STO."""

    def __init__(self, config: JointSpaceMpcConfig, start: NDArray, rng: np.random.Generator) -> None:
        self.planner = JointSpaceMpc(LIMITS, config, rng)
        self.planner.begin(start, 0.0)
        self.mode = ""
        self._present = self.planner.reference
        self._static = CLUTTER.term()

    def step(self, takeover: float, discs: list[MovingDisc]) -> None:
        """Plan from the state one period ahead; new plans keep more distance than the present one has to."""
        self._present = self.planner.reference
        careful = DiscMargin(tuple(discs), PERIOD, margin=0.010, reaction=0.4)
        just = DiscMargin(tuple(discs), PERIOD, margin=0.006, reaction=0.3)
        terms = (self._static, careful) if discs else (self._static,)
        tolerated = (self._static, just) if discs else None
        plan = self.planner.step(takeover, GOAL, terms, tolerated=tolerated)
        self.planner.accept(plan)
        self.mode = plan.mode

    def executed(self, begin: float, end: float) -> Trajectory:
        """What the plan of the step before says."""
        motion = extended(remainder(self._present, begin), end)
        return motion.clipped(motion.start_time, end)


class MppiController:
    """The sampling MPC with a short horizon."""

    def __init__(self, config: MppiConfig, start: NDArray, rng: np.random.Generator) -> None:
        self.mppi = Mppi(LIMITS, config, rng)
        self.mode = "sample"
        self._position, self._velocity = start, np.zeros(2)
        self._present, self._next = np.zeros(2), np.zeros(2)
        self._world = CLUTTER.inflated(MPPI_MARGIN)

    def step(self, takeover: float, discs: list[MovingDisc]) -> None:
        """Choose the acceleration of the period after this one."""
        self._present = self._next
        position, velocity = self._moved()
        wider = [
            dataclasses.replace(d, radius=d.radius + 0.01 + 0.4 * float(np.hypot(*d.velocity))) for d in discs
        ]
        world = self._world.with_discs((*self._world.discs, *wider)).at(PERIOD)
        self._next = self.mppi.step(position, velocity, GOAL, world)

    def executed(self, begin: float, end: float) -> Trajectory:
        """The motion of one period; the next one begins where it ends."""
        coefficients = np.zeros((1, 6, 2))
        coefficients[0, :3] = self._position, self._velocity, 0.5 * self._present
        self._position, self._velocity = self._moved()
        return Trajectory(np.array([begin, end]), coefficients)

    def _moved(self) -> tuple[NDArray, NDArray]:
        position = self._position + PERIOD * (self._velocity + 0.5 * PERIOD * self._present)
        velocity = self._velocity + PERIOD * self._present
        return position, np.clip(velocity, -LIMITS.velocity, LIMITS.velocity)


def _at_goal(piece: Trajectory) -> bool:
    position, velocity, _ = piece.state(piece.end_time)
    near = float(np.hypot(*(position - GOAL))) <= REACHED_DISTANCE
    return near and float(np.abs(velocity).max()) <= REACHED_SPEED


def _stitched(pieces: list[Trajectory]) -> Trajectory:
    times = np.concatenate([[pieces[0].start_time], *(piece.times[1:] for piece in pieces)])
    return Trajectory(times, np.concatenate([piece.coefficients for piece in pieces]))


def _result(
    task: Task,
    motion: Trajectory,
    modes: Counter[str],
    seconds: NDArray,
    discs: tuple[BouncingDisc, ...],
) -> Result:
    inside = stays(discs, motion)
    position_jump, velocity_jump = motion.jumps()
    broken = motion.violations(LIMITS)
    if max(position_jump.max(), velocity_jump.max()) > 1e-9:
        broken.append(f"steps of {position_jump.max():.3g} m and {velocity_jump.max():.3g} m/s")
    path = motion(np.linspace(motion.start_time, motion.end_time, 2000))
    return Result(
        task, motion, motion.end_time if _at_goal(motion) else None,
        (inside[0].obstacle, inside[0].start) if inside else None, broken, homotopy_class(path), dict(modes),
        seconds, discs,
    )  # fmt: skip
