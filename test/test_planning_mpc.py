"""Algorithm 1 on a point that has to get round a disc."""

import numpy as np
import pytest

from vpsto_ros.optimization.progress import Evaluation
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.mpc import OnlineConfig, OnlineVpsto
from vpsto_ros.planning.pushes import around, way_length
from vpsto_ros.priors.smoothness import smoothness_prior
from vpsto_ros.trajectory import Limits, OptimalBasis, synthesize, synthesize_batch

LIMITS = Limits(np.full(2, 0.5), np.full(2, 2.0))
GOAL = np.array([1.0, 0.0])


class RoundTheDisc:
    """From a state to a fixed end without touching a disc at (0.5, 0)."""

    def __init__(self, position, velocity, start_time, radius=0.2):
        self.position, self.velocity, self.start_time, self.radius = position, velocity, start_time, radius

    def _keys(self, points):
        ends = [np.broadcast_to(p, (len(points), 1, 2)) for p in (self.position, GOAL)]
        return np.concatenate([ends[0], points, ends[1]], axis=1)

    def evaluate(self, points):
        keys = self._keys(points)
        motion = synthesize_batch(
            OptimalBasis.uniform(keys.shape[1] - 2), keys, self.velocity, np.zeros(2), LIMITS, 80
        )
        inside = (np.linalg.norm(motion.position - [0.5, 0.0], axis=2) < self.radius).sum(axis=1)
        return Evaluation(motion.duration + 10.0 * inside, inside == 0)

    def trajectory(self, points):
        keys = self._keys(points[None])[0]
        return synthesize(
            OptimalBasis.uniform(len(keys) - 2),
            keys,
            self.velocity,
            np.zeros(2),
            LIMITS,
            start_time=self.start_time,
        )

    def direct(self, previous):
        return np.zeros((0, 2))

    def shifted(self, previous, n_via):
        begin = min(self.start_time, previous.end_time)
        return previous(begin + (previous.end_time - begin) * np.arange(1, n_via + 1) / (n_via + 1))

    def prior(self, n_via):
        return smoothness_prior(
            OptimalBasis.uniform(n_via), self.position, self.velocity, GOAL, np.zeros(2), 2.0, spread=0.3
        )

    def guesses(self, n_via):
        return self.position + np.arange(1, n_via + 1)[None, :, None] / (n_via + 1) * (GOAL - self.position)


def online(**options):
    return OnlineVpsto(
        OnlineConfig(search=VpstoConfig(population=24, iterations=8), **options), np.random.default_rng(0)
    )


def test_explores_then_warm_starts_then_stops_without_touching_the_disc():
    mpc = online(via_rate=2.0, stop_duration=0.6)
    position, velocity, now, modes, counts = np.zeros(2), np.zeros(2), 0.0, [], []
    for _ in range(200):
        result = mpc.step(RoundTheDisc(position, velocity, now))
        assert result.trajectory is not None
        mpc.accept(result.trajectory)
        modes.append(result.mode)
        if result.search is not None:
            counts.append(len(result.search.points))
        path = result.trajectory(np.linspace(now, now + 0.05, 10))
        assert (np.linalg.norm(path - [0.5, 0.0], axis=1) > 0.199).all()
        now += 0.05
        position, velocity, _ = result.trajectory.state(now)
        if np.linalg.norm(position - GOAL) < 1e-6:
            break
    assert np.linalg.norm(position - GOAL) < 1e-6
    assert modes[0] == "explore" and modes[1] == "warm_start" and modes[-1] == "stop"
    assert counts[0] == 3 and counts[-1] < 3, "fewer via-points for what is left"


def test_no_valid_plan_is_reported_and_the_next_step_explores():
    mpc = online()
    first = mpc.step(RoundTheDisc(np.zeros(2), np.zeros(2), 0.0))
    mpc.accept(first.trajectory)
    blocked = RoundTheDisc(np.zeros(2), np.zeros(2), 0.0, radius=0.6)
    result = mpc.step(blocked)
    assert result.trajectory is None and result.mode == "warm_start" and not np.isfinite(result.cost)
    assert result.search.status == "no valid plan"
    mpc.accept(result.trajectory)
    assert mpc.step(RoundTheDisc(np.zeros(2), np.zeros(2), 0.0)).mode == "explore"


def test_warm_start_keeps_a_plan_at_least_as_good_as_what_is_left_of_the_last():
    mpc = online(stop_duration=0.0)
    first = mpc.step(RoundTheDisc(np.zeros(2), np.zeros(2), 0.0))
    mpc.accept(first.trajectory)
    position, velocity, _ = first.trajectory.state(0.1)
    problem = RoundTheDisc(position, velocity, 0.1)
    rest = problem.evaluate(problem.shifted(first.trajectory, 3)[None])
    result = mpc.step(problem)
    assert result.cost <= rest.cost[0] + 1e-12


def test_deadline_in_the_past_is_reported_not_ignored():
    mpc = online(stop_duration=0.0)
    result = mpc.step(RoundTheDisc(np.zeros(2), np.zeros(2), 0.0), deadline=0.0, clock=lambda: 1.0)
    assert result.search.status in ("deadline", "no valid plan") and result.search.iterations <= 1


@pytest.mark.parametrize("bearing", np.linspace(-3.0, 3.0, 13))
def test_the_way_round_keeps_its_distance(bearing):
    center, start = np.array([0.5, 0.1]), np.array([0.36, 0.1])
    touch = center + 0.08 * np.array([np.cos(bearing), np.sin(bearing)])
    way = np.concatenate([start[None], around(start, touch[None], center, 0.12, 40)[0], touch[None]])
    distance = np.linalg.norm(way - center, axis=1)
    assert distance.min() >= 0.05 and np.linalg.norm(np.diff(way, axis=0), axis=1).max() < 0.08
    opposite = np.cos(bearing) > 0.0
    assert not opposite or distance[1:-1].min() >= 0.12 - 1e-12
    assert way_length(start, touch[None], center, 0.12)[0] >= np.linalg.norm(touch - start) - 1e-12
