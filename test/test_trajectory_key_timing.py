"""Timing of key positions: against brute force over phases, finite differences and exact extrema; laws."""

import dataclasses
import itertools

import numpy as np
import pytest

from vpsto_ros.exceptions import ConfigurationError, InfeasibleError, InvalidInputError
from vpsto_ros.trajectory import (
    MINIMUM_DURATION,
    KeyTimingConfig,
    Limits,
    OptimalBasis,
    Trajectory,
    minimal_duration,
    synthesize,
    time_key_positions,
)
from vpsto_ros.trajectory.key_timing import first_guesses
from vpsto_ros.trajectory.limit_constraints import LimitConstraints


def box(dof, velocity=1.0, acceleration=2.0):
    return Limits(np.full(dof, velocity), np.full(dof, acceleration))


def random_case(seed, n_via, dof, boundary="rest"):
    """Key positions, boundary velocities (2, n) and limits; the steps differ by a factor of 20."""
    rng = np.random.default_rng(seed)
    steps = rng.uniform(-1.0, 1.0, (n_via + 2, dof)) * np.exp(rng.uniform(-3.0, 0.0, (n_via + 2, 1)))
    limits = Limits(rng.uniform(0.5, 2.0, dof), rng.uniform(0.5, 4.0, dof))
    ends = {
        "rest": np.zeros((2, dof)),
        "moving": rng.uniform(-0.9, 0.9, (2, dof)),
        "on the limit": rng.choice([-1.0, 0.0, 1.0], (2, dof)),
    }[boundary]
    return steps.cumsum(axis=0), ends * limits.velocity, limits


def timed_case(seed, n_via, dof, boundary="rest", **options):
    keys, ends, limits = random_case(seed, n_via, dof, boundary)
    timed = time_key_positions(keys, limits, start_velocity=ends[0], end_velocity=ends[1], **options)
    return keys, ends, limits, timed


def assert_sound(keys, ends, limits, timed):
    """Within all limits at every instant, through the key positions in order, never slower than before."""
    motion = timed.trajectory
    assert motion.violations(dataclasses.replace(limits, lower=None, upper=None)) == []
    assert timed.duration == pytest.approx(motion.duration, rel=1e-12)
    assert timed.duration <= timed.equal_spacing
    assert np.all(np.diff(timed.phases, prepend=0.0) > 0.0)
    assert timed.phases[-1] == 1.0
    np.testing.assert_allclose(
        motion.times - motion.start_time, timed.duration * np.append(0.0, timed.phases), rtol=1e-12
    )
    scale = max(1.0, np.abs(keys).max())
    np.testing.assert_allclose(motion(motion.times), keys, atol=1e-12 * scale)
    np.testing.assert_allclose(motion([motion.start_time, motion.end_time], 1), ends, atol=1e-12)


def brute_force(keys, ends, limits):
    """Shortest minimal duration over a grid of phases, refined around the best one."""

    def duration(logarithms):
        share = np.exp(np.append(logarithms, 0.0))
        phases = np.cumsum(share / share.sum())
        phases[-1] = 1.0
        return minimal_duration(OptimalBasis(phases), keys, *ends, limits)

    free = len(keys) - 2
    grid = np.linspace(-4.0, 4.0, 161 if free == 1 else 17)
    best = min(itertools.product(grid, repeat=free), key=duration)
    width = grid[1] - grid[0]
    for _ in range(10):
        width /= 2.0
        moves = itertools.product((-2.0 * width, -width, 0.0, width, 2.0 * width), repeat=free)
        best = min((np.add(best, move) for move in moves), key=duration)
    return duration(best)


@pytest.mark.parametrize("boundary", ["rest", "moving", "on the limit"])
@pytest.mark.parametrize(("n_via", "dof"), [(1, 1), (1, 3), (2, 1), (2, 2)])
@pytest.mark.parametrize("seed", [1000, 1001])
def test_brute_force_finds_nothing_shorter(seed, n_via, dof, boundary):
    keys, ends, limits, timed = timed_case(seed, n_via, dof, boundary)
    assert_sound(keys, ends, limits, timed)
    assert timed.duration <= brute_force(keys, ends, limits) * 1.001


