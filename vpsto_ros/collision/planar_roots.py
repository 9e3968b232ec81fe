"""Roots of polynomials in Bernstein form, compiled: what makes collision checks along a path exact.

A polynomial of degree d on 0 <= u <= 1 is given by its d + 1 Bernstein coefficients. It stays within their
range and crosses zero at most as often as they change sign, so most polynomials need no arithmetic at all,
and an interval with one change of sign holds exactly one root.
"""

import math

import numpy as np
from numba import njit

_NARROWEST = 2.0**-40
"""Width of an interval in which several roots are not told apart."""
DEPTH = 48
"""Rows of the stack of :func:`roots`: one per halving down to the narrowest interval, and some to spare."""


@njit(cache=True, nogil=True, error_model="numpy")
def value_and_slope(coefficients, degree, u, work):
    """The polynomial and its derivative at u, by de Casteljau's scheme; `work` holds degree + 1 numbers."""
    for k in range(degree + 1):
        work[k] = coefficients[k]
    for level in range(degree, 1, -1):
        for k in range(level):
            work[k] += u * (work[k + 1] - work[k])
    slope = work[1] - work[0]
    return work[0] + u * slope, degree * slope


@njit(cache=True, nogil=True, error_model="numpy")
def _sign(value, tolerance):
    if value > tolerance:
        return 1
    return -1 if value < -tolerance else 0


@njit(cache=True, nogil=True, error_model="numpy")
def _sign_changes(coefficients, degree, tolerance):
    """How often the coefficients change sign, and the first sign; what is within the tolerance has none."""
    first = last = changes = 0
    for k in range(degree + 1):
        sign = _sign(coefficients[k], tolerance)
        if sign == 0:
            continue
        if first == 0:
            first = sign
        elif sign != last:
            changes += 1
        last = sign
    return changes, first


@njit(cache=True, nogil=True, error_model="numpy")
def _single_root(coefficients, degree, first, tolerance, work):
    """The root of a polynomial that starts with sign `first` and crosses zero once: Newton in a bracket."""
    left, right = coefficients[0], coefficients[degree]
    low, high, before = 0.0, 1.0, np.inf
    # Another root at an end would attract Newton's method; bisection sees only the change of sign.
    smooth = abs(left) > tolerance and abs(right) > tolerance
    u = left / (left - right) if smooth else 0.5
    for _ in range(100):
        value, slope = value_and_slope(coefficients, degree, u, work)
        if smooth and abs(value) <= 0.01 * tolerance:
            break
        if value * first > 0.0:
            low = u
        else:
            high = u
        step = value / slope
        halved, before = smooth and abs(value) <= 0.5 * before, abs(value)
        if halved and low < u - step < high:
            u -= step
        else:
            step = high - low
            u = 0.5 * (low + high)
        if abs(step) < 1e-15:
            break
    return u


@njit(cache=True, nogil=True, error_model="numpy")
def _halve(coefficients, degree, left, right):
    """Bernstein coefficients of the two halves; `right` may be the coefficients themselves."""
    for k in range(degree + 1):
        right[k] = coefficients[k]
    for level in range(degree, 0, -1):
        left[degree - level] = right[0]
        for k in range(level):
            right[k] = 0.5 * (right[k] + right[k + 1])
    left[degree] = right[0]


@njit(cache=True, nogil=True, error_model="numpy")
def roots(coefficients, degree, tolerance, stack, found, count):
    """Append the roots in 0 < u < 1 to `found` from `count` on.

    Crossings come with the precision of the arithmetic. Where the polynomial only touches zero a point may be
    appended or not, and points where its value is within the tolerance may be added: the caller splits the
    path there and looks at every piece.

    Args:
        coefficients: degree + 1 Bernstein coefficients.
        degree: of the polynomial.
        tolerance: values that count as zero; keeps a polynomial that is nothing but round-off from being
            divided without end.
        stack: work space, shape (DEPTH, at least degree + 4).
        found: where the roots go; what does not fit is left out.
        count: how many it holds already.

    Returns:
        The new count.
    """
    changes, _ = _sign_changes(coefficients, degree, tolerance)
    if changes == 0:
        return count
    low, width = degree + 1, degree + 2  # columns that hold the interval of a row
    work = stack[DEPTH - 1]
    stack[0, : degree + 1] = coefficients[: degree + 1]
    stack[0, low], stack[0, width] = 0.0, 1.0
    top = 0
    while top >= 0 and count < found.size:
        row = stack[top]
        changes, first = _sign_changes(row, degree, tolerance)
        if changes <= 1 or row[width] < _NARROWEST:
            if changes:
                u = _single_root(row, degree, first, tolerance, work) if changes == 1 else 0.5
                found[count] = row[low] + u * row[width]
                count += 1
            top -= 1
            continue
        row[width] *= 0.5
        left = stack[top + 1]
        left[low], left[width] = row[low], row[width]
        row[low] += row[width]
        _halve(row, degree, left, row)
        if abs(row[0]) <= tolerance:  # a root on the cut would belong to neither half
            found[count] = row[low]
            count += 1
        top += 1
    return count


def from_powers(coefficients: np.ndarray) -> np.ndarray:
    """Bernstein coefficients of polynomials given by c_0 + c_1 u + .. + c_d u^d along the second axis.

    Args:
        coefficients: shape (S, d + 1, n).
    """
    size = coefficients.shape[1]
    degree = size - 1
    ratios = [[math.comb(k, i) / math.comb(degree, i) for i in range(size)] for k in range(size)]
    matrix = np.array(ratios)
    return np.einsum("ki,sin->skn", matrix, coefficients)
