"""Compiled steps of a disc-shaped object among end effectors, for many particles at once.

A disc of radius r that is pushed by a convex end effector is a point pushed by the end effector grown by r.
The projection of eq. (6.5b)-(6.5c) is then the nearest point outside all grown end effectors: exact and free
of residual penetration. Friction, where particles carry any, acts before it, in closed form, as in
:mod:`vpsto_ros.contact.projection`.

Loops run over the particles innermost and without branches, so that they become vector instructions. Kernels
hand each other scalars and two tables, since every array that is passed costs as much as several particles.
"""

import math
from typing import Any

import numpy as np
from numba import njit

from vpsto_ros.contact.narrow_phase import _nearest

# As for the other contact kernels, and sums may be reordered: it lets them run over vector lanes.
VECTORISED: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "arcp", "nsz", "reassoc"},
}

# Rows of the table of particles: position, offset of the centre of friction in world axes, yaw, friction;
# then what a rollout notes: position before the step, contact in it (1 or 0), square of the longest step.
X, Y, BX, BY, YAW, MU, X0, Y0, TOUCHED, FARTHEST = range(10)
STATE_ROWS, TABLE_ROWS = 6, 10

# Columns of the table of end effectors: centre, cosine and sine, motion and turn of this step, half sizes,
# radius grown by the object's; reach of its turn, bound on its clearance; a linearised constraint (normal,
# bound).
EX, EY, EC, ES, MX, MY, TURN, HX, HY, GROWN, REACH, CLEAR, CNX, CNY, BOUND = range(15)
EFFECTOR_COLUMNS = 15

CONTACT_TOLERANCE = 1e-9
"""A penetration [m] smaller than this is round-off, not a contact: a tool at rest does not push."""
_ITERATIONS = 12


@njit(**VECTORISED)
def place(rows, grown_by, points, k, effectors):
    """Place the end effectors as in sample k of plane coordinates (K + 1, m); motion is since k - 1."""
    before = max(k - 1, 0)
    for e in range(rows.shape[0]):
        c = int(rows[e, 4])
        effectors[e, EX], effectors[e, EY] = points[k, c], points[k, c + 1]
        effectors[e, MX] = points[k, c] - points[before, c]
        effectors[e, MY] = points[k, c + 1] - points[before, c + 1]
        effectors[e, EC], effectors[e, ES], effectors[e, TURN] = 1.0, 0.0, 0.0
        if rows[e, 5] > 0.0:
            effectors[e, EC], effectors[e, ES] = math.cos(points[k, c + 2]), math.sin(points[k, c + 2])
            effectors[e, TURN] = points[k, c + 2] - points[before, c + 2]
        effectors[e, HX], effectors[e, HY] = rows[e, 0], rows[e, 1]
        effectors[e, GROWN], effectors[e, REACH] = rows[e, 2] + grown_by, rows[e, 3]


@njit(**VECTORISED, inline="always")
def _polar(dx, dy):
    """Length of a vector and its direction, which is along x where there is none."""
    square = dx * dx + dy * dy
    some = square > 1e-24
    length = math.sqrt(square if some else 1.0)
    return length if some else 0.0, dx / length if some else 1.0, dy / length if some else 0.0


@njit(**VECTORISED)
def gap_normal(effectors, e, x, y):
    """Gap of the point (x, y) to grown end effector e and the unit normal that leads away from it."""
    dx, dy, c, s = x - effectors[e, EX], y - effectors[e, EY], effectors[e, EC], effectors[e, ES]
    gap, nx, ny, _, _ = _nearest(
        c * dx + s * dy, c * dy - s * dx, effectors[e, HX], effectors[e, HY], effectors[e, GROWN]
    )  # fmt: skip
    return gap, c * nx - s * ny, s * nx + c * ny


@njit(**VECTORISED)
def smallest_gap(table, count, effectors, e):
    """Smallest gap between the particles and an end effector."""
    if effectors[e, HX] == 0.0 and effectors[e, HY] == 0.0:
        ex, ey, nearest = effectors[e, EX], effectors[e, EY], np.inf
        for i in range(count):
            dx, dy = table[X, i] - ex, table[Y, i] - ey
            nearest = min(nearest, dx * dx + dy * dy)
        return math.sqrt(nearest) - effectors[e, GROWN]
    gap = np.inf
    for i in range(count):
        gap = min(gap, gap_normal(effectors, e, table[X, i], table[Y, i])[0])
    return gap