@pytest.mark.parametrize("boundary", ["rest", "moving", "on the limit"])
@pytest.mark.parametrize(("seed", "n_via", "dof"), [(1000, 3, 7), (1001, 6, 2), (1002, 8, 3)])
def test_more_starts_find_nothing_shorter(seed, n_via, dof, boundary):
    keys, ends, limits, timed = timed_case(seed, n_via, dof, boundary)
    assert_sound(keys, ends, limits, timed)
    config, rng = KeyTimingConfig(perturbations=8), np.random.default_rng(seed)
    again = timed_case(seed, n_via, dof, boundary, config=config, rng=rng)[3]
    assert timed.duration / 1.001 <= again.duration <= timed.duration


@pytest.mark.parametrize("boundary", ["rest", "moving", "on the limit"])
@pytest.mark.parametrize("monotone", [False, True])
@pytest.mark.parametrize(("n_via", "dof"), [(1, 1), (2, 3), (7, 4)])
def test_derivatives_by_finite_differences(n_via, dof, monotone, boundary):
    keys, ends, limits = random_case(5, n_via, dof, boundary)
    constraints = LimitConstraints(keys, ends, limits)
    durations = np.random.default_rng(6).uniform(0.2, 0.6, n_via + 1)
    values, slopes = constraints.slack(durations, monotone)
    step = 1e-6
    for k, direction in enumerate(np.eye(n_via + 1) * step):
        after, before = (constraints.slack(durations + sign * direction, monotone)[0] for sign in (1, -1))
        scale = np.abs(slopes).max()
        np.testing.assert_allclose(slopes[:, k], (after - before) / (2 * step), atol=1e-7 * scale)
    assert values.shape == slopes.shape[:1]
    assert np.abs(slopes).max() > 0.1


@pytest.mark.parametrize("quantity", ["velocity", "acceleration"])
def test_slack_is_that_of_the_exact_extrema(quantity):
    for seed in range(20):
        keys, ends, _ = random_case(seed, 4, 1, "moving")
        durations = np.random.default_rng(seed).uniform(0.1, 3.0, 5)
        knots = np.append(0.0, np.cumsum(durations))
        basis = OptimalBasis(knots[1:] / knots[-1])
        w = np.concatenate([keys, knots[-1] * ends])
        motion = Trajectory.from_points(knots, keys, basis.knot_slopes @ w / knots[-1])
        largest = np.abs(motion.extrema(1 if quantity == "velocity" else 2)).max()
        bounds = {"velocity": [50.0], "acceleration": [np.inf]}
        if quantity == "acceleration":
            bounds = {"velocity": [np.inf], "acceleration": [300.0]}
        slack = LimitConstraints(keys, ends, Limits(**bounds)).slack(durations)[0]
        reached = bounds[quantity][0] * np.sqrt(1.0 - 2.0 * slack.min())
        # The boundary velocities are given, and no row stands for them.
        given = np.abs(ends).max() if quantity == "velocity" else 0.0
        assert max(reached, given) == pytest.approx(largest)


@pytest.mark.parametrize(("n_via", "dof", "boundary"), [(20, 14, "rest"), (20, 2, "moving"), (40, 1, "rest")])
def test_many_key_positions(n_via, dof, boundary):
    keys, ends, limits, timed = timed_case(7, n_via, dof, boundary)
    assert_sound(keys, ends, limits, timed)
    assert timed.duration < 0.9 * timed.equal_spacing


def test_uneven_spacing_gains_much_and_a_lone_segment_nothing():
    keys = np.array([[0.0, 0.0], [0.05, 0.02], [0.1, 0.0], [1.0, 0.4], [1.05, 0.4]])
    timed = time_key_positions(keys, box(2))
    assert timed.duration < 0.6 * timed.equal_spacing
    direct = time_key_positions(keys[[0, -1]], box(2))
    still = np.zeros(2)
    assert direct.duration == direct.equal_spacing
    assert (
        direct.duration == synthesize(OptimalBasis.uniform(0), keys[[0, -1]], still, still, box(2)).duration
    )


def test_laws_of_scaling_and_symmetry():
    keys, ends, limits, timed = timed_case(8, 4, 3, "moving")
    start, end = ends

    def duration(q, bounds, v0, v1):
        return time_key_positions(q, bounds, start_velocity=v0, end_velocity=v1).duration

    wider = Limits(3.0 * limits.velocity, 3.0 * limits.acceleration)
    assert duration(3.0 * keys, wider, 3.0 * start, 3.0 * end) == pytest.approx(timed.duration, rel=1e-6)
    slower = Limits(limits.velocity / 2.0, limits.acceleration / 4.0)
    assert duration(keys, slower, start / 2, end / 2) == pytest.approx(2.0 * timed.duration, rel=1e-6)
    assert duration(keys[::-1], limits, -end, -start) == pytest.approx(timed.duration, rel=1e-6)
    assert duration(10.0 - keys, limits, -start, -end) == pytest.approx(timed.duration, rel=1e-6)
    flipped = Limits(limits.velocity[::-1], limits.acceleration[::-1])
    assert duration(keys[:, ::-1], flipped, start[::-1], end[::-1]) == pytest.approx(timed.duration, rel=1e-6)


