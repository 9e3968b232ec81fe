"""The minimal duration: laws on random problems, and an oracle that knows nothing of closed forms."""

import numpy as np
import pytest
from scipy.interpolate import CubicHermiteSpline, CubicSpline

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import MINIMUM_DURATION, Limits, OptimalBasis, minimal_duration, synthesize_batch

BOUNDARIES = ("rest", "inside", "on the limit", "nearly on the limit")


def random_basis(rng, n_via):
    if rng.uniform() < 0.5 or n_via == 0:
        return OptimalBasis.uniform(n_via)
    gaps = rng.uniform(0.1, 1.0, n_via + 1)
    phases = np.cumsum(gaps) / gaps.sum()
    phases[-1] = 1.0
    return OptimalBasis(phases)


def boundary_velocity(rng, limit, batch, kind):
    share = rng.uniform(-1, 1, (batch, limit.size))
    if kind == "rest":
        share[:] = 0.0
    elif kind != "inside":
        share = np.where(rng.uniform(size=share.shape) < 0.6, np.sign(share), share)
        if kind == "nearly on the limit":
            share *= 1.0 - 10.0 ** rng.uniform(-16, -3, share.shape)
    return share * limit


def random_problems(seed, batch=60):
    """One basis and limits, many key positions and boundary velocities of every kind."""
    rng = np.random.default_rng(seed)
    n, n_via = int(rng.integers(1, 15)), int(rng.integers(0, 9))
    limits = Limits(rng.uniform(0.5, 3.0, n), 10.0 ** rng.uniform(-0.5, 2.5, n))
    keys = 10.0 ** rng.uniform(-2, 0.5, (batch, 1, 1)) * rng.normal(size=(batch, n_via + 2, n))
    if rng.uniform() < 0.5:
        keys = np.cumsum(np.abs(keys), axis=1)
    kinds = rng.choice(BOUNDARIES, 2)
    start, end = (boundary_velocity(rng, limits.velocity, batch, kind) for kind in kinds)
    return random_basis(rng, n_via), keys, start, end, limits