@njit(**VECTORISED)
def find_near(table, count, effectors):
    """Number of end effectors that penetrate some particle.

    As long as the bound on its clearance is positive an end effector cannot have reached any particle.
    """
    found = 0
    for e in range(effectors.shape[0]):
        clear = effectors[e, CLEAR]
        if clear > 0.0:
            mx, my = effectors[e, MX], effectors[e, MY]
            clear -= math.sqrt(mx * mx + my * my) + abs(effectors[e, TURN]) * effectors[e, REACH]
        if clear <= 0.0:
            clear = smallest_gap(table, count, effectors, e)
            if clear < -CONTACT_TOLERANCE:
                found += 1
        effectors[e, CLEAR] = clear
    return found


@njit(**VECTORISED, inline="always")
def _impulse(depth, slip, bn, bt, radius, k, mu):
    """Impulse of one contact in closed form: eq. (6.5b) with Coulomb's law on the limit surface.

    With the centre of friction at b = (bn, bt) from the disc's centre, in axes n and t = (-ny, nx), impulse
    (ln, lt) moves the contact by ((1 + k bt^2) ln - k bt rho lt, (1 + k rho^2) lt - k bt rho ln), rho =
    radius + bn, 1 / k the square of the pressure radius. The same as `projection.solve_contact`, free of
    branches.

    Returns:
        displacement of the centre along n and t, and turn.
    """
    rho = radius + bn
    a11, a12, a22 = 1.0 + k * bt * bt, -k * bt * rho, 1.0 + k * rho * rho
    lt = (a11 * slip - a12 * depth) / (a11 * a22 - a12 * a12)
    ln = (depth - a12 * lt) / a11
    edge = mu if lt > 0.0 else -mu
    slides = abs(lt) > mu * ln
    ln = depth / (a11 + edge * a12) if slides else ln
    lt = edge * ln if slides else lt
    turn = k * (bt * ln - rho * lt)
    return ln + turn * bt, lt - turn * bn, turn


@njit(**VECTORISED, inline="always")
def _turned(bx, by, turn):
    """A vector turned by a small angle (Cayley's rotation: its length stays)."""
    half = 0.25 * turn * turn
    c, s = (1.0 - half) / (1.0 + half), turn / (1.0 + half)
    return c * bx - s * by, s * bx + c * by


@njit(**VECTORISED, inline="always")
def _dragged(x, y, bx, by, mu, ex, ey, grown, mx, my, radius, k):
    """Where a disc that moves by (mx, my) to (ex, ey) pushes and drags a particle, were it alone.

    Returns:
        position, offset of the centre of friction, turn, penetration at the beginning.
    """
    distance, nx, ny = _polar(x - ex, y - ey)
    depth = grown - distance
    touching = depth > CONTACT_TOLERANCE
    used = depth if touching else 0.0
    approach = nx * mx + ny * my
    # The tool drags only while it touches: during the part of its motion that ends at this depth.
    slip = (nx * my - ny * mx) * (used / approach if approach > used else 1.0)
    slip = slip if touching else 0.0
    along, across, turn = _impulse(used, slip, nx * bx + ny * by, nx * by - ny * bx, radius, k, mu)
    x, y = x + nx * along - ny * across, y + ny * along + nx * across
    # What curvature leaves of the penetration is projected out.
    distance, nx, ny = _polar(x - ex, y - ey)
    left = touching & (distance < grown)
    bx, by = _turned(bx, by, turn)
    return ex + grown * nx if left else x, ey + grown * ny if left else y, bx, by, turn, depth


@njit(**VECTORISED)
def drag_one_disc(table, count, effectors, radius, k):
    """Particles that carry friction give way to one disc; returns the product of normals, always 1."""
    ex, ey, grown = effectors[0, EX], effectors[0, EY], effectors[0, GROWN]
    mx, my = effectors[0, MX], effectors[0, MY]
    for i in range(count):
        x, y, bx, by, turn, depth = _dragged(
            table[X, i], table[Y, i], table[BX, i], table[BY, i], table[MU, i],
            ex, ey, grown, mx, my, radius, k,
        )  # fmt: skip
        table[X, i], table[Y, i], table[BX, i], table[BY, i] = x, y, bx, by
        table[YAW, i] += turn
        table[TOUCHED, i] = 1.0 if depth > CONTACT_TOLERANCE else 0.0
    return 1.0


