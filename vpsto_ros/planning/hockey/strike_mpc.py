"""Model-predictive control of an arm that plays air hockey: through the touch, on, and back home (5.3, 4.4).

Every cycle VP-STO plans anew from the motion that is being executed to the state of the mallet that the
contact planner asks for. Joints are planned, not the plane: their limits hold at every instant, and the
posture at the touch is the tabulated one in which the mallet is fast.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.planning.hockey.motions import ArmState, Play, PlayMotion, way_in
from vpsto_ros.planning.hockey.shooting_config import middle_strike
from vpsto_ros.planning.hockey.strike_mpc_config import StrikeMpcConfig
from vpsto_ros.planning.hockey.strikes import Cell, StrikeTable
from vpsto_ros.planning.hockey.touch import MalletContact
from vpsto_ros.planning.mpc import OnlineResult, OnlineVpsto
from vpsto_ros.planning.running_reference import AT_REST, MpcStep, ReferencePlanner
from vpsto_ros.planning.stitching import extended, resting
from vpsto_ros.robot.iiwa import iiwa14
from vpsto_ros.robot.iiwa_kinematics import arm_points
from vpsto_ros.trajectory import Trajectory


class _Planned(NamedTuple):
    """What a step planned: the whole motion, the contact, its entry, and the motions into it and home."""

    whole: Trajectory
    contact: MalletContact
    cell: Cell
    approach: Trajectory | None
    onwards: Trajectory | None


class StrikeMpc(ReferencePlanner):
    """Plans step after step: waits at home, strikes when it is told where and when, follows through, returns.

    Every trajectory that it gives contains the whole motion until the arm rests at home again, so that an arm
    whose planner falls silent ends there. While no plan is found that keeps limits and rules, the motion that
    runs goes on.

    Attributes:
        config: options.
        table: the strikes.
        contact: what is being carried out, None while nothing is.
    """

    def __init__(
        self, table: StrikeTable, config: StrikeMpcConfig | None = None, *, seed: int = 0
    ) -> None:
        """Nothing is being followed yet.

        Args:
            table: the strikes.
            config: options.
            seed: of the searches.
        """
        self.config, self.table = config or StrikeMpcConfig(), table
        super().__init__(iiwa14(), 2, self.config.lead, self.config.joint_tolerance, memory=1.0)
        rules = table.rules
        self.play = Play(rules, rules.limits(self.robot))
        self.home = np.array(rules.home)
        rng = np.random.default_rng(seed)
        self._approach = OnlineVpsto(self.config.approach, rng)
        self._return = OnlineVpsto(self.config.home, rng)
        self._first = {
            online: dataclasses.replace(
                online.config,
                search=dataclasses.replace(online.config.search, iterations=self.config.first_iterations),
            )
            for online in (self._approach, self._return)
        }
        self._usual = {online: online.config for online in self._first}
        self._swing: tuple[float, NDArray] | None = None
        self.contact: MalletContact | None
        self._cell: Cell | None
        self._tried: MalletContact | None
        self._planned: _Planned | None
        self._hint: NDArray | None
        self._home_hint: NDArray | None
        self.forget_plan()

    def forget_plan(self) -> None:
        """Do not warm-start from the last plan."""
        self.forget_contact()
        self._planned = self._tried = None
        self._attempts, self._hint, self._home_hint = 0, None, None

    def step(
        self, now: float, joint_position: ArrayLike, joint_velocity: ArrayLike,
        contact: MalletContact | None = None,
    ) -> MpcStep:  # fmt: skip
        """Plan once. Call :meth:`accept` with what is going to be executed.

        Args:
            now: time [s].
            joint_position: measured, shape (7,) [rad].
            joint_velocity: measured, shape (7,) [rad/s].
            contact: what the mallet is to do, None to wait at home.

        Raises:
            InvalidInputError: a shape does not fit, or a number is not finite.
        """
        q, qd = (np.asarray(row, dtype=float) for row in (joint_position, joint_velocity))
        if q.shape != (7,) or qd.shape != (7,) or not np.isfinite([now, *q, *qd]).all():
            raise InvalidInputError("the state of the arm must be 7 finite positions and velocities")
        if self._lost(now, q):
            return self._take_over(now, q, qd)
        self._follow_mallet(now)
        takeover = now + self.config.lead
        if self.contact is not None and takeover >= self.contact.time:
            self.forget_contact()  # what follows is under way
        if contact is not None and contact.time > takeover + self.config.least:
            return self._strike(now, takeover, contact)
        if self.contact is not None and contact is None and self.contact.time > takeover + self.config.final:
            return self._withdraw(now, takeover)
        return self._go_on(now)

    def warm_up(self) -> None:
        """Compile what a strike of the table uses: wait at home, strike, go home; then forget it."""
        way_in(self.play, self.home, 0.0, self.config.enter_share)
        place, speed = middle_strike(self.table)
        mallet = np.array([place[0] - self.table.contact_distance, place[1], 0.8 * speed, 0.0])
        contact, still = MalletContact(self.config.longest + 0.4, mallet), np.zeros(7)
        for now, wanted in ((0.0, None), (0.02, contact), (0.04, contact), (0.06, None)):
            self.accept(self.step(now, self.home, still, wanted))
        self.stop(0.08)
        self.reset()

    def accept(self, step: MpcStep) -> None:
        """Take note that a step's trajectory is being executed."""
        super().accept(step)
        planned, self._planned = self._planned, None
        if planned is not None and planned.whole is step.plane:
            self.contact, self._cell = planned.contact, planned.cell
            self._approach.accept(planned.approach)
            self._return.accept(planned.onwards)

    def forget_contact(self) -> None:
        """The touch is over."""
        self.contact, self._cell = None, None
        self._approach.accept(None)
        self._return.accept(None)

    def _tool(self, q: ArrayLike) -> NDArray[np.float64]:
        """Place of the universal joint (..., 2) in the base frame."""
        rows = np.asarray(q, dtype=float)
        return arm_points(rows.reshape(-1, 7))[:, 3, :2].reshape((*rows.shape[:-1], 2))

    def _brake(self, takeover: float, position: NDArray, velocity: NDArray) -> Trajectory:
        """Home, as fast as limits and rules allow."""
        self._return.accept(None)
        return self._homewards(ArmState(takeover, position, velocity))

    def _take_over(self, now: float, q: NDArray, qd: NDArray) -> MpcStep:
        """Begin with an arm that stands still, wherever it is."""
        self.reset()
        if np.abs(qd).max() > AT_REST:
            return MpcStep(None, "wait", False, "the arm moves and does not follow this planner's reference")
        self.reference = resting(q, now, now + self.config.lead)
        return self._go_home(now)

    def _go_on(self, now: float) -> MpcStep:
        """What runs is right."""
        running = self._running
        if self._moves_after(now):
            rest = running.clipped(max(now, running.start_time), running.end_time)
            return MpcStep(rest, "follow", True, "")
        position = running(running.end_time)
        if np.abs(position - self.home).max() > 1e-3:
            return self._go_home(now)
        return MpcStep(resting(position, now, now + 0.5), "hold", True, "waits at home")

    def _go_home(self, now: float) -> MpcStep:
        """From rest anywhere: in the plane of play if the arm is in it, else slowly into it."""
        takeover = now + self.config.lead
        begin = ArmState(takeover, extended(self._running, takeover)(takeover), np.zeros(7))
        try:
            return MpcStep(self._joined(now, self._homewards(begin)), "return", True, "on the way home")
        except InfeasibleError:
            pass
        try:
            way = way_in(self.play, begin.position, takeover, self.config.enter_share)
        except InfeasibleError as error:
            return MpcStep(None, "wait", False, str(error))
        return MpcStep(self._joined(now, way), "enter", True, "slowly into the plane of play")

    def _moves_after(self, now: float) -> bool:
        running = self._running
        if running.end_time <= now + 1e-6:
            return False
        return bool(np.abs(running(running.end_time) - running(now)).max() > 1e-9)

    def _withdraw(self, now: float, takeover: float) -> MpcStep:
        """The contact is not wanted any more: go home."""
        self.forget_contact()
        position, velocity, _ = extended(self._running, takeover).state(takeover)
        try:
            way = self._homewards(ArmState(takeover, position, velocity))
        except InfeasibleError:
            return self._go_on(now)
        return MpcStep(self._joined(now, way), "return", True, "the shot was called off")

    def _follow_mallet(self, now: float) -> None:
        """How the mallet swings now, from the motion that was asked for."""
        if self.reference is None:
            return
        running = self._running
        if self._swing is None or not running.start_time <= self._swing[0] <= now:
            self._swing = (now, np.zeros(4))
            return
        begin, state = self._swing
        self._swing = (now, self.config.tilt.along(extended(running, now), now, begin, state))

    def _strike(self, now: float, takeover: float, contact: MalletContact) -> MpcStep:
        """Plan into the touch, on, and home."""
        fresh = not contact.continues(self.contact)
        if not contact.continues(self._tried):
            self._attempts, self._hint, self._home_hint = 0, None, None
        self._tried = contact
        cell = self._cell
        if fresh or cell is None:
            cell = self.table.cell(contact.mallet, self._running(now))
        if cell is None:
            return self._refuse(now, "there is no strike in the table for this contact", fresh)
        begin = self._begin(takeover, contact, fresh)
        before = self._approach.previous, self._return.previous
        if fresh:
            self._approach.accept(None)
            self._return.accept(None)
        try:
            result, whole = self._through(now, begin, cell, contact, None if fresh else self._running)
            for _ in range(self.config.first_rounds - 1 if fresh else 0):
                result, whole = self._through(now, begin, cell, contact, whole)
            self._planned = _Planned(whole, contact, cell, self._approach.previous, self._return.previous)
        except InfeasibleError as error:
            return self._refuse(now, str(error), fresh)
        finally:  # what is planned is only remembered when it is accepted
            self._approach.accept(before[0])
            self._return.accept(before[1])
        iterations = result.search.iterations if result.search is not None else 0
        path = self._tool(whole(np.linspace(whole.start_time, whole.end_time, 40)))
        return MpcStep(
            whole, result.mode, True, "", cost=result.cost, iterations=iterations, tool_path=path, plane=whole
        )

    def _through(
        self, now: float, begin: ArmState, cell: Cell, contact: MalletContact,
        motion: Trajectory | None,
    ) -> tuple[OnlineResult, Trajectory]:  # fmt: skip
        """The running motion, one from it into a touch, and the one after that.

        Args:
            now: time [s].
            begin: where planning begins.
            cell: entry of the table.
            contact: the touch.
            motion: much like the one that is planned, to tell how the mallet will swing.

        Raises:
            InfeasibleError: none is found that keeps limits and rules.
        """
        target = self._target(cell, contact, now, motion)
        run_up, duration = self.table.start(cell), self.table.config.run_up
        result = self._plan(
            self._approach, PlayMotion(self.play, begin, target, run_up, duration, self._hint)
        )
        if result.trajectory is None:
            self._hint = None if result.search is None else result.search.best_any_points
            raise InfeasibleError("no motion into this contact keeps limits and rules")
        onwards = self._follow_through(target)
        self._approach.accept(result.trajectory)
        return result, self._joined(now, result.trajectory.followed_by(onwards))

    def _refuse(self, now: float, why: str, fresh: bool) -> MpcStep:
        """Go on with what runs: it is whole, and ends at home. If it leads into this contact, all is well."""
        step = self._go_on(now)
        self._attempts += 1
        if fresh and self._attempts < self.config.attempts:
            return dataclasses.replace(step, valid=False, message=f"still searching: {why}")
        if not fresh:
            return dataclasses.replace(step, warning=f"the last plan for this contact goes on: {why}")
        return dataclasses.replace(step, valid=False, message=why, refused=True)

    def _begin(self, takeover: float, contact: MalletContact, fresh: bool) -> ArmState:
        """Where planning begins: at the takeover, or later while there is time to wait."""
        # Until the motion into a touch begins the arm waits, or is on its way home.
        before, start = self._approach.previous, contact.time - self.config.longest
        if self.contact is not None and before is not None:
            start = before.start_time if not fresh else min(start, before.start_time)
        start = max(takeover, start)
        position, velocity, _ = extended(self._running, start).state(start)
        return ArmState(start, position, velocity)

    def _target(
        self, cell: Cell, contact: MalletContact, now: float, motion: Trajectory | None
    ) -> ArmState:
        """The arm's state at the touch, with the mallet swinging as a motion much like it makes it.

        Raises:
            InfeasibleError: the arm cannot be there, or not so fast.
        """
        mallet, aside, rate = contact.mallet, np.zeros(2), np.zeros(2)
        if motion is not None and self._swing is not None:
            tilt = self.config.tilt
            begin, state = self._swing
            touching = tilt.along(motion, contact.time, begin, state)
            middle = tilt.along(motion, contact.time + self.config.middle, contact.time, touching)
            aside = tilt.touching(touching, mallet[2:] / np.hypot(mallet[2], mallet[3]))
            rate = tilt.displacement(middle)[1]
        place, velocity = mallet[:2] + self.table.rules.table - aside, mallet[2:] - rate
        found = self.table.contact(cell, place, velocity)
        if found is None:
            raise InfeasibleError("the touch is out of the arm's reach")
        excess = float((np.abs(found[1]) / self.play.limits.velocity).max())
        if excess > 1.0 + self.config.slower:
            raise InfeasibleError(f"the mallet cannot be that fast there, but {1.0 / excess:.0%} of it")
        return ArmState(contact.time, found[0], found[1] / max(1.0, excess))

    def _follow_through(self, target: ArmState) -> Trajectory:
        """Straight on at the speed of the touch while it lasts, if joints can, then home.

        Raises:
            InfeasibleError: no such motion keeps limits and rules.
        """
        hold = self.table.config.hold
        after = self.table.straight_on(target.position, target.velocity, hold)
        if (np.abs(after[1]) > self.play.limits.velocity).any():
            after = target.position + hold * target.velocity, target.velocity
        times = np.array([target.time, target.time + hold])
        rows, rates = np.stack([target.position, after[0]]), np.stack([target.velocity, after[1]])
        on = Trajectory.from_points(times, rows, rates)
        return on.followed_by(self._homewards(ArmState(target.time + hold, *after)))

    def _homewards(self, begin: ArmState) -> Trajectory:
        """From a state to rest at home.

        Raises:
            InfeasibleError: no such motion keeps limits and rules.
        """
        end = ArmState(np.inf, self.home, np.zeros(7))
        rest = begin.position + 0.5 * self.table.config.brake * begin.velocity
        motion, before = PlayMotion(self.play, begin, end, rest, hint=self._home_hint), self._return.previous
        if before is not None:
            # While the touch moves by millimetres, the way home need not be searched again.
            points = motion.shifted(before, self.config.home.n_via)
            if motion.evaluate(points[None]).valid[0]:
                return motion.trajectory(points)
        result = self._plan(self._return, motion)
        if result.trajectory is None:
            self._home_hint = None if result.search is None else result.search.best_any_points
            raise InfeasibleError("no way home keeps limits and rules")
        self._return.accept(result.trajectory)
        return result.trajectory

    def _plan(self, online: OnlineVpsto, motion: PlayMotion) -> OnlineResult:
        online.config = self._first[online] if online.previous is None else self._usual[online]
        return online.step(motion)
