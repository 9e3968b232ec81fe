"""The one evaluator: evaluation, exact extrema, limits, interpolation of points, cutting and joining."""

import itertools

import numpy as np
import pytest
from scipy.interpolate import BPoly, CubicHermiteSpline, PPoly

from vpsto_ros.exceptions import InvalidInputError, VpstoError
from vpsto_ros.trajectory import Limits, Trajectory


def random_trajectory(seed, segments=7, dof=3, degree=5, start=0.4):
    """Random polynomials; they need not join, which the evaluator does not ask for."""
    rng = np.random.default_rng(seed)
    times = start + np.append(0.0, np.cumsum(rng.uniform(0.05, 1.5, segments)))
    coefficients = rng.normal(size=(segments, 6, dof))
    coefficients[:, degree + 1 :] = 0.0
    return Trajectory(times, coefficients)


def random_points(seed, count=8, dof=3, spacing=0.5):
    rng = np.random.default_rng(seed)
    times = np.cumsum(rng.uniform(0.2, 1.0, count)) * spacing
    return times, *rng.normal(size=(3, count, dof))


def as_ppoly(trajectory):
    return PPoly(trajectory.coefficients.transpose(1, 0, 2)[::-1], trajectory.times)


def inside(trajectory, count=400):
    return np.linspace(trajectory.start_time, trajectory.end_time, count + 1)[:-1]


@pytest.mark.parametrize("order", range(6))
def test_evaluation_equals_scipy(order):
    trajectory = random_trajectory(1)
    t = inside(trajectory)
    expected = as_ppoly(trajectory)(t, order)
    np.testing.assert_allclose(trajectory(t, order), expected, rtol=1e-11, atol=1e-11)
    for k in (0, 17, 333):
        np.testing.assert_array_equal(trajectory(t[k], order), trajectory(t, order)[k])
        np.testing.assert_array_equal(trajectory(float(t[k]), order), trajectory(t, order)[k])
    # At the end the last segment counts, as if extended.
    np.testing.assert_allclose(
        trajectory(trajectory.end_time, order), as_ppoly(trajectory)(trajectory.end_time, order), rtol=1e-11
    )


def test_state_is_all_three_orders():
    trajectory = random_trajectory(2)
    for t in (-1.0, trajectory.start_time, *trajectory.times[1:], 1.234, 99.0):
        for order, got in enumerate(trajectory.state(t)):
            np.testing.assert_array_equal(got, trajectory(t, order))


def test_boundary_positions_are_held_outside():
    trajectory = random_trajectory(3)
    for outside, boundary in (
        (trajectory.start_time - 1e-9, trajectory.start_time),
        (1e9, trajectory.end_time),
    ):
        np.testing.assert_array_equal(trajectory(outside), trajectory(boundary))
        for order in range(1, 6):
            np.testing.assert_array_equal(trajectory(outside, order), np.zeros(3))
    np.testing.assert_array_equal(trajectory(np.inf), trajectory(trajectory.end_time))
    assert np.all(trajectory(trajectory.start_time, 1) == trajectory.coefficients[0, 1])


def test_knots():
    trajectory = random_trajectory(4)
    for order, values in enumerate(trajectory.knots()):
        np.testing.assert_array_equal(values[:-1], [1, 1, 2][order] * trajectory.coefficients[:, order])
        np.testing.assert_array_equal(values[-1], trajectory(trajectory.end_time, order))


@pytest.mark.parametrize("degree", range(6))
@pytest.mark.parametrize("order", range(3))
def test_extrema_bound_all_instants_and_are_reached(degree, order):
    for seed in range(12):
        trajectory = random_trajectory(100 + seed, segments=1 + seed % 5, degree=degree)
        lower, upper = trajectory.extrema(order)
        edges = np.concatenate(
            [np.linspace(a, np.nextafter(b, a), 4001) for a, b in itertools.pairwise(trajectory.times)]
        )
        # Just before a knot the left piece counts: PPoly evaluated there, close enough to its end.
        values = as_ppoly(trajectory)(edges, order)
        scale = np.abs(values).max() + 1e-300
        assert np.all(values.min(axis=0) >= lower - 1e-9 * scale)
        assert np.all(values.max(axis=0) <= upper + 1e-9 * scale)
        assert np.all(values.min(axis=0) <= lower + 1e-5 * scale)
        assert np.all(values.max(axis=0) >= upper - 1e-5 * scale)


@pytest.mark.parametrize("order", range(3))
def test_extrema_equal_those_at_scipys_roots(order):
    for seed in range(40):
        trajectory = random_trajectory(200 + seed, segments=1, dof=1)
        curve = as_ppoly(trajectory).derivative(order) if order else as_ppoly(trajectory)
        candidates = np.concatenate([trajectory.times, *curve.derivative().roots(extrapolate=False)])
        values = curve(candidates)
        lower, upper = trajectory.extrema(order)
        scale = np.abs(values).max()
        assert lower[0] == pytest.approx(values.min(), abs=1e-12 * scale)
        assert upper[0] == pytest.approx(values.max(), abs=1e-12 * scale)


