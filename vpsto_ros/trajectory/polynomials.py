"""Compiled kernels on piecewise polynomials of degree 5: evaluation and exact extrema.

Coefficients (S, 6, n) are those of c_0 + c_1 tau + .. + c_5 tau^5 with tau the time since the start of the
segment.
"""

import math

import numpy as np
from numba import njit

SIZE = 6
"""Number of coefficients of a segment: degree 5."""


@njit(cache=True, nogil=True)
def _locate(times, t):
    """Index of the segment that holds t: times[i] <= t < times[i + 1]; the end belongs to the last one."""
    low, high = 0, times.size - 1
    while high - low > 1:
        middle = (low + high) // 2
        if t >= times[middle]:
            low = middle
        else:
            high = middle
    return low


@njit(cache=True, nogil=True)
def _falling(k, order):
    """Factor k (k - 1) .. (k - order + 1) of tau^(k - order) in the derivative of tau^k."""
    product = 1.0
    for i in range(order):
        product *= k - i
    return product


@njit(cache=True, nogil=True)
def _evaluate_into(times, coefficients, t, order, out):
    t_in = min(max(t, times[0]), times[-1])
    dof = coefficients.shape[2]
    if order > 0 and t_in != t:
        out[:] = 0.0
        return
    i = _locate(times, t_in)
    tau = t_in - times[i]
    for j in range(dof):
        out[j] = 0.0
    for k in range(SIZE - 1, order - 1, -1):
        factor = _falling(k, order)
        for j in range(dof):
            out[j] = out[j] * tau + factor * coefficients[i, k, j]


@njit(cache=True, nogil=True)
def evaluate_one(times, coefficients, t, order):
    """Derivative (n,) of the given order at one time."""
    out = np.empty(coefficients.shape[2])
    _evaluate_into(times, coefficients, t, order, out)
    return out


@njit(cache=True, nogil=True)
def evaluate_many(times, coefficients, ts, order):
    """Derivatives (K, n) at times (K,)."""
    out = np.empty((ts.size, coefficients.shape[2]))
    for k in range(ts.size):
        _evaluate_into(times, coefficients, ts[k], order, out[k])
    return out


@njit(cache=True, nogil=True)
def evaluate_state(times, coefficients, t):
    """Position, velocity and acceleration (3, n) at one time."""
    out = np.empty((3, coefficients.shape[2]))
    for order in range(3):
        _evaluate_into(times, coefficients, t, order, out[order])
    return out


@njit(cache=True, nogil=True)
def shifted_origin(coefficients, tau):
    """Coefficients (6, n) of the same polynomials about tau instead of 0, by repeated synthetic division."""
    out = coefficients.copy()
    for first in range(SIZE - 1):
        for k in range(SIZE - 2, first - 1, -1):
            for j in range(out.shape[1]):
                out[k, j] += tau * out[k + 1, j]
    return out


@njit(cache=True, nogil=True)
def _value(p, degree, u):
    value = p[degree]
    for k in range(degree - 1, -1, -1):
        value = value * u + p[k]
    return value


@njit(cache=True, nogil=True, error_model="numpy")
def _quadratic_roots(p, out):
    """Sorted roots in (0, 1) of p_0 + p_1 u + p_2 u^2 into out; returns how many."""
    half = 0.5 * p[1]
    discriminant = half * half - p[0] * p[2]
    if discriminant < 0.0:
        return 0
    q = -(half + math.copysign(math.sqrt(discriminant), half))
    first, second = q / p[2], p[0] / q
    if not first <= second:
        first, second = second, first
    count = 0
    for root in (first, second):
        if 0.0 < root < 1.0:
            out[count] = root
            count += 1
    return count


@njit(cache=True, nogil=True, error_model="numpy")
def _bracketed_root(p, degree, a, b, value_a):
    """Root of a polynomial, monotone on [a, b] with a change of sign: Newton, kept inside by bisection."""
    low, high = (a, b) if value_a < 0.0 else (b, a)
    u = 0.5 * (a + b)
    for _ in range(60):
        value, slope = p[degree], 0.0
        for k in range(degree - 1, -1, -1):
            slope = slope * u + value
            value = value * u + p[k]
        if value == 0.0:
            return u
        if value < 0.0:
            low = u
        else:
            high = u
        step = u - value / slope
        if not min(low, high) < step < max(low, high):
            step = 0.5 * (low + high)
        if abs(step - u) <= 1e-15:
            return step
        u = step
    return u


