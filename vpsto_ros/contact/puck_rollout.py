"""Compiled rollouts of the puck model: of Gaussians (5.8), of shots up to the goal line, and of samples.

Between two walls a puck floats a number of equal steps, whose product stands in a table: one row for each
number n of steps, with A_n (of positions by velocities, then of velocities by themselves, 4 numbers each) and
the 10 different entries of the covariance that n steps add. Models: see
:mod:`vpsto_ros.contact.puck_modes`.
"""

import math

import numpy as np
from numba import njit

from vpsto_ros.contact.puck_modes import (
    FLOATING,
    LIVELY,
    MERGED,
    WALL,
    advance,
    bounce,
    float_on,
    goal_window,
    hit,
    next_wall,
    scales,
    transform,
)

BRANCHES = 16
"""How many ways of bouncing are followed at most."""
LEAST_WEIGHT = 0.02
"""A way of bouncing that is less likely is followed together with the others, as one Gaussian."""


@njit(cache=True, nogil=True)
def powers(model, steps):
    """The table of 0 to `steps` steps of floating, shape (steps + 1, 18)."""
    table, work = np.zeros((steps + 1, 18)), np.empty((8, 4))
    a, noise, nothing = np.eye(4), np.zeros((4, 4)), np.zeros(4)
    single = np.eye(4)
    float_on(model, 1.0, nothing, np.zeros((4, 4)), work)
    single[:] = work[4:]
    for n in range(steps + 1):
        if n > 0:
            a = single @ a
            transform(single, noise, work)
            noise[2:, 2:] += model[FLOATING + 3 : FLOATING + 5]
        for i in range(2):
            for j in range(2):
                table[n, 2 * i + j] = a[i, 2 + j]
                table[n, 4 + 2 * i + j] = a[2 + i, 2 + j]
        entry = 8
        for i in range(4):
            for j in range(i, 4):
                table[n, entry] = noise[i, j]
                entry += 1
    return table


@njit(cache=True, nogil=True)
def _spread(table, count, covariance, work):
    """Covariance after so many steps of floating, in place."""
    while count > 0:
        n = min(count, len(table) - 1)
        count -= n
        row, a = table[n], work[4:]
        for i in range(4):
            for j in range(4):
                a[i, j] = 1.0 if i == j and i < 2 else 0.0
        for i in range(2):
            for j in range(2):
                a[i, 2 + j] = row[2 * i + j]
                a[2 + i, 2 + j] = row[4 + 2 * i + j]
        transform(a, covariance, work)
        entry = 8
        for i in range(4):
            covariance[i, i] += row[entry]
            entry += 1
            for j in range(i + 1, 4):
                covariance[i, j] += row[entry]
                covariance[j, i] = covariance[i, j]
                entry += 1


@njit(cache=True, nogil=True)
def float_freely(model, table, most, mean, covariance, work):
    """Float until a wall or a goal line comes in the next step, or `most` steps, in place; how many."""
    period, reach_x, reach_y = model[0, 0], model[1, 0], model[1, 1]
    x, y, vx, vy = mean[0], mean[1], mean[2], mean[3]
    k00, k01, k10, k11 = model[4, 0], model[4, 1], model[5, 0], model[5, 1]
    c0, c1, half, count = model[6, 0], model[6, 1], 0.5 * period, 0
    while count < most:
        end_x, end_y = abs(x + period * vx), abs(y + period * vy)
        if (end_x >= reach_x or end_y >= reach_y) and (
            (end_x >= reach_x and (x + period * vx) * vx > 0.0)
            or (end_y >= reach_y and (y + period * vy) * vy > 0.0)
        ):
            break
        wx, wy = k00 * vx + k01 * vy + c0, k10 * vx + k11 * vy + c1
        x += half * (vx + wx)
        y += half * (vy + wy)
        vx, vy = wx, wy
        count += 1
    mean[0], mean[1], mean[2], mean[3] = x, y, vx, vy
    _spread(table, count, covariance, work)
    return count


@njit(cache=True, nogil=True)
def _mass(low, high, mean, std):
    """Of a Gaussian between two numbers."""
    scale_ = 1.0 / (math.sqrt(2.0) * max(std, 1e-12))
    return max(0.0, 0.5 * (math.erf((high - mean) * scale_) - math.erf((low - mean) * scale_)))


