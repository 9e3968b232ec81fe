"""An agent that shoots at air hockey (ch. 5): filter, contact planner and MPC in one, for any robot.

It needs neither ROS nor a simulator. What it is given and what it returns is in the robot's base frame.

    agent = HockeyAgent()
    while playing:                               # every 20 ms
        sighting = PuckSighting(time, (x, y))    # or several, or none
        references = agent.act(Observation(time, q, qd, (sighting,)))
        robot.follow(references.position, references.velocity, references.acceleration)
"""

import dataclasses

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.contact.puck import SHIPPED as PUCK_MODEL
from vpsto_ros.contact.puck import PuckModel
from vpsto_ros.estimation.measurement import finite_array
from vpsto_ros.estimation.puck_filter import PuckFilter, PuckFilterConfig, PuckState
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.planning.hockey.shooting import ShootingPlanner
from vpsto_ros.planning.hockey.shooting_config import ShootingConfig, Shot, middle_strike
from vpsto_ros.planning.hockey.shooting_policy import ShootingPolicy
from vpsto_ros.planning.hockey.strike_mpc import StrikeMpc
from vpsto_ros.planning.hockey.strike_mpc_config import StrikeMpcConfig
from vpsto_ros.planning.hockey.strikes import StrikeTable
from vpsto_ros.planning.hockey.touch import MalletContact
from vpsto_ros.planning.running_reference import MpcStep
from vpsto_ros.planning.stitching import extended
from vpsto_ros.robot.mallet_observer import MalletObserver

_WARM_UP = 120  # observations of an imaginary puck