@njit(**VECTORISED)
def drag_two_discs(table, count, effectors, radius, k):
    """Particles that carry friction give way to two discs; see :func:`project_two_discs`.

    Where either disc alone would push the object clear of the other, that is what happens. Otherwise both
    contacts close, and two closed contacts fix the object's place whatever the friction; its turn, which
    friction at two contacts nearly stops, is neglected.
    """
    x1, y1, r1, mx1, my1 = (
        effectors[0, EX], effectors[0, EY], effectors[0, GROWN], effectors[0, MX], effectors[0, MY],
    )  # fmt: skip
    x2, y2, r2, mx2, my2 = (
        effectors[1, EX], effectors[1, EY], effectors[1, GROWN], effectors[1, MX], effectors[1, MY],
    )  # fmt: skip
    ux, uy, a, h, product = _intersection(x1, y1, r1, x2, y2, r2)
    both = 0.0
    for i in range(count):
        x, y, bx, by, mu = table[X, i], table[Y, i], table[BX, i], table[BY, i], table[MU, i]
        px1, py1, bx1, by1, turn1, d1 = _dragged(x, y, bx, by, mu, x1, y1, r1, mx1, my1, radius, k)
        px2, py2, bx2, by2, turn2, d2 = _dragged(x, y, bx, by, mu, x2, y2, r2, mx2, my2, radius, k)
        inside1, inside2 = d1 > CONTACT_TOLERANCE, d2 > CONTACT_TOLERANCE
        free1 = (px1 - x2) * (px1 - x2) + (py1 - y2) * (py1 - y2) >= r2 * r2
        free2 = (px2 - x1) * (px2 - x1) + (py2 - y1) * (py2 - y1) >= r1 * r1
        side = h if ux * (y - y1) - uy * (x - x1) >= 0.0 else -h
        first = inside1 & free1 & ((not (inside2 & free2)) | (d1 <= d2))
        second = inside2 & free2 & (not first)
        outside = not (inside1 | inside2)
        corner = not (first | second | outside)
        tx, ty = x1 + a * ux - side * uy, y1 + a * uy + side * ux
        both += 1.0 if corner else 0.0
        table[X, i] = px1 if first else (px2 if second else (tx if corner else x))
        table[Y, i] = py1 if first else (py2 if second else (ty if corner else y))
        table[BX, i] = bx1 if first else (bx2 if second else bx)
        table[BY, i] = by1 if first else (by2 if second else by)
        table[YAW, i] += turn1 if first else (turn2 if second else 0.0)
        table[TOUCHED, i] = 0.0 if outside else 1.0
    return product if both > 0.0 else 1.0


@njit(**VECTORISED)
def drag_any(table, count, effectors, radius, k):
    """Particles that carry friction give way to any end effectors, as in :func:`drag_two_discs`.

    Where no end effector alone pushes the object clear of the others, friction is left out.
    """
    worst, total = 1.0, effectors.shape[0]
    for i in range(count):
        nearest, chosen = np.inf, -1
        x, y = table[X, i], table[Y, i]
        for e in range(total):
            px, py, _, _, _, inside = _dragged_by(table, i, effectors, e, radius, k)
            if not inside:
                continue
            free = True
            for f in range(total):
                free = free and (f == e or gap_normal(effectors, f, px, py)[0] >= 0.0)
            square = (px - x) ** 2 + (py - y) ** 2
            if free and square < nearest:
                nearest, chosen = square, e
        table[TOUCHED, i] = 1.0 if chosen >= 0 else 0.0
        if chosen >= 0:
            x, y, bx, by, turn, _ = _dragged_by(table, i, effectors, chosen, radius, k)
            table[X, i], table[Y, i], table[BX, i], table[BY, i] = x, y, bx, by
            table[YAW, i] += turn
        else:
            worst = min(worst, _project(table, i, effectors))
    return worst


@njit(**VECTORISED)
def _dragged_by(table, i, effectors, e, radius, k):
    """As :func:`_dragged` for an end effector of any shape; last, whether it penetrates at all."""
    x, y, bx, by = table[X, i], table[Y, i], table[BX, i], table[BY, i]
    gap, nx, ny = gap_normal(effectors, e, x, y)
    if gap >= -CONTACT_TOLERANCE:
        return x, y, bx, by, 0.0, False
    # Motion of the end effector's surface at the contact point.
    px = x - (radius + gap) * nx - effectors[e, EX]
    py = y - (radius + gap) * ny - effectors[e, EY]
    mx, my = effectors[e, MX] - effectors[e, TURN] * py, effectors[e, MY] + effectors[e, TURN] * px
    approach = nx * mx + ny * my
    slip = (nx * my - ny * mx) * (-gap / approach if approach > -gap else 1.0)
    along, across, turn = _impulse(-gap, slip, nx * bx + ny * by, nx * by - ny * bx, radius, k, table[MU, i])
    x, y = x + nx * along - ny * across, y + ny * along + nx * across
    gap, nx, ny = gap_normal(effectors, e, x, y)
    if gap < 0.0:
        x, y = x - gap * nx, y - gap * ny
    bx, by = _turned(bx, by, turn)
    return x, y, bx, by, turn, True