@pytest.mark.parametrize(
    "roots",
    [
        [0.5, 0.5, 0.5, 0.5],
        [0.25, 0.25, 0.75, 0.75],
        [0.0, 0.5, 1.0, 1.0],
        [0.0, 0.0, 1.0, 1.0],
        [0.5, 0.5 + 1e-7, 0.9],
        [0.5, 0.5 + 1e-12, 0.9, 1e-15],
        [1e-8, 1.0 - 1e-8],
        [0.1, 0.2, 0.3, 0.4],
    ],
)
def test_extrema_with_clustered_stationary_points(roots):
    slope = np.polynomial.Polynomial.fromroots(roots)
    curve = slope.integ()
    coefficients = np.zeros((1, 6, 1))
    coefficients[0, : curve.coef.size, 0] = curve.coef
    trajectory = Trajectory([0.0, 1.0], coefficients)
    values = curve(np.array([0.0, 1.0, *roots]))
    lower, upper = trajectory.extrema(0)
    assert lower[0] == pytest.approx(values.min(), abs=1e-14)
    assert upper[0] == pytest.approx(values.max(), abs=1e-14)


def test_extrema_scale_with_time_and_size():
    trajectory = random_trajectory(5)
    factors = 1e-3 ** np.arange(6)[:, None]
    slow = Trajectory(1e3 * trajectory.times, 1e-6 * factors * trajectory.coefficients)
    for order in range(3):
        for a, b in zip(trajectory.extrema(order), slow.extrema(order), strict=True):
            np.testing.assert_allclose(1e-6 * 1e-3**order * a, b, rtol=1e-9)


def test_violations_in_words():
    points = np.array([[0.0, 0.0], [1.0, -1.0]])
    trajectory = Trajectory.from_points([0.0, 1.0], points, np.zeros((2, 2)))  # speed 1.5, acceleration 6
    assert trajectory.violations(Limits([1.5, 1.5], [6.0, 6.0], [0.0, -1.0], [1.0, 0.0])) == []
    assert trajectory.violations(Limits([1.6, 1.4], [6.0, 7.0])) == ["velocity of joint 2: -1.5 < -1.4"]
    assert trajectory.violations(Limits([9.0, 9.0], [5.0, 9.0])) == [
        "acceleration of joint 1: -6 < -5",
        "acceleration of joint 1: 6 > 5",
    ]
    assert trajectory.violations(Limits([9.0, 9.0], [9.0, 9.0], upper=[0.5, 9.0])) == [
        "position of joint 1: 1 > 0.5"
    ]
    assert trajectory.violations(Limits([9.0, 9.0], [9.0, 9.0], lower=[-1, -0.25])) == [
        "position of joint 2: -1 < -0.25"
    ]


def test_violations_between_samples_are_found_and_tolerance_is_relative():
    trajectory = Trajectory.from_points([0.0, 2.0], [[0.0], [1.0]], [[0.0], [0.0]])  # peak speed 0.75
    assert trajectory.violations(Limits([0.75 * (1 - 5e-10)], [np.inf])) == []
    assert len(trajectory.violations(Limits([0.75 * (1 - 2e-9)], [np.inf]))) == 1
    assert trajectory.violations(Limits([0.74], [np.inf]), relative_tolerance=0.1) == []
    with pytest.raises(InvalidInputError, match="degrees of freedom"):
        trajectory.violations(Limits([1.0, 1.0], [1.0, 1.0]))


def test_points_without_velocities_are_joined_by_lines():
    times, positions, _, _ = random_points(6)
    trajectory = Trajectory.from_points(times, positions)
    for t in (times[2], 0.3 * times[2] + 0.7 * times[3]):
        expected = [np.interp(t, times, column) for column in positions.T]
        np.testing.assert_allclose(trajectory(t), expected, atol=1e-13)
    assert np.all(trajectory(times, 2) == 0.0)


def test_points_with_velocities_are_joined_by_cubics():
    times, positions, velocities, _ = random_points(7)
    expected = CubicHermiteSpline(times, positions, velocities)
    missing = np.full_like(positions, np.nan)
    for trajectory in (
        Trajectory.from_points(times, positions, velocities),
        Trajectory.from_points(times, positions, velocities, missing),
    ):
        for order in range(3):
            t = inside(trajectory)
            np.testing.assert_allclose(trajectory(t, order), expected(t, order), atol=1e-9)