@documented
@dataclasses.dataclass(frozen=True)
class HockeyAgentConfig:
    """Options of the agent.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    period: float = option(
        0.02, "time from one observation to the next", unit="s", minimum=1e-3, maximum=0.2
    )
    resolution: float = option(
        0.001, "between the instants for which references are given", unit="s", minimum=1e-4, maximum=0.2
    )
    filter: PuckFilterConfig = dataclasses.field(default_factory=PuckFilterConfig)
    shooting: ShootingConfig = dataclasses.field(default_factory=ShootingConfig)
    mpc: StrikeMpcConfig = dataclasses.field(default_factory=StrikeMpcConfig)

    def __post_init__(self) -> None:
        validate(self)


@dataclasses.dataclass(frozen=True, eq=False)
class PuckSighting:
    """Where the puck was seen.

    Attributes:
        time: when [s].
        position: x, y in the base frame, shape (2,) [m].
        covariance: of the position, shape (2, 2) [m²]; that of the filter's options if None.
        velocity: likewise [m/s], if it is measured.
        velocity_covariance: of the velocity, shape (2, 2) [m²/s²].
    """

    time: float
    position: ArrayLike
    covariance: ArrayLike | None = None
    velocity: ArrayLike | None = None
    velocity_covariance: ArrayLike | None = None


@dataclasses.dataclass(frozen=True, eq=False)
class Observation:
    """What the agent is told.

    Attributes:
        time: now [s].
        joint_position: measured, shape (7,) [rad].
        joint_velocity: measured, shape (7,) [rad/s].
        sightings: of the puck since the last observation, oldest first; none if it was not seen.
    """

    time: float
    joint_position: ArrayLike
    joint_velocity: ArrayLike
    sightings: tuple[PuckSighting, ...] = ()


@dataclasses.dataclass(frozen=True, eq=False)
class JointReferences:
    """What the arm shall do until the next observation.

    Attributes:
        times: instants, shape (K,) [s].
        position: shape (K, 7) [rad].
        velocity: shape (K, 7) [rad/s].
        acceleration: shape (K, 7) [rad/s²].
        shot: what is intended, None while the arm waits.
        puck: what is known of the puck, None if it is lost.
        step: what the MPC planned.
        message: why there is no shot, or what went wrong, in words.
    """

    times: NDArray[np.float64]
    position: NDArray[np.float64]
    velocity: NDArray[np.float64]
    acceleration: NDArray[np.float64]
    shot: Shot | None
    puck: PuckState | None
    step: MpcStep
    message: str


class HockeyAgent:
    """Shoots whenever the puck can be shot, and waits at home otherwise.

    Attributes:
        config: options.
        filter: follows the puck.
        planner: chooses shots.
        mpc: moves the arm.
    """

    def __init__(
        self, config: HockeyAgentConfig | None = None, *, model: PuckModel | None = None,
        strikes: StrikeTable | None = None, policy: ShootingPolicy | None = None, seed: int = 0,
    ) -> None:  # fmt: skip
        """Compile everything, so that no step takes longer than others.

        Args:
            config: options.
            model: of the puck; the one that comes with the package if None.
            strikes: of the arm; likewise.
            policy: gives shooting angles instead of direct search.
            seed: of the searches.

        Raises:
            ConfigurationError: a file that is needed is missing or damaged.
        """
        self.config = config or HockeyAgentConfig()
        model, self._strikes = model or PuckModel.load(PUCK_MODEL), strikes or StrikeTable.load()
        self._table = self._strikes.rules.table
        self.filter = PuckFilter(model, self.config.filter)
        rng = np.random.default_rng([seed, 1])
        self.planner = ShootingPlanner(model, self._strikes, self.config.shooting, policy, rng)
        self.mpc = StrikeMpc(self._strikes, self.config.mpc, seed=seed)
        self._mallet = MalletObserver(self.config.mpc.tilt)
        self._warm_up()

    def reset(self) -> None:
        """Forget puck, shot and motion, as after a restart of the simulator."""
        self.filter.reset()
        self.planner.forget()
        self.mpc.reset()
        self._mallet.reset()

    def act(self, observation: Observation) -> JointReferences:
        """References until the next observation.

        Nothing that a camera delivers raises: what is wrong with it is ignored, and the message says so.

        Raises:
            InvalidInputError: the joint state is not 7 finite positions and velocities, or time not finite.
        """
        now = float(observation.time)
        q = np.array(observation.joint_position, dtype=float)
        qd = np.array(observation.joint_velocity, dtype=float)
        if q.shape != (7,) or qd.shape != (7,) or not np.isfinite([now, *q, *qd]).all():
            raise InvalidInputError("an observation needs a finite time, 7 joint positions and velocities")
        complaints = self._see(now, q, qd, observation.sightings)
        puck = self._puck(now)
        shot = self.planner.plan(now, puck, q)
        contact = MalletContact(shot.time, shot.mallet) if shot is not None else None
        step = self.mpc.step(now, q, qd, contact)
        if shot is not None and step.refused:
            self.planner.refuse()
            complaints.append(f"shot refused: {step.message}")
        self.mpc.accept(step)
        reasons = complaints if shot is not None else [*complaints, self.planner.reason]
        return self._references(now, q, shot, puck, step, "; ".join(filter(None, reasons)))

    def _warm_up(self) -> None:
        """Shoot at an imaginary puck that lies still, so that everything is compiled, and forget it."""
        place = self._table + middle_strike(self._strikes)[0]
        q, qd = np.array(self._strikes.rules.home), np.zeros(7)
        for k in range(_WARM_UP):
            now = self.config.period * k
            sighting = PuckSighting(now, place, velocity=np.zeros(2))
            references = self.act(Observation(now, q, qd, (sighting,)))
            q, qd = references.position[-1], references.velocity[-1]
        self.reset()

    def _see(self, now: float, q: NDArray, qd: NDArray, sightings: tuple[PuckSighting, ...]) -> list[str]:
        """Take in where mallet and puck are; what was wrong with that."""
        mallet, complaints = self._mallet.observe(now, q, qd), []
        self.filter.observe_mallet(now, mallet[:2] - self._table, mallet[2:])
        for sighting in sightings:
            where, defect = finite_array(sighting.position, (2,))
            if defect:
                complaints.append(f"puck not used: position: {defect}")
                continue
            outcome = self.filter.update(sighting.time, where - self._table, sighting.covariance)
            if outcome.kind == "invalid":
                complaints.append(f"puck not used: {outcome.reason}")
            elif sighting.velocity is not None and outcome.kind in ("accepted", "reinitialized"):
                moves = self.filter.observe_velocity(sighting.velocity, sighting.velocity_covariance)
                if moves.kind == "invalid":
                    complaints.append(f"velocity of the puck not used: {moves.reason}")
        return complaints

    def _puck(self, now: float) -> PuckState | None:
        """The puck now, None where the filter has lost it."""
        tracked = self.filter.status(now).kind in ("tracking", "recovering")
        return self.filter.state(now) if tracked else None

    def _references(
        self, now: float, q: NDArray, shot: Shot | None, puck: PuckState | None, step: MpcStep, message: str
    ) -> JointReferences:
        count = max(2, round(self.config.period / self.config.resolution) + 1)
        times = now + np.linspace(0.0, self.config.period, count)
        if self.mpc.reference is None:  # an arm that moves on its own is left alone where it is
            rows = [np.tile(q, (count, 1)), np.zeros((count, 7)), np.zeros((count, 7))]
        else:
            running = extended(self.mpc.reference, times[-1])
            rows = [running(times, order) for order in range(3)]
        return JointReferences(times, rows[0], rows[1], rows[2], shot, puck, step, message)
