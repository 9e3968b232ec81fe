"""One trajectory through key positions, and braking from any velocity."""

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from vpsto_ros.exceptions import InfeasibleError, InvalidInputError
from vpsto_ros.trajectory import (
    Limits,
    OptimalBasis,
    Trajectory,
    braking_trajectory,
    minimal_duration,
    synthesize,
    synthesize_batch,
)

LIMITS = Limits([1.0, 2.0, 1.5], [4.0, 3.0, 10.0])


def random_problem(seed, n_via=3):
    rng = np.random.default_rng(seed)
    keys = rng.normal(size=(n_via + 2, 3))
    start, end = rng.uniform(-1, 1, (2, 3)) * LIMITS.velocity
    if seed % 2:
        start = np.sign(start) * LIMITS.velocity
    return OptimalBasis.uniform(n_via), keys, start, end


@pytest.mark.parametrize("seed", range(20))
def test_is_the_clamped_spline_in_time(seed):
    basis, keys, start, end = random_problem(seed, n_via=seed % 6)
    trajectory = synthesize(basis, keys, start, end, LIMITS, start_time=2.0)
    expected = CubicSpline(2.0 + trajectory.duration * basis.knots, keys, bc_type=((1, start), (1, end)))
    t = np.linspace(2.0, trajectory.end_time, 101)[1:-1]
    for order in range(3):
        np.testing.assert_allclose(trajectory(t, order), expected(t, order), atol=1e-10)
    np.testing.assert_allclose(trajectory(trajectory.times), keys, atol=1e-13)
    np.testing.assert_array_equal(trajectory(2.0, 1), start)
    np.testing.assert_allclose(trajectory(trajectory.end_time, 1), end, atol=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_limits_hold_and_one_is_touched(seed):
    trajectory = synthesize(*random_problem(seed), LIMITS)
    assert trajectory.violations(LIMITS) == []
    loads = [
        np.maximum(-lower, upper) / limit
        for order, limit in ((1, LIMITS.velocity), (2, LIMITS.acceleration))
        for lower, upper in [trajectory.extrema(order)]
    ]
    assert np.max(loads) == pytest.approx(1.0, abs=1e-9)


@pytest.mark.parametrize("seed", range(5))
def test_agrees_with_the_batch(seed):
    basis, keys, start, end = random_problem(seed)
    batch = synthesize_batch(basis, keys, start, end, LIMITS, 21)
    trajectory = synthesize(basis, keys, start, end, LIMITS)
    assert trajectory.duration == pytest.approx(batch.duration[0], rel=1e-12)
    t = np.linspace(0, trajectory.duration, 21)
    for order, samples in enumerate((batch.position, batch.velocity, batch.acceleration)):
        np.testing.assert_allclose(trajectory(t, order), samples[0], atol=1e-9)


def test_takes_a_row_of_a_batch_as_velocity():
    basis, keys, start, end = random_problem(10)
    expected = synthesize(basis, keys, start, end, LIMITS)
    trajectory = synthesize(basis, keys, start[None], list(end), LIMITS)
    np.testing.assert_array_equal(trajectory.coefficients, expected.coefficients)


def test_longer_durations_are_fine_and_shorter_ones_refused():
    basis, keys, start, end = random_problem(6)
    shortest = minimal_duration(basis, keys, start, end, LIMITS)
    for factor in (1.0, 1.5, 20.0):
        trajectory = synthesize(basis, keys, start, end, LIMITS, duration=factor * shortest)
        assert trajectory.duration == pytest.approx(factor * shortest)
        assert trajectory.violations(LIMITS) == []
    with pytest.raises(InfeasibleError, match="too short") as caught:
        synthesize(basis, keys, start, end, LIMITS, duration=0.9 * shortest)
    assert f"{shortest:.6g}" in str(caught.value)
    for duration in (0.0, -1.0, np.inf, np.nan):
        with pytest.raises(InvalidInputError, match="duration"):
            synthesize(basis, keys, start, end, LIMITS, duration=duration)


def test_an_isolated_shorter_duration_may_be_asked_for():
    # At constant speed for 0.5 s nothing accelerates, yet somewhat longer durations break the limit.
    limits = Limits([100.0], [1.0])
    basis, keys = OptimalBasis.uniform(0), np.array([[0.0], [1.0]])
    assert minimal_duration(basis, keys, [2.0], [2.0], limits) > 1.0
    trajectory = synthesize(basis, keys, [2.0], [2.0], limits, duration=0.5)
    np.testing.assert_allclose(trajectory(0.25), [0.5], atol=1e-12)


def test_position_limits_play_no_part():
    narrow = Limits(LIMITS.velocity, LIMITS.acceleration, np.full(3, -0.1), np.full(3, 0.1))
    basis, keys, start, end = random_problem(8)
    shortest = minimal_duration(basis, keys, start, end, narrow)
    assert synthesize(basis, keys, start, end, narrow).duration == pytest.approx(shortest)
    with pytest.raises(InfeasibleError) as caught:
        synthesize(basis, keys, start, end, narrow, duration=0.5 * shortest)
    assert "position" not in str(caught.value)


@pytest.mark.parametrize("place", ["start", "end"])
def test_velocity_beyond_the_limit_names_the_remedy(place):
    basis, keys, _, _ = random_problem(9)
    velocities = {"start": np.zeros(3), "end": np.zeros(3)}
    velocities[place][1] = -2.1
    with pytest.raises(InfeasibleError, match=r"2\.1 of joint 2 .* limit 2.*braking_trajectory"):
        synthesize(basis, keys, velocities["start"], velocities["end"], LIMITS)


def test_braking_from_beyond_the_limit():
    position, velocity = np.array([0.3, -1.0, 2.0]), np.array([3.0, -4.0, 0.0])
    trajectory = braking_trajectory(position, velocity, LIMITS, start_time=5.0)
    assert isinstance(trajectory, Trajectory) and trajectory.start_time == 5.0
    assert trajectory.duration == pytest.approx(
        4.0 / 3.0
    )  # joint 2 decelerates hardest: 4 rad/s at 3 rad/s^2
    t = np.linspace(5.0, trajectory.end_time, 100)
    np.testing.assert_array_equal(trajectory(5.0), position)
    np.testing.assert_array_equal(trajectory(5.0, 1), velocity)
    np.testing.assert_allclose(trajectory(trajectory.end_time, 1), np.zeros(3), atol=1e-14)
    speed = np.abs(trajectory(t, 1))
    assert np.all(np.diff(speed, axis=0) <= 1e-14)
    np.testing.assert_allclose(np.diff(trajectory(t, 2), axis=0), 0.0, atol=1e-14)
    _, upper = trajectory.extrema(2)
    assert upper[1] == pytest.approx(3.0)
    # A straight line: every joint covers the same share of its way at every instant.
    way = trajectory(t[1:]) - position
    np.testing.assert_allclose(way[:, 0] * velocity[1], way[:, 1] * velocity[0], atol=1e-13)
    # Only the velocity at the start is beyond its limit.
    assert all("velocity" in line for line in trajectory.violations(LIMITS))


@pytest.mark.parametrize("seed", range(20))
def test_braking_is_feasible_from_within_the_limits(seed):
    rng = np.random.default_rng(seed)
    velocity = rng.uniform(-1, 1, 3) * LIMITS.velocity
    trajectory = braking_trajectory(rng.normal(size=3), velocity, LIMITS)
    assert trajectory.violations(LIMITS) == []
    np.testing.assert_allclose(trajectory(trajectory.end_time, 1), np.zeros(3), atol=1e-14)


def test_braking_at_rest_stays():
    trajectory = braking_trajectory([0.1, 0.2, 0.3], np.zeros(3), LIMITS)
    assert trajectory.duration > 0.0
    np.testing.assert_array_equal(trajectory(trajectory.end_time), [0.1, 0.2, 0.3])


def test_braking_then_moving():
    # The documented treatment: brake, then plan from rest.
    brake = braking_trajectory(np.zeros(3), [2.0, 0.0, -1.0], LIMITS)
    rest = brake(brake.end_time)
    keys = np.stack([rest, np.zeros(3)])
    move = synthesize(
        OptimalBasis.uniform(0), keys, np.zeros(3), np.zeros(3), LIMITS, start_time=brake.end_time
    )
    whole = brake.followed_by(move)
    position, velocity = whole.jumps()
    assert np.all(position < 1e-12) and np.all(velocity < 1e-12)


@pytest.mark.parametrize(
    ("position", "velocity"),
    [(np.zeros(2), np.zeros(3)), (np.zeros(3), np.zeros(2)), (np.full(3, np.nan), np.zeros(3))],
)
def test_refuses_bad_states(position, velocity):
    with pytest.raises(InvalidInputError):
        braking_trajectory(position, velocity, LIMITS)


def test_refuses_a_batch():
    with pytest.raises(InvalidInputError, match=r"\(N \+ 2, n\)"):
        synthesize(OptimalBasis.uniform(0), np.zeros((1, 2, 3)), np.zeros(3), np.zeros(3), LIMITS)
