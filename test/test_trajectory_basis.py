"""The optimal basis against SciPy's clamped cubic spline and the thesis's optimal control problem."""

import numpy as np
import pytest
from scipy.integrate import trapezoid
from scipy.interpolate import CubicSpline

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.trajectory import OptimalBasis


def bases():
    rng = np.random.default_rng(1)
    uneven = [np.sort(np.append(rng.uniform(0.02, 0.98, n), 1.0)) for n in (1, 2, 5, 8)]
    return [OptimalBasis.uniform(n) for n in range(12)] + [OptimalBasis(phases) for phases in uneven]


def clamped_spline(basis, w):
    """The spline of w (N + 4, n): key positions, then the two end slopes."""
    return CubicSpline(np.append(0.0, basis.phases), w[:-2], bc_type=((1, w[-2]), (1, w[-1])))


@pytest.mark.parametrize("basis", bases(), ids=lambda basis: f"n{basis.n_via}")
@pytest.mark.parametrize("order", range(4))
def test_equals_the_clamped_spline(basis, order):
    w = np.random.default_rng(2).normal(size=(basis.n_via + 4, 3))
    s = np.random.default_rng(3).uniform(size=200)
    expected = clamped_spline(basis, w)(s, order)
    scale = max(1.0, np.abs(expected).max())
    np.testing.assert_allclose(basis(s, order) @ w, expected, atol=1e-12 * scale, rtol=0)


@pytest.mark.parametrize("basis", bases(), ids=lambda basis: f"n{basis.n_via}")
def test_interpolates_keys_and_end_slopes(basis):
    positions = basis(basis.knots)
    np.testing.assert_allclose(positions, np.eye(*positions.shape), atol=1e-15)
    np.testing.assert_array_equal(basis([0.0, 1.0], 1)[:, -2:], np.eye(2))
    np.testing.assert_allclose(basis.knot_slopes, basis(basis.knots, 1), atol=1e-12)
    scale = np.abs(basis.knot_curvatures).max()
    np.testing.assert_allclose(basis.knot_curvatures, basis(basis.knots, 2), atol=1e-12 * scale)


@pytest.mark.parametrize("basis", bases(), ids=lambda basis: f"n{basis.n_via}")
def test_curvature_is_continuous(basis):
    inner = basis.knots[1:-1]
    before, after = basis(inner - 1e-10, 2), basis(inner, 2)
    jerk = np.abs(basis(np.linspace(0, 1, 99), 3)).max()
    assert np.all(np.abs(after - before) <= 1e-9 * jerk + 1e-9)


@pytest.mark.parametrize("basis", bases(), ids=lambda basis: f"n{basis.n_via}")
def test_gramian_is_the_effort(basis):
    # Gauss-Legendre with two nodes per segment is exact for the square of a linear function.
    h = np.diff(basis.knots)
    s = np.concatenate(
        [basis.knots[:-1] + h * (0.5 - 0.5 / 3**0.5), basis.knots[:-1] + h * (0.5 + 0.5 / 3**0.5)]
    )
    curvature = basis(s, 2)
    expected = curvature.T @ (np.tile(h / 2, 2)[:, None] * curvature)
    np.testing.assert_allclose(basis.gramian(), expected, rtol=1e-10, atol=1e-10 * np.abs(expected).max())
    # Straight lines at constant speed cost nothing: the only null directions.
    line = np.concatenate([basis.knots, [1.0, 1.0]])
    shift = np.concatenate([np.ones(basis.n_via + 2), [0.0, 0.0]])
    scale = np.abs(basis.gramian()).max()
    assert abs(line @ basis.gramian() @ line) < 1e-12 * scale
    assert abs(shift @ basis.gramian() @ shift) < 1e-12 * scale


def test_effort_is_minimal_among_interpolating_curves():
    # Any bump that keeps (3.2) and (3.3) is orthogonal to q'' and only adds effort.
    basis = OptimalBasis([0.3, 0.55, 1.0])
    w = np.random.default_rng(4).normal(size=basis.n_via + 4)
    s = np.linspace(0, 1, 20001)
    bump = np.polynomial.Polynomial.fromroots([0, 0, 0.3, 0.55, 1, 1])
    curvature = basis(s, 2) @ w
    assert abs(trapezoid(curvature * bump.deriv(2)(s), s)) < 1e-6
    assert trapezoid(curvature**2, s) == pytest.approx(w @ basis.gramian() @ w, rel=1e-6)


def test_transition_velocity_bound():
    # What replaces (3.20): |q'| <= max(|q'_0|, |q'_T|) without key positions, for any phases.
    for basis in bases():
        response = basis(np.linspace(0, 1, 3001), 1)[:, -2:]
        assert np.abs(response).sum(axis=1).max() <= 1.0 + 1e-12
    # (3.20) as printed is false: from 1 to 0 the velocity passes through -1/3.
    assert OptimalBasis.uniform(0)(2 / 3, 1)[0, -2] == pytest.approx(-1 / 3)


def test_uniform_is_cached_and_immutable():
    basis = OptimalBasis.uniform(3)
    assert basis is OptimalBasis.uniform(3)
    np.testing.assert_allclose(basis.phases, [0.25, 0.5, 0.75, 1.0])
    for array in (basis.phases, basis.knots, basis.knot_slopes, basis.knot_curvatures):
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 2.0


def test_own_copy_of_the_phases():
    phases = np.array([0.5, 1.0])
    basis = OptimalBasis(phases)
    phases[0] = 0.9
    assert basis.phases[0] == 0.5


@pytest.mark.parametrize(
    "phases", [[], [0.5], [0.0, 1.0], [0.6, 0.4, 1.0], [0.5, 0.5, 1.0], [np.nan, 1.0], 1.0]
)
def test_refuses_bad_phases(phases):
    with pytest.raises(InvalidInputError, match="phases"):
        OptimalBasis(phases)


def test_refuses_bad_arguments():
    basis = OptimalBasis.uniform(1)
    for s in (-1e-9, 1.1, np.nan, [[0.5]]):
        with pytest.raises(InvalidInputError, match="phases"):
            basis(s)
    with pytest.raises(InvalidInputError, match="order"):
        basis(0.5, 4)
    for n_via in (-1, 2.0, 2.5, True, None, "3"):
        with pytest.raises(InvalidInputError, match="n_via"):
            OptimalBasis.uniform(n_via)
    assert OptimalBasis.uniform(np.int64(3)).n_via == 3