def test_points_with_accelerations_are_joined_by_quintics():
    times, positions, velocities, accelerations = random_points(8)
    expected = BPoly.from_derivatives(times, np.stack([positions, velocities, accelerations], axis=1))
    trajectory = Trajectory.from_points(times, positions, velocities, accelerations)
    t = inside(trajectory)
    for order in range(3):
        scale = np.abs(expected(t, order)).max()
        np.testing.assert_allclose(trajectory(t, order), expected(t, order), atol=1e-11 * scale)
    for order, values in enumerate((positions, velocities, accelerations)):
        np.testing.assert_allclose(trajectory(times, order), values, atol=1e-9)


def test_segments_with_one_acceleration_stay_cubic():
    times, positions, velocities, accelerations = random_points(9)
    accelerations[3, 1] = np.nan  # one missing number makes the whole row missing
    trajectory = Trajectory.from_points(times, positions, velocities, accelerations)
    cubic = Trajectory.from_points(times, positions, velocities)
    np.testing.assert_array_equal(trajectory.coefficients[2:4], cubic.coefficients[2:4])
    assert np.all(trajectory.coefficients[[0, 1, 4], 5] != 0)


@pytest.mark.parametrize("step", [1e-3, 0.02, 0.3, 10.0])
def test_a_quintic_that_is_a_cubic_comes_out_exactly(step):
    rng = np.random.default_rng(10)
    for _ in range(50):
        c = rng.normal(size=(1, 6, 4))
        c[:, 4:] = 0.0
        truth = Trajectory([0.0, step], c)
        positions, velocities, accelerations = (truth([0.0, step], order) for order in range(3))
        again = Trajectory.from_points([0.0, step], positions, velocities, accelerations)
        assert np.all(again.coefficients[:, 4:] == 0.0)
        t = np.linspace(0, step, 50)
        for order in range(3):
            scale = max(1.0, np.abs(truth(t, order)).max())
            np.testing.assert_allclose(again(t, order), truth(t, order), atol=1e-12 * scale, rtol=0)


def test_a_small_true_quintic_is_not_mistaken_for_a_cubic():
    c = np.zeros((1, 6, 1))
    c[0, :, 0] = 1.0, 0.5, -0.2, 0.1, 1e-6, -1e-6
    truth = Trajectory([0.0, 0.5], c)
    points = [truth([0.0, 0.5], order) for order in range(3)]
    np.testing.assert_allclose(Trajectory.from_points([0.0, 0.5], *points).coefficients, c, atol=1e-12)


@pytest.mark.parametrize(
    "arguments",
    [
        ([0.0], np.zeros((1, 2))),
        ([0.0, 0.0], np.zeros((2, 2))),
        ([1.0, 0.0], np.zeros((2, 2))),
        ([0.0, 1.0], np.zeros((3, 2))),
        ([0.0, 1.0], np.zeros(2)),
        ([0.0, 1.0], np.zeros((2, 2)), np.zeros((2, 3))),
        ([0.0, 1.0], np.zeros((2, 2)), None, np.zeros((2, 2))),
        ([0.0, 1.0], np.full((2, 2), np.nan), np.zeros((2, 2))),
        ([0.0, 1.0], np.zeros((2, 2)), np.full((2, 2), np.inf)),
        ([0.0, 1.0], *np.zeros((2, 2, 2)), [[np.inf, 0.0], [0.0, 0.0]]),
        ([0.0, np.inf], np.zeros((2, 2))),
        ([0.0, np.nan], np.zeros((2, 2))),
        ([[0.0, 1.0]], np.zeros((2, 2))),
    ],
)
def test_refuses_bad_points(arguments):
    with pytest.raises(InvalidInputError):
        Trajectory.from_points(*arguments)


@pytest.mark.parametrize(
    ("times", "shape"),
    [([0.0, 1.0], (1, 4, 2)), ([0.0, 1.0], (2, 6, 2)), ([0.0], (0, 6, 2)), ([0.0, 1.0], (1, 6, 0))],
)
def test_refuses_bad_coefficients(times, shape):
    with pytest.raises(InvalidInputError):
        Trajectory(times, np.zeros(shape))


def test_refuses_bad_evaluations():
    trajectory = random_trajectory(11)
    for call in (
        lambda: trajectory(np.nan),
        lambda: trajectory([0.0, np.nan]),
        lambda: trajectory([[0.0]]),
        lambda: trajectory(0.0, 6),
        lambda: trajectory(0.0, -1),
        lambda: trajectory.state(np.nan),
        lambda: trajectory.extrema(3),
        lambda: trajectory.clipped(1.0, 1.0),
    ):
        with pytest.raises(VpstoError):
            call()