def test_repeated_key_positions_cost_next_to_nothing():
    # Stopping half way takes twice sqrt(6 d / a); the repeated key position only has to be passed at rest.
    bounds, halves = box(1), 2.0 * np.sqrt(6.0 * 0.5 / 2.0)
    for keys in ([[0.0], [0.5], [0.5], [1.0]], [[0.0], [0.5], [0.5], [0.5], [1.0]]):
        timed = time_key_positions(keys, bounds)
        assert_sound(np.array(keys), np.zeros((2, 1)), bounds, timed)
        assert halves <= timed.duration * (1.0 + 1e-9)
        assert timed.duration <= 1.001 * halves
    for keys in ([[0.0], [0.0], [0.5], [1.0]], [[0.0], [0.5], [1.0], [1.0]]):
        assert time_key_positions(keys, bounds).duration <= 1.001 * np.sqrt(6.0 / 2.0)


def test_a_joint_that_stands_still_does_not_matter():
    keys, _, limits = random_case(9, 3, 2)
    more = Limits(np.append(limits.velocity, 1e-3), np.append(limits.acceleration, 1e-3))
    with_idle = time_key_positions(np.column_stack([keys, np.full(5, 0.7)]), more)
    assert with_idle.duration == pytest.approx(time_key_positions(keys, limits).duration, rel=1e-9)


def test_nothing_moves():
    for keys in (np.ones((2, 3)), np.ones((5, 3))):
        timed = time_key_positions(keys, box(3))
        assert timed.duration == timed.equal_spacing == MINIMUM_DURATION


@pytest.mark.parametrize("infinite", ["velocity", "acceleration", "both"])
def test_infinite_limits(infinite):
    velocity = np.inf if infinite != "acceleration" else 1.0
    acceleration = np.inf if infinite != "velocity" else 2.0
    limits = box(2, velocity, acceleration)
    keys, ends, _ = random_case(10, 3, 2, "moving")
    timed = time_key_positions(keys, limits, start_velocity=0.3 * ends[0])
    assert_sound(keys, np.stack([0.3 * ends[0], 0 * ends[1]]), limits, timed)
    if infinite == "both":
        assert timed.duration == MINIMUM_DURATION
    else:
        assert timed.duration < 0.95 * timed.equal_spacing
    mixed = Limits([np.inf, 1.0], [2.0, np.inf])
    assert_sound(keys, np.zeros((2, 2)), mixed, time_key_positions(keys, mixed))


def test_full_speed_all_along():
    # Constant speed 1 takes 1 s; a little longer is impossible, since braking and speeding up take time.
    keys, one = np.array([[0.0], [0.1], [0.7], [1.0]]), np.ones(1)
    options = {"start_velocity": one, "end_velocity": one}
    timed = time_key_positions(keys, box(1), **options)
    assert timed.duration == pytest.approx(1.0, rel=1e-8)
    assert_sound(keys, np.ones((2, 1)), box(1), timed)
    basis = OptimalBasis(timed.phases)
    with pytest.raises(InfeasibleError):
        synthesize(basis, keys, one, one, box(1), duration=2.0)
    free = time_key_positions(keys, box(1), config=KeyTimingConfig(stretchable=True), **options)
    assert_sound(keys, np.ones((2, 1)), box(1), free)
    for factor in np.geomspace(1.0 + 1e-9, 20.0, 40):
        synthesize(OptimalBasis(free.phases), keys, one, one, box(1), duration=factor * free.duration)


@pytest.mark.parametrize("seed", [1000, 1001, 1002])
def test_stretchable_results_can_be_slowed_down(seed):
    keys, ends, limits, timed = timed_case(seed, 3, 2, "moving", config=KeyTimingConfig(stretchable=True))
    assert_sound(keys, ends, limits, timed)
    for factor in np.geomspace(1.0 + 1e-9, 30.0, 40):
        synthesize(OptimalBasis(timed.phases), keys, *ends, limits, duration=factor * timed.duration)


