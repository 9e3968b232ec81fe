"""Compiled rollouts of the puck model: of Gaussians (5.8) and of samples.

A model is an array of rows: (period, opening), reach, and for floating and wall: matrix (2 rows), offset,
covariance (2 rows); see :attr:`vpsto_ros.contact.puck.PuckModel.kernel_rows`.
"""

import math

import numpy as np
from numba import njit

FLOATING, WALL = 2, 7
"""First row of each mode."""


@njit(cache=True, nogil=True)
def next_wall(model, x, y, vx, vy, longest):
    """The wall that a puck meets first within a time: (time, axis, side), axis -1 for none.

    A puck that is beyond a wall and still on its way out meets it now. Openings of goals are no wall.
    """
    best, axis, side = longest, -1, 0.0
    for a in range(2):
        position, velocity = (x, vx) if a == 0 else (y, vy)
        if velocity == 0.0:
            continue
        sign = 1.0 if velocity > 0.0 else -1.0
        time = max(0.0, (sign * model[1, a] - position) / velocity)
        if time < best or (time <= best and axis < 0):
            if a == 0 and abs(y + time * vy) <= model[0, 1]:
                continue
            best, axis, side = time, a, sign
    return best, axis, side


@njit(cache=True, nogil=True)
def _bounce(model, axis, side):
    """Matrix (2, 2), offset (2,) and covariance (2, 2) of the wall mode in the table's frame."""
    # Columns: the normal, into the table, and the tangent, a quarter turn from it.
    frame = np.zeros((2, 2))
    frame[axis, 0] = -side
    frame[1 - axis, 1] = -side if axis == 0 else side
    matrix = frame @ np.ascontiguousarray(model[WALL : WALL + 2]) @ frame.T
    offset = frame @ np.ascontiguousarray(model[WALL + 2])
    covariance = frame @ np.ascontiguousarray(model[WALL + 3 : WALL + 5]) @ frame.T
    return matrix, offset, covariance


@njit(cache=True, nogil=True)
def _power(matrix, offset, part):
    """Floating for a part of a step, to first order in what a step changes."""
    eye = np.eye(2)
    return eye + part * (matrix - eye), part * offset


@njit(cache=True, nogil=True)
def step(model, part, mean, covariance):
    """Advance mean (4,) and covariance (4, 4) in place by a part of a step; whether a wall was met."""
    duration = part * model[0, 0]
    x, v = mean[:2].copy(), mean[2:].copy()
    time, axis, side = next_wall(model, x[0], x[1], v[0], v[1], duration)
    a, noise = np.eye(4), np.zeros((4, 4))
    if axis < 0:
        theta, offset = _power(model[FLOATING : FLOATING + 2], model[FLOATING + 2], part)
        after = theta @ v + offset
        mean[:2] = x + 0.5 * duration * (v + after)
        a[:2, 2:] = 0.5 * duration * (np.eye(2) + theta)
        noise[2:, 2:] = part * model[FLOATING + 3 : FLOATING + 5]
    else:
        theta, offset, scatter = _bounce(model, axis, side)
        after, rest = theta @ v + offset, duration - time
        mean[:2] = x + time * v + rest * after
        # Where the state is off, the wall is met at another time.
        shift = np.zeros((2, 4))
        if time > 0.0:
            jump = v - after
            for i in range(2):
                shift[i, axis] = -jump[i] / v[axis]
                shift[i, 2 + axis] = -time * jump[i] / v[axis]
        a[:2, :] += shift
        a[:2, 2:] += time * np.eye(2) + rest * theta
        noise[:2, :2], noise[2:, 2:] = rest**2 * scatter, scatter
        noise[:2, 2:] = noise[2:, :2] = rest * scatter
    a[2:, 2:] = theta
    mean[2:] = after
    spread = a @ covariance @ a.T + noise
    covariance[:] = 0.5 * (spread + spread.T)
    return axis >= 0


@njit(cache=True, nogil=True)
def _mass(low, high, mean, std):
    """Of a Gaussian between two numbers."""
    scale = 1.0 / (math.sqrt(2.0) * max(std, 1e-12))
    return 0.5 * (math.erf((high - mean) * scale) - math.erf((low - mean) * scale))


@njit(cache=True, nogil=True)
def outlooks(model, means, covariances, steps, found, banks):
    """Roll Gaussian states out until their means cross the goal line.

    Args:
        model: rows.
        means: (B, 4).
        covariances: (B, 4, 4).
        steps: at most.
        found: output (B, 5): probability of a goal, speed, time, mean and standard deviation of y there.
        banks: output (B,).
    """
    for b in range(means.shape[0]):
        mean, covariance = means[b].copy(), covariances[b].copy()
        found[b, 0], found[b, 1:], banks[b] = 0.0, np.nan, 0
        for k in range(steps):
            x, vx = mean[0], mean[2]
            reached = vx > 0.0 and x + model[0, 0] * vx >= model[1, 0]
            if reached:
                time = (model[1, 0] - x) / vx
                side = next_wall(model, x, mean[1], 0.0, mean[3], time)
                reached = side[1] < 0
            if reached:
                time = max(time, 0.0)
                y = mean[1] + time * mean[3]
                # y on the line: what x is off is made up for on the way, (1, -vy/vx) to first order.
                slope = mean[3] / vx
                row = np.array([-slope, 1.0, -slope * time, time])
                std = math.sqrt(max(row @ covariance @ row, 0.0))
                found[b, 0] = _mass(-model[0, 1], model[0, 1], y, std)
                found[b, 1] = math.sqrt(vx**2 + mean[3] ** 2)
                found[b, 2] = k * model[0, 0] + time
                found[b, 3], found[b, 4] = y, std
                break
            banks[b] += step(model, 1.0, mean, covariance)


@njit(cache=True, nogil=True)
def sampled(model, starts, noise, found):
    """Trajectories of samples: starts (S, 4), standard normal noise (S, K, 2), found (S, K + 1, 4)."""
    floating = np.linalg.cholesky(np.ascontiguousarray(model[FLOATING + 3 : FLOATING + 5]))
    wall = np.linalg.cholesky(np.ascontiguousarray(model[WALL + 3 : WALL + 5]))
    period = model[0, 0]
    for s in range(starts.shape[0]):
        found[s, 0] = starts[s]
        for k in range(noise.shape[1]):
            x, v = found[s, k, :2], found[s, k, 2:]
            time, axis, side = next_wall(model, x[0], x[1], v[0], v[1], period)
            if abs(x[0]) > model[1, 0]:
                axis = -1
            if axis < 0:
                after = model[FLOATING : FLOATING + 2] @ v + model[FLOATING + 2] + floating @ noise[s, k]
                found[s, k + 1, :2] = x + 0.5 * period * (v + after)
            else:
                frame = np.zeros((2, 2))
                frame[axis, 0] = -side
                frame[1 - axis, 1] = -side if axis == 0 else side
                along = model[WALL : WALL + 2] @ (frame.T @ v) + model[WALL + 2] + wall @ noise[s, k]
                after = frame @ along
                found[s, k + 1, :2] = x + time * v + (period - time) * after
            found[s, k + 1, 2:] = after
