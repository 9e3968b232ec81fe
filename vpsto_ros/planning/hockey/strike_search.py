"""Search for the posture of a strike: how fast the mallet can be at a place, in a direction (5.13).

Frame: the robot's base. A strike runs straight in the plane of play: joints accelerate evenly from rest, keep
their speed past the touch, and brake. To second order in the way they have come, s [s at full speed],

    q(s) = q_c + qd s + kappa s^2 / 2,    J kappa = -dJ/ds qd,

so that the universal joint stays on its line. The contact alone is not what counts: the run-up and the brake
have to stay within all limits, too.
"""

import math

import numpy as np
from numba import njit

from vpsto_ros.planning.hockey.motion_kernels import (
    CLEARANCE,
    HEIGHT,
    LEAST_X,
    MOST_Y,
    ROD_TILT,
    TOLERANCE,
)
from vpsto_ros.robot.iiwa_kinematics import add_least_motion, chain, jacobian, move_to

_SAMPLES = 9  # of a strike, at which places are checked
_BAD = -1e9
_DIFFERENCE = 0.01  # step of the difference that gives the curvature [s]
_PARALLEL = 1e-7  # columns of the Jacobian whose cross product is less [m^2]
_NO_PART = 1e-8  # of a joint in the dual, relative to its length [m]

# Entries of the row of rules behind those of PlayRules.kernel_row, from StrikeConfig.
RUN_UP, HOLD, BRAKE, LEAD_WEIGHT, STEEPNESS = range(6, 11)


@njit(cache=True, nogil=True, error_model="numpy")
def fastest(jac, ex, ey, limits, rates):
    """Largest v with v (ex, ey, 0) = J qd and |qd| <= limits, (5.13), with the joint rates that give it.

    The dual is min sum_j limits_j |J_j' l| over l with l' e = 1: convex, and linear between the planes on
    which a joint has no part in l. Its minimum is where two of those planes meet; there are 15 pairs.

    Args:
        jac: Jacobian (3, 6).
        ex: of the unit vector of the motion.
        ey: likewise.
        limits: of the joint rates (7,) [rad/s].
        rates: output (7,).

    Returns:
        The speed [m/s]; 0 if there is none, or if J is singular.
    """
    best = np.inf
    bx, by, bz = 0.0, 0.0, 0.0
    for i in range(6):
        for j in range(i):
            lx = jac[1, i] * jac[2, j] - jac[2, i] * jac[1, j]
            ly = jac[2, i] * jac[0, j] - jac[0, i] * jac[2, j]
            lz = jac[0, i] * jac[1, j] - jac[1, i] * jac[0, j]
            along, norm = lx * ex + ly * ey, math.sqrt(lx * lx + ly * ly + lz * lz)
            if norm < _PARALLEL or abs(along) < 1e-6 * norm:
                continue
            lx, ly, lz = lx / along, ly / along, lz / along
            value = 0.0
            for k in range(6):
                value += limits[k] * abs(jac[0, k] * lx + jac[1, k] * ly + jac[2, k] * lz)
            if value < best:
                best, bx, by, bz = value, lx, ly, lz
    if best == np.inf:
        return 0.0
    return _primal(jac, ex, ey, limits, rates, best, bx, by, bz)