def worst_loads(basis, keys, start, end, limits, duration):
    """Largest |q̇| / limit over all instants and |q̈| / limit, from SciPy's spline in time."""
    spline = CubicSpline(duration * basis.knots, keys, bc_type=((1, start), (1, end)))
    c3, c2, c1 = spline.c[0], spline.c[1], spline.c[2]
    h = np.diff(spline.x)[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        vertex = np.clip(np.nan_to_num(-c2 / (3 * c3)), 0.0, h)
    speeds = [np.abs(c1 + 2 * c2 * t + 3 * c3 * t * t) for t in (0 * h, vertex, h)]
    accelerations = [np.abs(2 * c2), np.abs(2 * c2 + 6 * c3 * h)]
    return np.max(speeds / limits.velocity), np.max(accelerations / limits.acceleration)


@pytest.mark.parametrize("seed", range(50))
def test_limits_are_touched_and_never_exceeded(seed):
    basis, keys, start, end, limits = random_problems(seed)
    durations = minimal_duration(basis, keys, start, end, limits)
    for b, duration in enumerate(durations):
        problem = basis, keys[b], start[b], end[b], limits
        loads = worst_loads(*problem, duration)
        assert max(loads) <= 1.0 + 1e-9
        assert max(loads) >= 1.0 - 1e-6
        for stretch in (1.0001, 1.01, 1.3, 2.0, 7.0, 100.0):
            assert max(worst_loads(*problem, stretch * duration)) <= 1.0 + 1e-9


def dense_phases(basis, per_segment=400):
    """Phases inside every segment, crowded towards 0 and 1 where the ratio may be 0 / 0."""
    u = np.linspace(0, 1, per_segment)
    inner = (basis.knots[:-1, None] + np.diff(basis.knots)[:, None] * u).ravel()
    ends = np.logspace(-7, -2, 60)
    return np.unique(np.concatenate([inner, ends, 1 - ends]))


def sampled_response(basis, s, order):
    """What unit key positions and unit end slopes do at phases s: (K, N + 4), by SciPy's spline."""
    size = basis.n_via + 2
    unit = np.eye(size + 2)
    spline = CubicSpline(basis.knots, unit[:size], bc_type=((1, unit[size]), (1, unit[size + 1])))
    return spline(s, order)


def shortest_by_search(basis, keys, start, end, limits):
    """Minimal durations (B,) by scanning durations downwards and bisecting, on sampled phases."""
    size = basis.n_via + 2
    parts = []
    for order, s in ((1, dense_phases(basis)), (2, basis.knots)):
        response = sampled_response(basis, s, order)
        by_keys = np.einsum("kp,bpn->bkn", response[:, :size], keys)
        by_velocity = np.einsum("kp,bpn->bkn", response[:, size:], np.stack([start, end], axis=1))
        parts.append((by_keys, by_velocity))

    def feasible(b, t):
        speed = np.abs(parts[0][0][b] / t + parts[0][1][b]) / limits.velocity
        acceleration = np.abs(parts[1][0][b] / t**2 + parts[1][1][b] / t) / limits.acceleration
        return max(speed.max(), acceleration.max()) <= 1.0 + 1e-12

    found = []
    for b in range(len(keys)):
        # The smallest duration above which all longer ones are feasible: the first infeasible one from above.
        high = 1e4
        assert feasible(b, high)
        while feasible(b, low := high / 1.05):
            high = low
        while high / low > 1.0 + 1e-7:
            middle = np.sqrt(low * high)
            low, high = (low, middle) if feasible(b, middle) else (middle, high)
        found.append(high)
    return np.array(found)


@pytest.mark.parametrize("seed", range(100, 130))
def test_agrees_with_a_search_over_durations(seed):
    basis, keys, start, end, limits = random_problems(seed, batch=8)
    exact = minimal_duration(basis, keys, start, end, limits)
    searched = shortest_by_search(basis, keys, start, end, limits)
    # Sampling can only miss an extremum, so the search may end up a little shorter, never longer.
    assert np.all(searched <= exact * (1 + 2e-7))
    assert np.all(searched >= exact * (1 - 2e-4))


def test_isolated_shorter_durations_are_passed_over():
    # At constant speed nothing accelerates, but taking a little longer means to brake and speed up again.
    limits = Limits([100.0], [1.0])
    basis, keys = OptimalBasis.uniform(0), np.array([[0.0], [1.0]])
    duration = minimal_duration(basis, keys, [2.0], [2.0], limits)
    assert duration > 1.0
    assert max(worst_loads(basis, keys, [2.0], [2.0], limits, 0.5)) <= 1.0
    assert max(worst_loads(basis, keys, [2.0], [2.0], limits, 0.95 * duration)) > 1.0


def test_constant_speed_at_the_limit():
    # Both ends on the limit, the way just long enough: the ratio is 0 / 0 at both ends and constant between.
    limits = Limits([2.0], [500.0])
    for n_via in range(6):
        basis = OptimalBasis.uniform(n_via)
        keys = 3.0 * basis.knots[:, None]
        assert minimal_duration(basis, keys, [2.0], [2.0], limits) == pytest.approx(1.5, rel=1e-12)
        assert minimal_duration(basis, -keys, [-2.0], [-2.0], limits) == pytest.approx(1.5, rel=1e-12)


def test_both_ends_on_the_limit_and_the_way_backwards():
    # Symmetric up to round-off: the worst instant is the middle, at |q̇| = 3 distance / T - v / 2.
    limits, basis = Limits([1.9552193], [1e6]), OptimalBasis.uniform(0)
    for start in (1.9552193, np.nextafter(1.9552193, 0)):
        for end in (1.9552193, np.nextafter(1.9552193, 0), 1.9552193 * (1 - 1e-13)):
            for keys in ([[0.0], [-0.3]], [[0.0385], [0.0328]], [[1.0], [0.9]]):
                duration = minimal_duration(basis, keys, [start], [end], limits)
                assert duration == pytest.approx(3 * (keys[0][0] - keys[1][0]) / 1.9552193, rel=1e-9)


def test_known_durations_from_rest_to_rest():
    # N = 0 from rest: q' peaks at 1.5, q'' at 6 per unit distance.
    basis, keys = OptimalBasis.uniform(0), np.array([[0.0], [0.8]])
    assert minimal_duration(basis, keys, [0.0], [0.0], Limits([0.5], [1e9])) == pytest.approx(0.8 * 1.5 / 0.5)
    assert minimal_duration(basis, keys, [0.0], [0.0], Limits([1e9], [0.5])) == pytest.approx(
        (4.8 / 0.5) ** 0.5
    )
    unlimited = Limits([np.inf], [np.inf])
    assert minimal_duration(basis, keys, [0.0], [0.0], unlimited) == MINIMUM_DURATION


def test_standing_still():
    basis, limits = OptimalBasis.uniform(2), Limits([1.0, 1.0], [1.0, 1.0])
    still = np.tile([0.3, -2.0], (4, 1))
    assert minimal_duration(basis, still, [0, 0], [0, 0], limits) == MINIMUM_DURATION


def test_velocity_beyond_the_limit_is_infeasible():
    basis, limits = OptimalBasis.uniform(1), Limits([1.0, 1.0], [5.0, 5.0])
    keys = np.zeros((3, 3, 2))
    start = np.array([[0.5, 0.5], [0.5, -1.001], [1.0 + 1e-12, 0.0]])
    finite = np.isfinite(minimal_duration(basis, keys, start, [0.0, 0.0], limits))
    np.testing.assert_array_equal(finite, [True, False, True])
    assert minimal_duration(basis, keys[0], [0.0, 0.0], [0.0, 1.1], limits) == np.inf
    batch = synthesize_batch(basis, keys + 0.7, start, [0.0, 0.0], limits, 5)
    assert (
        np.all(batch.position[1] == 0.7)
        and np.all(batch.velocity[1] == 0)
        and np.all(batch.acceleration[1] == 0)
    )


def test_a_tiny_motion_far_from_the_origin():
    basis, limits = OptimalBasis.uniform(3), Limits([1e-9], [1.0])
    near = np.array([0.0, 1.0, 2.0, 1.0, 3.0])[:, None] * 2.0**-30
    here, there = (minimal_duration(basis, keys, [0.0], [0.0], limits) for keys in (near, near + 4.0))
    assert here == pytest.approx(there, rel=1e-12)


@pytest.mark.parametrize("seed", range(200, 212))
def test_symmetries(seed):
    basis, keys, start, end, limits = random_problems(seed)
    duration = minimal_duration(basis, keys, start, end, limits)
    same = {
        "mirrored": minimal_duration(basis, -keys, -start, -end, limits),
        "moved": minimal_duration(basis, keys + 0.5, start, end, limits),
        "backwards": minimal_duration(
            OptimalBasis(np.append((1 - basis.knots[::-1])[1:-1], 1.0)), keys[:, ::-1], -end, -start, limits
        ),
        "joints in another order": minimal_duration(
            basis,
            keys[..., ::-1],
            start[:, ::-1],
            end[:, ::-1],
            Limits(limits.velocity[::-1], limits.acceleration[::-1]),
        ),
        "one by one": [
            minimal_duration(basis, *problem, limits) for problem in zip(keys, start, end, strict=True)
        ],
    }
    for name, other in same.items():
        np.testing.assert_allclose(other, duration, rtol=1e-7, err_msg=name)
    # Keys and speeds twice as large under limits twice as large.
    twice = Limits(2 * limits.velocity, 2 * limits.acceleration)
    np.testing.assert_allclose(
        minimal_duration(basis, 2 * keys, 2 * start, 2 * end, twice), duration, rtol=1e-12
    )


@pytest.mark.parametrize("seed", range(300, 320))
def test_batch_samples_equal_the_spline(seed):
    basis, keys, start, end, limits = random_problems(seed, batch=20)
    batch = synthesize_batch(basis, keys, start, end, limits, samples=33)
    np.testing.assert_array_equal(batch.duration, minimal_duration(basis, keys, start, end, limits))
    for b, duration in enumerate(batch.duration):
        spline = CubicSpline(duration * basis.knots, keys[b], bc_type=((1, start[b]), (1, end[b])))
        t = np.linspace(0, duration, 33)
        for order, got in enumerate((batch.position[b], batch.velocity[b], batch.acceleration[b])):
            expected = spline(t, order)
            scale = max(np.abs(expected).max(), np.abs(keys[b]).max() / duration**order)
            np.testing.assert_allclose(got, expected, atol=1e-11 * scale, rtol=0)
    positions = synthesize_batch(basis, keys, start, end, limits, samples=33, derivatives=False)
    np.testing.assert_array_equal(positions.position, batch.position)
    np.testing.assert_array_equal(positions.duration, batch.duration)
    assert positions.velocity is None and positions.acceleration is None
    np.testing.assert_array_equal(batch.key_positions, keys)
    np.testing.assert_array_equal(positions.knot_slopes, batch.knot_slopes)


@pytest.mark.parametrize("seed", range(320, 332))
def test_keys_and_slopes_of_a_batch_are_the_whole_trajectory(seed):
    basis, keys, start, end, limits = random_problems(seed, batch=10)
    batch = synthesize_batch(basis, keys, start, end, limits, samples=2)
    s = np.linspace(0, 1, 57)
    for b, duration in enumerate(batch.duration):
        spline = CubicSpline(basis.knots, keys[b], bc_type=((1, duration * start[b]), (1, duration * end[b])))
        hermite = CubicHermiteSpline(batch.knots, batch.key_positions[b], batch.knot_slopes[b])
        np.testing.assert_allclose(hermite(s), spline(s), atol=1e-11 * max(1.0, np.abs(keys[b]).max()))
    too_fast = synthesize_batch(basis, keys, 2.0 * limits.velocity, end, limits, samples=2)
    assert np.isinf(too_fast.duration).all() and not too_fast.knot_slopes.any()


def test_batch_of_one_and_ends():
    basis, limits = OptimalBasis.uniform(2), Limits([1.0, 2.0], [3.0, 4.0])
    keys = np.random.default_rng(5).normal(size=(4, 2))
    batch = synthesize_batch(basis, keys, [0.1, -0.3], [0.2, 0.0], limits, 2)
    assert batch.position.shape == (1, 2, 2)
    np.testing.assert_allclose(batch.position[0], keys[[0, -1]], atol=1e-15)
    np.testing.assert_allclose(batch.velocity[0], [[0.1, -0.3], [0.2, 0.0]], atol=1e-15)


def test_empty_batch():
    basis, limits = OptimalBasis.uniform(2), Limits([1.0], [1.0])
    assert minimal_duration(basis, np.empty((0, 4, 1)), [0.0], [0.0], limits).shape == (0,)
    assert synthesize_batch(basis, np.empty((0, 4, 1)), [0.0], [0.0], limits, 3).position.shape == (0, 3, 1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"key_positions": np.zeros((3, 2))}, r"\(B, 4, 2\)"),
        ({"key_positions": np.zeros((5, 4, 3))}, r"\(B, 4, 2\)"),
        ({"key_positions": np.full((4, 2), np.nan)}, "finite"),
        ({"start_velocity": np.zeros(3)}, "start velocity"),
        ({"end_velocity": np.zeros((2, 2))}, "end velocity"),
        ({"end_velocity": [np.inf, 0.0]}, "finite"),
        ({"samples": 1}, "samples"),
    ],
)
def test_refuses_bad_arguments(change, message):
    arguments = {
        "basis": OptimalBasis.uniform(2),
        "key_positions": np.zeros((4, 2)),
        "start_velocity": np.zeros(2),
        "end_velocity": np.zeros(2),
        "limits": Limits([1.0, 1.0], [1.0, 1.0]),
        "samples": 3,
    }
    with pytest.raises(InvalidInputError, match=message):
        synthesize_batch(**(arguments | change))


@pytest.mark.parametrize(
    "arguments",
    [
        ([1.0, 0.0], [1.0, 1.0]),
        ([1.0, 1.0], [1.0, -1.0]),
        ([1.0, 1.0], [1.0]),
        ([[1.0]], [[1.0]]),
        ([np.nan], [1.0]),
        ([], []),
        ([1.0], [1.0], [0.0], [0.0]),
        ([1.0], [1.0], [0.0, 0.0], [1.0, 1.0]),
        (1.0, 1.0),
    ],
)
def test_refuses_bad_limits(arguments):
    with pytest.raises(InvalidInputError, match="limit"):
        Limits(*arguments)


def test_limits_are_a_value():
    velocity = np.array([1.0, 2.0])
    limits = Limits(velocity, [3.0, 4.0], lower=[-1.0, -np.inf])
    velocity[0] = 9.0
    assert limits.velocity[0] == 1.0 and limits.dof == 2 and limits.upper is None
    with pytest.raises(ValueError, match="read-only"):
        limits.velocity[0] = 5.0