@njit(cache=True, nogil=True)
def _goal_time(model, mean):
    """Time to the goal line if it is reached in the next step, before any side wall, else -1."""
    x, vx = mean[0], mean[2]
    if not (vx > 0.0 and x + model[0, 0] * vx >= model[1, 0]):
        return -1.0
    time = (model[1, 0] - x) / vx
    _, axis, _ = next_wall(model, x, mean[1], 0.0, mean[3], time)
    return -1.0 if axis >= 0 else max(time, 0.0)


@njit(cache=True, nogil=True)
def _arrival(model, mean, covariance, time):
    """Mean and standard deviation of y on the goal line, a time ahead, and the window there.

    What x is off is made up for on the way, (1, -vy/vx) to first order.
    """
    slope, p = mean[3] / mean[2], covariance
    low, high = goal_window(model, slope)
    variance = 0.0
    for i in range(4):
        for j in range(4):
            a = (1.0 if i % 2 else -slope) * (time if i > 1 else 1.0)
            b = (1.0 if j % 2 else -slope) * (time if j > 1 else 1.0)
            variance += a * p[i, j] * b
    return mean[1] + time * mean[3], math.sqrt(max(variance, 0.0)), low, high


@njit(cache=True, nogil=True)
def _outlook(model, table, steps, normals, means, covariances, weights, states, found, work):
    """One shot: follow its ways of bouncing until each crosses the goal line.

    Args:
        model: rows.
        table: of floating.
        steps: at most.
        normals: standard normal numbers (N,), for the Monte-Carlo form (5.11) of the probability; none: the
            exact mass.
        means: space (BRANCHES, 4); the state at the start in the first row.
        covariances: space (BRANCHES, 4, 4), likewise.
        weights: space (BRANCHES,).
        states: space (BRANCHES, 2): steps and banks so far.
        found: output (5,): probability of a goal, speed, time, mean and standard deviation of y there.
        work: space.

    Returns:
        Walls met on the likeliest way.
    """
    found[0], found[1:] = 0.0, np.nan
    weights[0], states[0, 0], states[0, 1] = 1.0, 0, 0
    waiting, best, banks, sampled, used = 1, 0.0, 0, 0.0, 0
    probability = 0.0
    while waiting > 0:
        waiting -= 1
        b = waiting
        mean, covariance = means[b], covariances[b]
        weight, k, met = weights[b], states[b, 0], states[b, 1]
        while True:
            k += float_freely(model, table, steps - k, mean, covariance, work)
            if k >= steps:
                break
            time = _goal_time(model, mean)
            if time >= 0.0:
                y, std, low, high = _arrival(model, mean, covariance, time)
                first, sampled = used, sampled + weight
                used = int(sampled * len(normals) + 0.5)
                if len(normals) == 0:
                    probability += weight * _mass(low, high, y, std)
                else:
                    for n in range(first, min(used, len(normals))):
                        probability += (low <= y + std * normals[n] <= high) / len(normals)
                if weight > best:
                    best, banks = weight, met
                    found[1] = math.sqrt(mean[2] ** 2 + mean[3] ** 2)
                    found[2], found[3], found[4] = k * model[0, 0] + time, y, std
                break
            wall, axis, side = next_wall(model, mean[0], mean[1], mean[2], mean[3], model[0, 0])
            k += 1
            if axis < 0:  # out through the other goal
                float_on(model, 1.0, mean, covariance, work)
                continue
            met += 1
            kind, share, rest = MERGED, model[2, 1], model[0, 0] - wall
            if share > 0.0 and weight * min(share, 1.0 - share) >= LEAST_WEIGHT and waiting + 2 <= BRANCHES:
                # The lively way waits in this row, the usual one goes on in the next.
                means[b + 1], covariances[b + 1] = mean, covariance
                bounce(model, LIVELY, wall, rest, axis, side, mean, covariance, work)
                weights[b], states[b, 0], states[b, 1] = weight * share, k, met
                b, waiting = b + 1, waiting + 1
                mean, covariance = means[b], covariances[b]
                weight *= 1.0 - share
                kind = WALL
            bounce(model, kind, wall, rest, axis, side, mean, covariance, work)
    if best > 0.0:
        found[0] = min(probability, 1.0)
    return banks