@njit(cache=True, nogil=True, error_model="numpy")
def _unit_roots(p, degree, roots, ends, scratch):
    """Sorted roots in (0, 1) where a polynomial of degree <= 4 changes sign; returns how many.

    The roots of the quadratic derivative are known in closed form; between the roots of its derivative a
    polynomial is monotone, which brackets its own roots, one degree after the other. Touching roots may be
    missed; a derivative that touches zero marks no extremum.
    """
    while degree > 0 and p[degree] == 0.0:
        degree -= 1
    if degree == 0:
        return 0
    level = max(degree - 2, 0)
    count = 0
    while level >= 0:
        size = degree - level
        for k in range(size + 1):
            scratch[k] = p[k + level] * _falling(k + level, level)
        if size == 1:
            root = -scratch[0] / scratch[1]
            roots[0] = root
            count = 1 if 0.0 < root < 1.0 else 0
        elif size == 2:
            count = _quadratic_roots(scratch, roots)
        else:
            for k in range(count):
                ends[k] = roots[k]
            ends[count] = 1.0
            brackets, count = count + 1, 0
            a, value_a = 0.0, scratch[0]
            for k in range(brackets):
                b = ends[k]
                value_b = _value(scratch, size, b)
                if value_a * value_b < 0.0:
                    roots[count] = _bracketed_root(scratch, size, a, b, value_a)
                    count += 1
                a, value_a = b, value_b
        level -= 1
    return count


@njit(cache=True, nogil=True)
def _hull(p, degree, binomial):
    """Bounds of a polynomial on [0, 1]: the least and greatest coefficient of its Bernstein form."""
    low, high = p[0], p[0]
    for i in range(1, degree + 1):
        value = p[0]
        for k in range(1, i + 1):
            value += binomial[i, k] / binomial[degree, k] * p[k]
        low, high = min(low, value), max(high, value)
    return low, high


@njit(cache=True, nogil=True)
def _unit_derivative(coefficients, i, j, order, h, p):
    """Coefficients in u = tau / h of the order-th time derivative of one segment."""
    power = 1.0
    for k in range(SIZE - order):
        p[k] = coefficients[i, k + order, j] * _falling(k + order, order) * power
        power *= h


@njit(cache=True, nogil=True)
def extrema_kernel(times, coefficients, order):
    """Least and greatest value (2, n) of a time derivative over all instants.

    First the ends of all segments; then only segments whose Bernstein hull reaches further are searched
    inside.
    """
    segments, dof = coefficients.shape[0], coefficients.shape[2]
    degree = SIZE - 1 - order
    p, slope = np.empty(SIZE), np.empty(SIZE)
    roots, ends, scratch = np.empty(SIZE), np.empty(SIZE), np.empty(SIZE)
    binomial = np.zeros((SIZE, SIZE))
    for i in range(SIZE):
        binomial[i, 0] = 1.0
        for k in range(1, i + 1):
            binomial[i, k] = binomial[i - 1, k - 1] + binomial[i - 1, k]
    bounds = np.empty((2, dof))
    bounds[0], bounds[1] = np.inf, -np.inf
    for i in range(segments):
        for j in range(dof):
            _unit_derivative(coefficients, i, j, order, times[i + 1] - times[i], p)
            first, last = p[0], _value(p, degree, 1.0)
            bounds[0, j] = min(bounds[0, j], first, last)
            bounds[1, j] = max(bounds[1, j], first, last)
    for i in range(segments):
        for j in range(dof):
            _unit_derivative(coefficients, i, j, order, times[i + 1] - times[i], p)
            low, high = _hull(p, degree, binomial)
            if low >= bounds[0, j] and high <= bounds[1, j]:
                continue
            for k in range(1, degree + 1):
                slope[k - 1] = k * p[k]
            for k in range(_unit_roots(slope, degree - 1, roots, ends, scratch)):
                value = _value(p, degree, roots[k])
                bounds[0, j] = min(bounds[0, j], value)
                bounds[1, j] = max(bounds[1, j], value)
    return bounds