@njit(cache=True, nogil=True, error_model="numpy")
def _primal(jac, ex, ey, limits, rates, best, lx, ly, lz):
    """Rates at the optimum: joints with a part in the dual l at their limits, the others make up the rest.

    Those are often three: the shoulder's have no part in the line from there to the universal joint, nor the
    elbow's and the one after in theirs; more in symmetric postures.
    """
    rx, ry, rz = best * ex, best * ey, 0.0
    zero = _NO_PART * math.sqrt(lx * lx + ly * ly + lz * lz)
    free = np.zeros(6, dtype=np.bool_)
    rates[6] = 0.0
    for k in range(6):
        part = jac[0, k] * lx + jac[1, k] * ly + jac[2, k] * lz
        free[k], rates[k] = abs(part) < zero, 0.0
        if not free[k]:
            rates[k] = math.copysign(limits[k], part)
            rx, ry, rz = rx - jac[0, k] * rates[k], ry - jac[1, k] * rates[k], rz - jac[2, k] * rates[k]
    _make_up(jac, free, rx, ry, rz, lx, ly, lz, limits, rates)
    worst = 0.0
    ox, oy, oz = best * ex, best * ey, 0.0
    for k in range(6):
        worst = max(worst, abs(rates[k]) / limits[k])
        ox, oy, oz = ox - jac[0, k] * rates[k], oy - jac[1, k] * rates[k], oz - jac[2, k] * rates[k]
    return best if worst < 1.0 + 1e-6 and abs(ox) + abs(oy) + abs(oz) < 1e-6 else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def _make_up(jac, free, rx, ry, rz, lx, ly, lz, limits, rates):
    """The rest (rx, ry, rz) by the free joints, in the plane across l, at the least share of their limits.

    The same problem as in :func:`fastest` in two dimensions, along u = r / |r| and w across it: the dual is
    (1, m) and its minimum is where a joint has no part in it.
    """
    size, norm = math.sqrt(rx * rx + ry * ry + rz * rz), math.sqrt(lx * lx + ly * ly + lz * lz)
    if size < 1e-12:
        return
    ux, uy, uz = rx / size, ry / size, rz / size
    wx, wy, wz = (ly * uz - lz * uy) / norm, (lz * ux - lx * uz) / norm, (lx * uy - ly * ux) / norm
    along, across = np.zeros(6), np.zeros(6)
    for k in range(6):
        if free[k]:
            along[k] = jac[0, k] * ux + jac[1, k] * uy + jac[2, k] * uz
            across[k] = jac[0, k] * wx + jac[1, k] * wy + jac[2, k] * wz
    best, slope = np.inf, 0.0
    for i in range(7):
        m = 0.0  # the last one: nothing across
        if i < 6:
            if abs(across[i]) < _PARALLEL:
                continue
            m = -along[i] / across[i]
        value = 0.0
        for k in range(6):
            value += limits[k] * abs(along[k] + m * across[k])
        if value < best:
            best, slope = value, m
    if best < 1e-12:
        return
    rest, reach, zero = 0.0, 0.0, _NO_PART * math.hypot(1.0, slope)
    for k in range(6):
        if not free[k]:
            continue
        part = along[k] + slope * across[k]
        if abs(part) < zero:
            reach += limits[k] * abs(across[k])
        else:
            rates[k] = math.copysign(limits[k], part) * size / best
            rest -= across[k] * rates[k]
    for k in range(6):
        if free[k] and reach > 0.0 and abs(along[k] + slope * across[k]) < zero:
            rates[k] = math.copysign(limits[k], across[k]) * rest / reach


@njit(cache=True, nogil=True, error_model="numpy")
def straighten(q, rates, jac, curvature, probe, points, axes, other):
    """The least joint acceleration per s^2, kappa (7,), that keeps the universal joint on its line."""
    for k in range(7):
        probe[k] = q[k] + _DIFFERENCE * rates[k]
        curvature[k] = 0.0
    chain(probe, points, axes)
    jacobian(points, axes, other)
    cx, cy, cz = 0.0, 0.0, 0.0
    for k in range(6):
        cx += (other[0, k] - jac[0, k]) * rates[k]
        cy += (other[1, k] - jac[1, k]) * rates[k]
        cz += (other[2, k] - jac[2, k]) * rates[k]
    add_least_motion(jac, -cx / _DIFFERENCE, -cy / _DIFFERENCE, -cz / _DIFFERENCE, curvature)


@njit(cache=True, nogil=True, error_model="numpy")
def _overspeed(rates, curvature, limits, rules):
    """Largest share of the limits of velocity and acceleration on the way, at least 1.

    Those of acceleration are the STEEPNESS of the rules [1/s] times those of velocity. Accelerations are
    linear in s while the joints accelerate and while they brake, so that the ends count.
    """
    begin, hold, end = -0.5 * rules[RUN_UP], rules[HOLD], rules[HOLD] + 0.5 * rules[BRAKE]
    worst = 1.0
    for i in range(_SAMPLES):
        s = begin + (end - begin) * i / (_SAMPLES - 1)
        # Even acceleration: the speed goes with the square root of the way.
        pace = 1.0
        if s < 0.0:
            pace = math.sqrt(max(0.0, 1.0 - s / begin))
        elif s > hold:
            pace = math.sqrt(max(0.0, 1.0 - (s - hold) / (end - hold)))
        for k in range(6):
            worst = max(worst, pace * abs(rates[k] + curvature[k] * s) / limits[k])
    for k in range(6):
        rise, fall, bend = 1.0 / rules[RUN_UP], 1.0 / rules[BRAKE], curvature[k]
        steepest = max(abs(rise * (rates[k] + begin * bend)), abs(rise * rates[k] + bend))
        steepest = max(steepest, abs(fall * (rates[k] + hold * bend) - bend))
        steepest = max(steepest, abs(fall * (rates[k] + end * bend)))
        worst = max(worst, steepest / (limits[k] * rules[STEEPNESS]))
    return worst