def test_a_trajectory_is_a_value():
    times, coefficients = np.array([0.0, 1.0]), np.ones((1, 6, 2))
    trajectory = Trajectory(times, coefficients)
    times[1], coefficients[:] = 5.0, 7.0
    assert trajectory.end_time == 1.0 and trajectory.coefficients.max() == 1.0
    for array in (trajectory.times, trajectory.coefficients):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 2.0


@pytest.mark.parametrize("seed", range(30))
def test_clipping_keeps_the_motion(seed):
    trajectory = random_trajectory(300 + seed)
    rng = np.random.default_rng(seed)
    start, end = np.sort(rng.uniform(trajectory.start_time - 0.5, trajectory.end_time + 0.5, 2))
    if seed % 3 == 0:
        start, end = trajectory.times[1], trajectory.times[4]
    part = trajectory.clipped(start, end)
    assert (part.start_time, part.end_time) == (start, end)
    # Right at a knot the two may decide differently by an ulp, so look inside.
    t = np.setdiff1d(np.linspace(start, end, 200)[1:-1], trajectory.times)
    for order in range(4):
        np.testing.assert_allclose(part(t, order), trajectory(t, order), rtol=1e-9, atol=1e-9)
    # A clip of a clip is the clip.
    middle = 0.7 * start + 0.3 * end, 0.2 * start + 0.8 * end
    t = np.linspace(*middle, 50)[1:-1]
    np.testing.assert_allclose(part.clipped(*middle)(t), trajectory.clipped(*middle)(t), rtol=1e-9, atol=1e-9)


def test_clipping_to_the_whole_changes_nothing():
    trajectory = random_trajectory(12)
    whole = trajectory.clipped(trajectory.start_time, trajectory.end_time)
    np.testing.assert_array_equal(whole.times, trajectory.times)
    np.testing.assert_array_equal(whole.coefficients, trajectory.coefficients)


def test_clipping_beyond_the_ends_holds():
    trajectory = random_trajectory(13)
    wide = trajectory.clipped(trajectory.start_time - 1.0, trajectory.end_time + 2.0)
    for t in (trajectory.start_time - 0.5, trajectory.end_time + 1.0):
        np.testing.assert_allclose(wide(t), trajectory(t), atol=1e-12)
        np.testing.assert_array_equal(wide(t, 1), np.zeros(3))
    after = trajectory.clipped(trajectory.end_time, trajectory.end_time + 1.0)
    np.testing.assert_array_equal(after(after.end_time), trajectory(trajectory.end_time))


@pytest.mark.parametrize("seed", range(10))
def test_cutting_and_joining_gives_the_same(seed):
    trajectory = random_trajectory(400 + seed)
    cut = np.random.default_rng(seed).uniform(trajectory.start_time, trajectory.end_time)
    joined = trajectory.clipped(trajectory.start_time, cut).followed_by(
        trajectory.clipped(cut, trajectory.end_time)
    )
    t = np.setdiff1d(inside(trajectory), trajectory.times)
    for order in range(3):
        np.testing.assert_allclose(joined(t, order), trajectory(t, order), rtol=1e-9, atol=1e-9)


def test_shifting():
    trajectory = random_trajectory(14)
    later = trajectory.shifted(2.5)
    assert later.duration == pytest.approx(trajectory.duration)
    t = np.setdiff1d(inside(trajectory), trajectory.times)
    for order in range(3):
        np.testing.assert_allclose(later(t + 2.5, order), trajectory(t, order), rtol=1e-9, atol=1e-9)


def test_joining_tolerates_a_nanosecond_but_no_more():
    first, second = random_trajectory(15), random_trajectory(16)
    joined = first.followed_by(second.shifted(first.end_time - second.start_time + 5e-10))
    assert joined.dof == 3 and len(joined.times) == len(first.times) + len(second.times) - 1
    with pytest.raises(InvalidInputError, match="shift or clip"):
        first.followed_by(second)
    with pytest.raises(InvalidInputError, match="degrees of freedom"):
        first.followed_by(random_trajectory(16, dof=2))


def test_jumps():
    smooth = Trajectory.from_points(*random_points(17)[:3])
    position, velocity = smooth.jumps()
    assert np.all(position < 1e-12) and np.all(velocity < 1e-12)
    times, positions, _, _ = random_points(17)
    position, velocity = Trajectory.from_points(times, positions).jumps()
    slopes = np.diff(positions, axis=0) / np.diff(times)[:, None]
    np.testing.assert_allclose(velocity, np.abs(np.diff(slopes, axis=0)).max(axis=0))
    assert np.all(position < 1e-12)
    one = smooth.clipped(smooth.start_time, smooth.times[1])
    step = Trajectory(one.times, one.coefficients + np.eye(6, 1)[None] * 0.25).shifted(one.duration)
    assert np.all(one.followed_by(step).jumps()[0] > 0.0)
    assert np.all(one.jumps()[0] == 0.0)
