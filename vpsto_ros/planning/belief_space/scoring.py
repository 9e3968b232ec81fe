"""Compiled: what candidates cost and which constraints on end effectors they break."""

import math

import numpy as np
from numba import njit

LARGEST_EXPONENT = 100.0
"""Of the progress cost: plans that move the object far away cost much, but not infinitely much."""


@njit(cache=True, nogil=True)
def way_to_go(x, y, way, aside):
    """Distance from (x, y) to the end of a way: what is left of it from some point on, and that far to there.

    Args:
        x: position [m].
        y: see x.
        way: points and what is left from each to the end, shape (L, 3) [m]; a place is a single point.
        aside: how much more a metre beside the way counts than one along it.
    """
    nearest = np.inf
    for i in range(way.shape[0]):
        offset = math.sqrt((x - way[i, 0]) ** 2 + (y - way[i, 1]) ** 2)
        nearest = min(nearest, way[i, 2] + aside * offset)
    return nearest


@njit(cache=True, nogil=True)
def progress_costs(mean, variance, way, aside, weight, variance_weight, cost):
    """Eq. (6.54): exp(-lambda (d_0 - d_K)), for B candidates, with d = sqrt(distance^2 + w V).

    With w = 0 and a place to go to it is the thesis's. With w > 0 the variance that a horizon leaves counts
    as distance, which is what eq. (6.2) asks for. The distance is :func:`way_to_go`.
    """
    last = mean.shape[1] - 1
    for b in range(mean.shape[0]):
        before = way_to_go(mean[b, 0, 0], mean[b, 0, 1], way, aside)
        after = way_to_go(mean[b, last, 0], mean[b, last, 1], way, aside)
        d0 = math.sqrt(before * before + variance_weight * variance[b, 0])
        dk = math.sqrt(after * after + variance_weight * variance[b, last])
        cost[b] = math.exp(min(-weight * (d0 - dk), LARGEST_EXPONENT))


@njit(cache=True, nogil=True)
def distance_costs(mean, variance, way, aside, weight, variance_weight, cost):
    """Add weight * d_K, with d as in :func:`progress_costs`, to the costs of B candidates."""
    last = mean.shape[1] - 1
    for b in range(mean.shape[0]):
        left = way_to_go(mean[b, last, 0], mean[b, last, 1], way, aside)
        cost[b] += weight * math.sqrt(left * left + variance_weight * variance[b, last])


@njit(cache=True, nogil=True)
def separation_excess(rows, paths, gap, offset, crossing, excess):
    """How far end effectors come too near to each other, or arms cross, in B candidates [m].

    Args:
        rows: end effectors, shape (E, 6).
        paths: plane coordinates, shape (B, K + 1, m).
        gap: smallest allowed gap between bounding circles [m].
        offset: smallest distance along x where the first one is to the right of the second one [m].
        crossing: how far it may be to the right; infinite if it does not matter [m].
        excess: output, shape (B,): 0 where all is well.
    """
    total = rows.shape[0]
    for b in range(paths.shape[0]):
        worst = 0.0
        for k in range(paths.shape[1]):
            for e in range(total):
                i = int(rows[e, 4])
                for f in range(e):
                    j = int(rows[f, 4])
                    dx, dy = paths[b, k, j] - paths[b, k, i], paths[b, k, j + 1] - paths[b, k, i + 1]
                    apart = math.sqrt(dx * dx + dy * dy)
                    worst = max(worst, rows[e, 3] + rows[f, 3] + gap - apart)
                    if dy < 0.0 and crossing < np.inf:
                        # Uncrossing, or making room: whichever is nearer.
                        worst = max(worst, -dy - crossing, min(-dy, offset - abs(dx)))
        excess[b] = worst


@njit(cache=True, nogil=True)
def height_excess(heights, height, tolerance, excess):
    """How far tools leave their height: heights (B, K, E) beyond height +- tolerance [m], shape (B,)."""
    for b in range(heights.shape[0]):
        worst = 0.0
        for k in range(heights.shape[1]):
            for e in range(heights.shape[2]):
                worst = max(worst, abs(heights[b, k, e] - height) - tolerance)
        excess[b] = worst