@njit(**VECTORISED)
def project_one_disc(table, count, effectors):
    """Nearest points outside one grown disc; see :func:`project_two_discs`."""
    ex, ey, grown = effectors[0, EX], effectors[0, EY], effectors[0, GROWN]
    for i in range(count):
        x, y = table[X, i], table[Y, i]
        distance, nx, ny = _polar(x - ex, y - ey)
        inside = distance < grown - CONTACT_TOLERANCE
        table[X, i] = ex + grown * nx if inside else x
        table[Y, i] = ey + grown * ny if inside else y
        table[TOUCHED, i] = 1.0 if inside else 0.0
    return 1.0


@njit(**VECTORISED, inline="always")
def _intersection(x1, y1, r1, x2, y2, r2):
    """Where two circles cross: at a along the unit vector u from the first to the second, +- h across it.

    Returns:
        u, a, h, and the product of the normals there by the cosine rule; -1 where the circles do not cross.
    """
    ux, uy = x2 - x1, y2 - y1
    apart = math.sqrt(ux * ux + uy * uy) + 1e-12
    a = (apart * apart + r1 * r1 - r2 * r2) / (2.0 * apart)
    h = math.sqrt(max(r1 * r1 - a * a, 0.0))
    crossing = apart < r1 + r2 and apart > abs(r1 - r2)
    product = (r1 * r1 + r2 * r2 - apart * apart) / (2.0 * r1 * r2) if crossing else -1.0
    return ux / apart, uy / apart, a, h, product


@njit(**VECTORISED)
def project_two_discs(table, count, effectors):
    """Nearest points outside two grown discs; returns the smallest product of two normals, 1 without any.

    A point that neither disc's own projection saves goes to the intersection of the two circles on its side:
    the same for all particles, which is how two fingers gather a belief.
    """
    x1, y1, r1 = effectors[0, EX], effectors[0, EY], effectors[0, GROWN]
    x2, y2, r2 = effectors[1, EX], effectors[1, EY], effectors[1, GROWN]
    ux, uy, a, h, product = _intersection(x1, y1, r1, x2, y2, r2)
    both = 0.0
    for i in range(count):
        x, y = table[X, i], table[Y, i]
        d1, nx1, ny1 = _polar(x - x1, y - y1)
        d2, nx2, ny2 = _polar(x - x2, y - y2)
        inside1, inside2 = d1 < r1 - CONTACT_TOLERANCE, d2 < r2 - CONTACT_TOLERANCE
        px1, py1 = x1 + r1 * nx1, y1 + r1 * ny1
        px2, py2 = x2 + r2 * nx2, y2 + r2 * ny2
        free1 = (px1 - x2) * (px1 - x2) + (py1 - y2) * (py1 - y2) >= r2 * r2
        free2 = (px2 - x1) * (px2 - x1) + (py2 - y1) * (py2 - y1) >= r1 * r1
        side = h if ux * (y - y1) - uy * (x - x1) >= 0.0 else -h
        first = inside1 & free1 & ((not (inside2 & free2)) | (r1 - d1 <= r2 - d2))
        second = inside2 & free2 & (not first)
        outside = not (inside1 | inside2)
        corner = not (first | second | outside)
        tx, ty = x1 + a * ux - side * uy, y1 + a * uy + side * ux
        both += 1.0 if corner else 0.0
        table[X, i] = px1 if first else (px2 if second else (tx if corner else x))
        table[Y, i] = py1 if first else (py2 if second else (ty if corner else y))
        table[TOUCHED, i] = 0.0 if outside else 1.0
    return product if both > 0.0 else 1.0


@njit(**VECTORISED)
def project_any(table, count, effectors):
    """As :func:`project_two_discs`, for any number of end effectors of any shape."""
    worst = 1.0
    for i in range(count):
        worst = min(worst, _project(table, i, effectors))
    return worst


@njit(**VECTORISED)
def _project(table, i, effectors):
    """The nearest point outside all end effectors for one particle; returns the product of two normals.

    Sequential linearisation: distances to convex sets are convex, so that a step which satisfies all
    linearised constraints satisfies the true ones, and repeating it only brings the point nearer to where it
    began. A particle stays, and the product is -1, where the linearised constraints contradict each other.
    """
    x0, y0 = table[X, i], table[Y, i]
    x, y, worst = x0, y0, 1.0
    table[TOUCHED, i] = 0.0
    for iteration in range(_ITERATIONS):
        if not _linearise(effectors, x, y, x0, y0) and iteration == 0:
            break
        table[TOUCHED, i] = 1.0
        found, dx, dy, product = _shortest(effectors)
        if not found:
            worst = -1.0 if iteration == 0 else worst  # later on it is round-off: this place is free
            break
        worst = product
        moved = abs(x0 + dx - x) + abs(y0 + dy - y)
        x, y = x0 + dx, y0 + dy
        if moved < CONTACT_TOLERANCE:
            break
    table[X, i], table[Y, i] = x, y
    return worst


