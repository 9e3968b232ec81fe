"""Compiled rollouts of a disc-shaped object: nominal ones of many candidates, and noisy ones."""

import math

import numpy as np
from numba import njit

from vpsto_ros.contact.disc_steps import (
    BX,
    BY,
    CLEAR,
    EFFECTOR_COLUMNS,
    FARTHEST,
    MU,
    STATE_ROWS,
    TABLE_ROWS,
    TOUCHED,
    VECTORISED,
    X0,
    Y0,
    YAW,
    X,
    Y,
    find_near,
    gap_normal,
    give_way,
    place,
    summary,
)

TOUCHING = 1e-4
"""Gap [m] up to which a particle that was pushed in a step still has its contact: sliding along a round end
effector leads away from it by the square of the way."""


@njit(**VECTORISED)
def spread(table, count):
    """Mean position and variance (6.23) of the particles."""
    sx, sy, variance = 0.0, 0.0, 0.0
    for i in range(count):
        sx += table[X, i]
        sy += table[Y, i]
    mx, my = sx / count, sy / count
    for i in range(count):
        variance += (table[X, i] - mx) ** 2 + (table[Y, i] - my) ** 2
    return mx, my, variance / count


@njit(**VECTORISED)
def _all_alike(table, count):
    """Whether all particles are in the same place, bit by bit."""
    same = True
    for i in range(1, count):
        same = same and table[X, i] == table[X, 0] and table[Y, i] == table[Y, 0]
    return same


@njit(**VECTORISED)
def predict_discs(rows, radius, k, friction, start, paths, mean, variance, contact, wedge, step):
    """Nominal belief dynamics (6.27) of B candidates.

    Args:
        rows: end effectors, shape (E, 6).
        radius: of the object [m].
        k: 1 / c^2 of the limit surface [1/m^2].
        friction: whether particles carry friction.
        start: table of the particles, of which the first STATE_ROWS rows are read, shape (TABLE_ROWS, P).
        paths: plane coordinates from the present ones on, shape (B, K + 1, m).
        mean: output, mean positions, shape (B, K + 1, 2).
        variance: output, (6.23), shape (B, K + 1).
        contact: output, share of the particles in contact, (6.24), shape (B, K).
        wedge: output, smallest product of two contact normals, shape (B,).
        step: output, longest displacement of a particle in one step, shape (B,).
    """
    total, particles = rows.shape[0], start.shape[1]
    used = STATE_ROWS if friction else 2
    table, effectors = np.zeros((TABLE_ROWS, particles)), np.zeros((total, EFFECTOR_COLUMNS))
    start_x, start_y, start_variance = spread(start, particles)
    for b in range(paths.shape[0]):
        for i in range(particles):
            for r in range(used):
                table[r, i] = start[r, i]
            table[FARTHEST, i] = 0.0
        for e in range(total):
            effectors[e, CLEAR] = 0.0
        count, mx, my, v, worst = particles, start_x, start_y, start_variance, 1.0
        mean[b, 0, 0], mean[b, 0, 1], variance[b, 0] = mx, my, v
        path = paths[b]
        for j in range(1, paths.shape[1]):
            place(rows, radius, path, j, effectors)
            share = 0.0
            if find_near(table, count, effectors) > 0:
                worst = min(worst, give_way(table, count, effectors, radius, k, friction))
                hits, way, sx, sy, ss = summary(table, count, mx, my)
                share = hits / count
                way = math.sqrt(way)  # no particle has moved farther
                for e in range(total):
                    effectors[e, CLEAR] = max(effectors[e, CLEAR], 0.0) - way
                sx, sy = sx / count, sy / count
                mx, my, v = mx + sx, my + sy, max(ss / count - sx * sx - sy * sy, 0.0)
                if v < 1e-16 and count > 1 and not friction and _all_alike(table, count):
                    count, v = 1, 0.0  # two fingers have gathered the particles: they are one from now on
            contact[b, j - 1] = share
            mean[b, j, 0], mean[b, j, 1], variance[b, j] = mx, my, v
        wedge[b], most = worst, 0.0
        for i in range(particles):
            most = max(most, table[FARTHEST, i])
        step[b] = math.sqrt(most)


@njit(**VECTORISED)
def simulate_discs(rows, radius, k, friction, table, path, step_variance, way_variance, rng, stride, poses):
    """Noisy dynamics (6.7) of P particles along one path; the table ends as the belief after it.

    The perturbation is Gaussian along the tangent of the only contact, and none where two contacts hold the
    object; what it makes penetrate another end effector is projected out.

    Args:
        rows: end effectors, shape (E, 6).
        radius: of the object [m].
        k: 1 / c^2 of the limit surface [1/m^2].
        friction: whether particles carry friction.
        table: particles, shape (TABLE_ROWS, P); updated.
        path: plane coordinates from the present ones on, shape (K + 1, m).
        step_variance: variance of the perturbation per step in contact [m^2].
        way_variance: and per metre that the object is pushed [m].
        rng: source of randomness.
        stride: every how many steps poses are noted.
        poses: output, (x, y, yaw) at samples 0, stride, 2 stride .., shape (R, P, 3).

    Returns:
        smallest product of two contact normals.
    """
    count, total = table.shape[1], rows.shape[0]
    effectors = np.zeros((total, EFFECTOR_COLUMNS))
    worst = 1.0
    _note(table, count, poses, 0)
    for j in range(1, path.shape[0]):
        place(rows, radius, path, j, effectors)
        if find_near(table, count, effectors) > 0:
            worst = min(worst, give_way(table, count, effectors, radius, k, friction))
            _perturb(table, count, effectors, step_variance, way_variance, rng)
            worst = min(worst, give_way(table, count, effectors, radius, k, False))
            for e in range(total):
                effectors[e, CLEAR] = 0.0
        if j % stride == 0 and j // stride < poses.shape[0]:
            _note(table, count, poses, j // stride)
    return worst


@njit(**VECTORISED)
def _note(table, count, poses, row):
    for i in range(count):
        poses[row, i, 0], poses[row, i, 1], poses[row, i, 2] = table[X, i], table[Y, i], table[YAW, i]


@njit(**VECTORISED)
def _perturb(table, count, effectors, step_variance, way_variance, rng):
    """Move particles in contact along the tangent of their contact."""
    for i in range(count):
        if table[TOUCHED, i] == 0.0:
            continue
        x, y = table[X, i], table[Y, i]
        contacts, tx, ty = 0, 0.0, 0.0
        for e in range(effectors.shape[0]):
            gap, nx, ny = gap_normal(effectors, e, x, y)
            if gap < TOUCHING:
                contacts += 1
                tx, ty = -ny, nx
        if contacts == 1:
            way = math.sqrt((x - table[X0, i]) ** 2 + (y - table[Y0, i]) ** 2)
            w = math.sqrt(step_variance + way_variance * way) * rng.standard_normal()
            table[X, i], table[Y, i] = x + w * tx, y + w * ty


def table_of(poses, friction, center) -> np.ndarray:
    """The table of particles for kernels, shape (TABLE_ROWS, P).

    Args:
        poses: (x, y, yaw), shape (P, 3).
        friction: coefficient of friction against the end effectors, shape (P,).
        center: centre of friction in the object frame [m], shape (P, 2).
    """
    table = np.zeros((TABLE_ROWS, len(poses)))
    c, s = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    table[X], table[Y], table[YAW] = poses[:, 0], poses[:, 1], poses[:, 2]
    table[BX], table[BY] = c * center[:, 0] - s * center[:, 1], s * center[:, 0] + c * center[:, 1]
    table[MU] = friction
    return table