def test_one_joint_takes_plain_numbers_as_velocities():
    keys = [[0.0], [0.2], [1.0]]
    plain = time_key_positions(keys, box(1), start_velocity=0.5)
    assert plain.duration == time_key_positions(keys, box(1), start_velocity=[0.5]).duration


def test_same_seed_same_result_and_inputs_untouched():
    keys, ends, limits = random_case(11, 4, 2, "moving")
    copy = keys.copy()
    options = {"start_velocity": ends[0], "end_velocity": ends[1]}
    first, second = (
        time_key_positions(keys, limits, rng=np.random.default_rng(3), **options) for _ in range(2)
    )
    np.testing.assert_array_equal(first.phases, second.phases)
    np.testing.assert_array_equal(keys, copy)
    later = time_key_positions(keys, limits, rng=np.random.default_rng(3), start_time=5.0, **options)
    assert later.trajectory.start_time == 5.0
    np.testing.assert_array_equal(later.phases, first.phases)


def test_first_guesses_follow_the_distances():
    keys = np.array([[0.0, 0.0], [3.0, 4.0], [3.0, 4.0], [3.0, 5.0]])
    equal, chord, alone = first_guesses(keys, Limits([1.0, 1.0], [np.inf, 4.0]))
    np.testing.assert_array_equal(equal, 1.0)
    np.testing.assert_allclose(chord, [5.0, 0.1, 1.0])  # 0.05 of the mean instead of nothing
    np.testing.assert_allclose(alone[[0, 2]], [4.0, 1.0])
    assert len(first_guesses(np.ones((3, 2)), box(2))) == 1


@pytest.mark.parametrize(
    "keys", [[[0.0, 0.0]], [0.0, 1.0], np.zeros((2, 3, 2)), [[0.0], [1.0]], [[0.0, np.nan], [1.0, 1.0]], [],
             [[0.0, np.inf], [1.0, 1.0]]],
)  # fmt: skip
def test_refuses_bad_key_positions(keys):
    with pytest.raises(InvalidInputError, match="key positions"):
        time_key_positions(keys, box(2))


def test_refuses_ragged_rows_bad_generators_and_bad_times():
    keys = [[0.0, 0.0], [0.5, 0.1], [1.0, 1.0]]
    for bad in ([[0.0, 0.0], [1.0]], [["a", "b"], [0.0, 1.0]], None):
        with pytest.raises(InvalidInputError, match="key positions"):
            time_key_positions(bad, box(2))
    with pytest.raises(InvalidInputError, match="rng"):
        time_key_positions(keys, box(2), rng=3)
    for bad in (np.nan, "x", None):
        with pytest.raises(InvalidInputError, match="start_time"):
            time_key_positions(keys, box(2), start_time=bad)
    with pytest.raises(InvalidInputError, match="limits must be a Limits"):
        time_key_positions(keys, None)
    with pytest.raises(InvalidInputError, match="config must be a KeyTimingConfig"):
        time_key_positions(keys, box(2), config={})
    with pytest.raises(InvalidInputError, match="key positions"):
        time_key_positions(keys, box(3))


@pytest.mark.parametrize(
    "velocity", [[0.0], [0.0, np.nan], np.zeros((2, 2)), np.zeros((2, 1)), 0.0, np.zeros(3), "ab"]
)
def test_refuses_bad_boundary_velocities(velocity):
    keys = [[0.0, 0.0], [0.5, 0.1], [1.0, 1.0]]
    with pytest.raises(InvalidInputError, match="velocity"):
        time_key_positions(keys, box(2), start_velocity=velocity)
    with pytest.raises(InvalidInputError, match="velocity"):
        time_key_positions(keys, box(2), end_velocity=velocity)


def test_says_when_a_boundary_velocity_is_beyond_its_limit():
    keys = [[0.0, 0.0], [0.5, 0.1], [1.0, 1.0]]
    with pytest.raises(InfeasibleError, match="joint 2 is beyond its limit 1"):
        time_key_positions(keys, box(2), end_velocity=[0.0, 1.01])


@pytest.mark.parametrize(
    "options",
    [{"iterations": 0}, {"tolerance": 0.0}, {"perturbations": -1}, {"spread": -0.1}, {"shortest": 0.0},
     {"shortest": 0.9}, {"iterations": 3.5}, {"stretchable": 1}, {"tolerance": np.nan}],
)  # fmt: skip
def test_refuses_bad_options(options):
    with pytest.raises(ConfigurationError, match=next(iter(options))):
        KeyTimingConfig(**options)