@njit(**VECTORISED)
def _linearise(effectors, x, y, x0, y0):
    """Linearise n . d >= c at (x, y), d being the displacement from (x0, y0); is one broken?"""
    inside = False
    for e in range(effectors.shape[0]):
        gap, nx, ny = gap_normal(effectors, e, x, y)
        inside = inside or gap < -CONTACT_TOLERANCE
        effectors[e, CNX], effectors[e, CNY] = nx, ny
        effectors[e, BOUND] = -gap + nx * (x - x0) + ny * (y - y0)
    return inside


@njit(**VECTORISED)
def _shortest(effectors):
    """The shortest d that satisfies all constraints; at most two hold it in the plane.

    Returns:
        whether there is one, d, and the product of the normals that hold it (1 for less than two; -1 if there
        is none).
    """
    if _satisfied(effectors, 0.0, 0.0):
        return True, 0.0, 0.0, 1.0
    total, best, bx, by, product = effectors.shape[0], np.inf, 0.0, 0.0, -1.0
    for i in range(total):
        nx, ny, c = effectors[i, CNX], effectors[i, CNY], effectors[i, BOUND]
        if c > 0.0 and c * c < best and _satisfied(effectors, c * nx, c * ny):
            best, bx, by, product = c * c, c * nx, c * ny, 1.0
    if best < np.inf:
        return True, bx, by, product
    for i in range(total):
        for j in range(i):
            nx, ny, ox, oy = effectors[i, CNX], effectors[i, CNY], effectors[j, CNX], effectors[j, CNY]
            cross = nx * oy - ny * ox
            if abs(cross) < 1e-9:
                continue
            dx = (effectors[i, BOUND] * oy - effectors[j, BOUND] * ny) / cross
            dy = (effectors[j, BOUND] * nx - effectors[i, BOUND] * ox) / cross
            if dx * dx + dy * dy < best and _satisfied(effectors, dx, dy):
                best, bx, by, product = dx * dx + dy * dy, dx, dy, nx * ox + ny * oy
    return best < np.inf, bx, by, product


@njit(**VECTORISED)
def _satisfied(effectors, dx, dy):
    good = True
    for e in range(effectors.shape[0]):
        good = good and effectors[e, CNX] * dx + effectors[e, CNY] * dy >= effectors[e, BOUND] - 1e-12
    return good


@njit(**VECTORISED)
def give_way(table, count, effectors, radius, k, friction):
    """One step of the nominal dynamics, eq. (6.6), of all particles.

    Args:
        table: particles.
        count: how many of them.
        effectors: end effectors as placed.
        radius: of the object [m].
        k: 1 / c^2 of the limit surface [1/m^2].
        friction: whether particles carry friction and an offset of their centre of friction.

    Returns:
        smallest product of the normals of a double contact, 1 without any.
    """
    for i in range(count):
        table[X0, i], table[Y0, i] = table[X, i], table[Y, i]
    discs, total = True, effectors.shape[0]
    for e in range(total):
        discs = discs and effectors[e, HX] == 0.0 and effectors[e, HY] == 0.0
    if discs and total == 2:
        if friction:
            return drag_two_discs(table, count, effectors, radius, k)
        return project_two_discs(table, count, effectors)
    if discs and total == 1:
        if friction:
            return drag_one_disc(table, count, effectors, radius, k)
        return project_one_disc(table, count, effectors)
    if friction:
        return drag_any(table, count, effectors, radius, k)
    return project_any(table, count, effectors)


@njit(**VECTORISED)
def summary(table, count, mx, my):
    """What a step has done; the longest displacement of each particle is kept in the table.

    Returns:
        number of particles in contact, sum of squared displacements, sums of x - mx, y - my and of their
        squares.
    """
    hits, way, sx, sy, ss = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(count):
        x, y, longest = table[X, i], table[Y, i], table[FARTHEST, i]
        moved = (x - table[X0, i]) ** 2 + (y - table[Y0, i]) ** 2
        table[FARTHEST, i] = moved if moved > longest else longest
        hits += table[TOUCHED, i]
        way += moved
        sx += x - mx
        sy += y - my
        ss += (x - mx) ** 2 + (y - my) ** 2
    return hits, way, sx, sy, ss