@njit(cache=True, nogil=True, error_model="numpy")
def _breaches(q, rates, curvature, positions, rules, probe, points, axes):
    """How far a strike leaves the plane, the place or the postures that are allowed, weighed [m/s]."""
    begin, end = -0.5 * rules[RUN_UP], rules[HOLD] + 0.5 * rules[BRAKE]
    cost = 0.0
    for i in range(_SAMPLES):
        s = begin + (end - begin) * i / (_SAMPLES - 1)
        for k in range(7):
            probe[k] = q[k] + s * (rates[k] + 0.5 * s * curvature[k])
            cost += 20.0 * max(0.0, abs(probe[k]) - positions[k])
        chain(probe, points, axes)
        cost += 100.0 * max(0.0, abs(points[3, 2] - rules[HEIGHT]) - rules[TOLERANCE])
        cost += 50.0 * max(0.0, rules[LEAST_X] - points[3, 0])
        cost += 50.0 * max(0.0, abs(points[3, 1]) - rules[MOST_Y])
        cost += 20.0 * max(0.0, rules[CLEARANCE] - min(points[1, 2], points[2, 2]))
        cost += 10.0 * max(0.0, axes[6, 2] + rules[ROD_TILT])
    return cost


@njit(cache=True, nogil=True, error_model="numpy")
def rate_posture(q, angle, limits, positions, rules, home, rates, curvature, work):
    """Score of a posture whose universal joint is in place: speed, less breaches and the way from home.

    Args:
        q: posture (7,) [rad].
        angle: direction of the motion, from +x [rad].
        limits: of the joint rates (7,) [rad/s].
        positions: largest joint positions (7,) [rad].
        rules: row of numbers.
        home: posture (7,).
        rates: output (7,) at the touch.
        curvature: output (7,).
        work: scratch: (points, axes, jac, other, probe).

    Returns:
        score, speed [m/s], breaches.
    """
    points, axes, jac, other, probe = work
    chain(q, points, axes)
    jacobian(points, axes, jac)
    speed = fastest(jac, math.cos(angle), math.sin(angle), limits, rates)
    if speed <= 0.0:
        return _BAD, 0.0, np.inf
    for _ in range(2):
        straighten(q, rates, jac, curvature, probe, points, axes, other)
        worst = _overspeed(rates, curvature, limits, rules)
        speed /= worst
        for k in range(7):
            rates[k] /= worst
            curvature[k] /= worst * worst
    breaches = _breaches(q, rates, curvature, positions, rules, probe, points, axes)
    lead = 0.0
    for k in range(7):
        lead = max(lead, abs(q[k] - 0.5 * rules[RUN_UP] * rates[k] - home[k]) / limits[k])
    return speed - breaches - rules[LEAD_WEIGHT] * lead, speed, breaches


@njit(cache=True, nogil=True, error_model="numpy")
def search_posture(x, y, angle, limits, positions, rules, home, seeds, noise, refined, posture, rates):
    """The best posture for a strike with the universal joint at (x, y): random starts, the best refined.

    Args:
        x: of the universal joint at the touch [m].
        y: likewise.
        angle: direction of its motion [rad].
        limits: as for :func:`rate_posture`.
        positions: likewise.
        rules: likewise.
        home: likewise.
        seeds: postures to start from, (S, 7).
        noise: standard normal numbers (N, 7) that are used in turn.
        refined: how many of the seeds are refined.
        posture: output (7,).
        rates: output (7,).

    Returns:
        score, speed [m/s], breaches.
    """
    work = (np.empty((4, 3)), np.empty((7, 3)), np.empty((3, 6)), np.empty((3, 6)), np.empty(7))
    points, axes, jac = work[0], work[1], work[2]
    found, scores = seeds.copy(), np.full(len(seeds), _BAD)
    some_rates, curvature = np.empty(7), np.empty(7)
    for i in range(len(seeds)):
        if move_to(found[i], x, y, rules[HEIGHT], points, axes, jac):
            scores[i] = rate_posture(
                found[i], angle, limits, positions, rules, home, some_rates, curvature, work
            )[0]
    order, count = np.argsort(-scores), 0
    best, trial = _BAD, np.empty(7)
    for i in order[:refined]:
        q, score, width = found[i], scores[i], 0.15
        for _ in range(len(noise) // refined):
            for k in range(7):
                trial[k] = q[k] + width * noise[count, k]
            count += 1
            rated = _BAD
            if move_to(trial, x, y, rules[HEIGHT], points, axes, jac):
                rated = rate_posture(
                    trial, angle, limits, positions, rules, home, some_rates, curvature, work
                )[0]
            if rated > score:
                q[:], score, width = trial, rated, 1.3 * width
            else:
                width *= 0.96
        if score > best:
            best = score
            posture[:] = q
    if best == _BAD:
        return _BAD, 0.0, np.inf
    return rate_posture(posture, angle, limits, positions, rules, home, rates, curvature, work)