@njit(cache=True, nogil=True)
def outlooks(model, table, means, covariances, steps, normals, found, banks):
    """Roll Gaussian states out until their means cross the goal line.

    Args:
        model: rows.
        table: of floating.
        means: (B, 4).
        covariances: (B, 4, 4).
        steps: at most.
        normals: standard normal numbers (B, N); see :func:`_outlook`.
        found: output (B, 5): probability of a goal, speed, time, mean and standard deviation of y there.
        banks: output (B,).
    """
    ways, spreads = np.empty((BRANCHES, 4)), np.empty((BRANCHES, 4, 4))
    weights, states, work = np.empty(BRANCHES), np.empty((BRANCHES, 2), np.int64), np.empty((8, 4))
    for b in range(len(means)):
        ways[0], spreads[0] = means[b], covariances[b]
        banks[b] = _outlook(
            model, table, steps, normals[b], ways, spreads, weights, states, found[b], work
        )


@njit(cache=True, nogil=True)
def shots(model, table, pucks, spreads, strikers, steps, normals, found, banks):
    """The same for pucks that the mallet hits first.

    Args:
        model: rows.
        table: of floating.
        pucks: states before the hit, (B, 4), or (1, 4) for all.
        spreads: covariances of these, (B, 4, 4), or (1, 4, 4) for all.
        strikers: states of the mallet at the touch (B, 4).
        steps: at most.
        normals: standard normal numbers (B, N).
        found: output (B, 5).
        banks: output (B,).
    """
    ways, covariances = np.empty((BRANCHES, 4)), np.empty((BRANCHES, 4, 4))
    weights, states, work = np.empty(BRANCHES), np.empty((BRANCHES, 2), np.int64), np.empty((8, 4))
    for b in range(len(strikers)):
        ways[0], covariances[0] = pucks[min(b, len(pucks) - 1)], spreads[min(b, len(spreads) - 1)]
        hit(model, model[2, 0], strikers[b], ways[0], covariances[0], work)
        banks[b] = _outlook(
            model, table, steps, normals[b], ways, covariances, weights, states, found[b], work
        )


@njit(cache=True, nogil=True)
def predictions(model, table, start, spread, times, means, covariances):
    """A Gaussian state at times ahead (K,), ascending [s]: means (K, 4) and covariances (K, 4, 4)."""
    mean, covariance, work, k = start.copy(), spread.copy(), np.empty((8, 4)), 0
    for i in range(len(times)):
        wanted = times[i] / model[0, 0]
        whole = int(wanted + 1e-9)
        while k < whole:
            k += float_freely(model, table, whole - k, mean, covariance, work)
            if k < whole:
                advance(model, 1.0, mean, covariance, work)
                k += 1
        means[i], covariances[i] = mean, covariance
        if wanted - whole > 1e-9:
            advance(model, wanted - whole, means[i], covariances[i], work)


@njit(cache=True, nogil=True)
def _factor(model, row):
    """Lower factor (3 numbers) of the covariance of a mode."""
    a = math.sqrt(model[row + 3, 0])
    b = model[row + 3, 1] / a
    return a, b, math.sqrt(model[row + 4, 1] - b * b)


@njit(cache=True, nogil=True)
def sampled(model, starts, noise, choice, found):
    """Trajectories of samples.

    Args:
        model: rows.
        starts: (S, 4).
        noise: standard normal numbers (S, K, 2).
        choice: numbers from 0 to 1 (S, K), which say how lively a bounce is.
        found: output (S, K + 1, 4).
    """
    period = model[0, 0]
    for s in range(len(starts)):
        found[s, 0] = starts[s]
        for k in range(noise.shape[1]):
            x, y, vx, vy = found[s, k]
            time, axis, side = next_wall(model, x, y, vx, vy, period)
            if abs(x) > model[1, 0]:
                axis = -1
            row, into, along, normal, tangential = FLOATING, 1.0, 1.0, vx, vy
            if axis >= 0:
                row = LIVELY if choice[s, k] < model[2, 1] else WALL
                into, along = -side, (-side if axis == 0 else side)
                normal, tangential = (into * vx, along * vy) if axis == 0 else (into * vy, along * vx)
            a, b, c = _factor(model, row)
            sn, st = scales(model, row, normal * normal, tangential * tangential)
            first, second = noise[s, k, 0], noise[s, k, 1]
            n = model[row, 0] * normal + model[row, 1] * tangential + model[row + 2, 0]
            t = model[row + 1, 0] * normal + model[row + 1, 1] * tangential + model[row + 2, 1]
            n += sn * a * first
            t += st * (b * first + c * second)
            wx, wy = (into * n, along * t) if axis != 1 else (along * t, into * n)
            if axis < 0:
                time = 0.5 * period
            found[s, k + 1, 0] = x + time * vx + (period - time) * wx
            found[s, k + 1, 1] = y + time * vy + (period - time) * wy
            found[s, k + 1, 2], found[s, k + 1, 3] = wx, wy
