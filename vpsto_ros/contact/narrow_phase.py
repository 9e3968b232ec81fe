"""Compiled narrow phase: where a tool touches, or is about to touch, a union of rectangles and discs.

Everything here is expressed in the object frame. A primitive is one row ``(cx, cy, hx, hy, cos, sin, r)``: a
rectangle with half sizes ``hx, hy`` turned by the angle whose cosine and sine are given (``r = 0``), or a
disc of radius ``r`` (``hx = hy = 0``). The tool is one primitive ``(hx, hy, r)`` with its own pose. A contact
is one row whose first columns are ``GAP`` (negative when penetrating), the unit normal ``NX, NY`` pointing
out of the object, and the contact point ``PX, PY`` on the object.
"""

import math
from typing import Any

from numba import njit

# Fused multiply-adds and reciprocals are welcome; NaN and infinity keep their meaning.
COMPILED: dict[str, Any] = {
    "cache": True,
    "nogil": True,
    "error_model": "numpy",
    "fastmath": {"contract", "arcp", "nsz"},
}

GAP, NX, NY, PX, PY = 0, 1, 2, 3, 4

# A point this close to a primitive belongs to it: closes the seams of abutting primitives.
SEAM = 1e-9
# Look this far along a contact normal to see whether the contact is on the outside of the union.
PROBE = 1e-6
# Prefer the faces of the object when both rectangles are parallel, so that the choice does not flicker.
PARALLEL_BIAS = 1e-9


@njit(**COMPILED, inline="always")
def _nearest(lx, ly, hx, hy, r):
    """Gap, outward normal and surface point of a primitive, seen from a point in the primitive's frame."""
    qx = abs(lx) - hx
    qy = abs(ly) - hy
    if qx > 0.0 or qy > 0.0:
        ex = qx if qx > 0.0 else 0.0
        ey = qy if qy > 0.0 else 0.0
        d = math.sqrt(ex * ex + ey * ey)
        if d > 1e-12:
            nx = math.copysign(ex / d, lx)
            ny = math.copysign(ey / d, ly)
            sx = min(max(lx, -hx), hx) + r * nx
            sy = min(max(ly, -hy), hy) + r * ny
            return d - r, nx, ny, sx, sy
    if qx >= qy:
        nx = math.copysign(1.0, lx)
        return qx - r, nx, 0.0, nx * (hx + r), ly
    ny = math.copysign(1.0, ly)
    return qy - r, 0.0, ny, lx, ny * (hy + r)


@njit(**COMPILED)
def primitive_distance(primitives, j, x, y):
    """Signed distance from the point (x, y) to primitive j."""
    dx = x - primitives[j, 0]
    dy = y - primitives[j, 1]
    lx = primitives[j, 4] * dx + primitives[j, 5] * dy
    ly = primitives[j, 4] * dy - primitives[j, 5] * dx
    return _nearest(lx, ly, primitives[j, 2], primitives[j, 3], primitives[j, 6])[0]


@njit(**COMPILED)
def nearest_on_outline(outline, x, y):
    """Distance, point and outward normal of the outline segment nearest to (x, y)."""
    best = math.inf
    bx = by = nx = ny = 0.0
    for i in range(outline.shape[0]):
        ax, ay = outline[i, 0], outline[i, 1]
        ux, uy = outline[i, 2] - ax, outline[i, 3] - ay
        t = ((x - ax) * ux + (y - ay) * uy) / (ux * ux + uy * uy)
        t = min(max(t, 0.0), 1.0)
        cx, cy = ax + t * ux, ay + t * uy
        d = (x - cx) ** 2 + (y - cy) ** 2
        if d < best:
            best, bx, by, nx, ny = d, cx, cy, outline[i, 4], outline[i, 5]
    return math.sqrt(best), bx, by, nx, ny


@njit(**COMPILED)
def signed_distances(primitives, outline, points, out):
    """Signed distance from every point to the union, exact outside and inside."""
    for k in range(points.shape[0]):
        x, y = points[k, 0], points[k, 1]
        distance = math.inf
        for j in range(primitives.shape[0]):
            distance = min(distance, primitive_distance(primitives, j, x, y))
        if distance < 0.0 and primitives.shape[0] > 1:
            # Each primitive alone underestimates how deep a point is inside the union.
            distance = -nearest_on_outline(outline, x, y)[0]
        out[k] = distance


@njit(**COMPILED)
def _outline_contact(outline, x, y, outside, tc, ts, bx, by, radius, contacts):
    """One contact that leads a tool at (x, y, tc, ts) out past the visible edge nearest to its centre.

    The way out for tools that penetrate so deep that the primitives' own contacts point at each other.
    """
    distance, px, py, nx, ny = nearest_on_outline(outline, x, y)
    if distance > 1e-12:
        sign = 1.0 if outside else -1.0
        nx, ny = sign * (x - px) / distance, sign * (y - py) / distance
    extent = radius + bx * abs(tc * nx + ts * ny) + by * abs(tc * ny - ts * nx)
    contacts[0, GAP] = (distance if outside else -distance) - extent
    contacts[0, NX], contacts[0, NY] = nx, ny
    contacts[0, PX], contacts[0, PY] = px, py
    return 1, contacts[0, GAP]


@njit(**COMPILED, inline="always")
def disc_contact(x, y, radius, cx, cy, hx, hy, c, s, r):
    """Gap, normal and contact point of a disc at (x, y) with the primitive (cx, cy, hx, hy, cos, sin, r)."""
    dx, dy = x - cx, y - cy
    distance, nx, ny, sx, sy = _nearest(c * dx + s * dy, c * dy - s * dx, hx, hy, r)
    return distance - radius, c * nx - s * ny, s * nx + c * ny, cx + c * sx - s * sy, cy + s * sx + c * sy


@njit(**COMPILED)
def disc_contacts(primitives, outline, x, y, radius, margin, contacts):
    """Contacts of a disc tool at (x, y) with every primitive nearer than `margin`.

    Returns:
        number of contacts written, and the signed gap between the tool and the union.
    """
    count = 0
    gap = math.inf
    for j in range(primitives.shape[0]):
        cx, cy, hx, hy = primitives[j, 0], primitives[j, 1], primitives[j, 2], primitives[j, 3]
        c, s, r = primitives[j, 4], primitives[j, 5], primitives[j, 6]
        distance, nx, ny, px, py = disc_contact(x, y, radius, cx, cy, hx, hy, c, s, r)
        if distance < -radius and primitives.shape[0] > 1:
            return _outline_contact(outline, x, y, False, 1.0, 0.0, 0.0, 0.0, radius, contacts)
        gap = min(gap, distance)
        if distance < margin:
            contacts[count, GAP], contacts[count, NX], contacts[count, NY] = distance, nx, ny
            contacts[count, PX], contacts[count, PY] = px, py
            contacts[count, 5] = j
            count += 1
    if count > 1:
        count = _drop_covered(primitives, contacts, count)
    return count, gap


@njit(**COMPILED)
def _drop_covered(primitives, contacts, count):
    """Drop contacts whose point lies in another primitive that has a contact of its own.

    Keeping that primitive clear of the tool already keeps the point clear, so nothing is lost; inner edges of
    overlapping or abutting primitives vanish. Two primitives that cover each other's point share it: the
    first one is kept.
    """
    kept = 0
    for i in range(count):
        own = int(contacts[i, 5])
        covered = False
        for j in range(count):
            other = int(contacts[j, 5])
            if j != i and primitive_distance(primitives, other, contacts[i, PX], contacts[i, PY]) <= SEAM:
                mutual = primitive_distance(primitives, own, contacts[j, PX], contacts[j, PY]) <= SEAM
                if other < own or not mutual:
                    covered = True
        contacts[i, 6] = 1.0 if covered else 0.0
    for i in range(count):
        if contacts[i, 6] == 0.0:
            for column in range(6):
                contacts[kept, column] = contacts[i, column]
            kept += 1
    return kept


@njit(**COMPILED)
def rectangle_contacts(primitives, outline, x, y, tc, ts, bx, by, margin, contacts):
    """Contacts of a rectangle tool (half sizes bx, by) at (x, y, cos, sin); see :func:`disc_contacts`."""
    if primitives.shape[0] > 1:
        for j in range(primitives.shape[0]):
            if primitive_distance(primitives, j, x, y) < 0.0:
                return _outline_contact(outline, x, y, False, tc, ts, bx, by, 0.0, contacts)
    count = 0
    gap = math.inf
    for j in range(primitives.shape[0]):
        if primitives[j, 6] > 0.0:
            distance = _rectangle_against_disc(primitives, j, x, y, tc, ts, bx, by, contacts, count)
            added = 1 if distance < margin else 0
        else:
            added, distance = _rectangle_against_rectangle(
                primitives, j, x, y, tc, ts, bx, by, margin, contacts, count
            )
        gap = min(gap, distance)
        count = _keep_visible(primitives, j, contacts, count, count + added)
    if count == 0 and gap < -PROBE and primitives.shape[0] > 1:
        return _outline_contact(outline, x, y, True, tc, ts, bx, by, 0.0, contacts)
    return count, gap


@njit(**COMPILED)
def tool_contacts(primitives, outline, x, y, c, s, hx, hy, radius, margin, contacts):
    """Contacts of any tool at (x, y, cos, sin): a disc if its radius is positive, else a rectangle."""
    if radius > 0.0:
        return disc_contacts(primitives, outline, x, y, radius, margin, contacts)
    return rectangle_contacts(primitives, outline, x, y, c, s, hx, hy, margin, contacts)


@njit(**COMPILED)
def _keep_visible(primitives, own, contacts, count, end):
    """Drop new contacts, rows `count` to `end`, that look into another primitive; return the rows left."""
    for i in range(count, end):
        hidden = False
        x, y = contacts[i, PX] + PROBE * contacts[i, NX], contacts[i, PY] + PROBE * contacts[i, NY]
        for j in range(primitives.shape[0]):
            if j != own and primitive_distance(primitives, j, x, y) < -SEAM:
                hidden = True
        if not hidden:
            for column in range(5):
                contacts[count, column] = contacts[i, column]
            count += 1
    return count


@njit(**COMPILED)
def _rectangle_against_disc(primitives, j, x, y, tc, ts, bx, by, contacts, row):
    """Mirrored: the disc of the object seen from the tool."""
    dx, dy = primitives[j, 0] - x, primitives[j, 1] - y
    lx, ly = tc * dx + ts * dy, tc * dy - ts * dx
    distance, nx, ny, _, _ = _nearest(lx, ly, bx, by, 0.0)
    r = primitives[j, 6]
    contacts[row, GAP] = distance - r
    contacts[row, NX], contacts[row, NY] = ts * ny - tc * nx, -ts * nx - tc * ny
    contacts[row, PX] = primitives[j, 0] + r * contacts[row, NX]
    contacts[row, PY] = primitives[j, 1] + r * contacts[row, NY]
    return distance - r


@njit(**COMPILED)
def _rectangle_against_rectangle(primitives, j, x, y, tc, ts, bx, by, margin, contacts, row):
    """Separating axis with the contacts of the incident face clipped to the reference face.

    Returns:
        number of contacts written, separation (a lower bound of the distance; exact where it is negative or
        faces overlap).
    """
    ox, oy, c, s = primitives[j, 0], primitives[j, 1], primitives[j, 4], primitives[j, 5]
    ax, ay = primitives[j, 2], primitives[j, 3]
    rc, rs = c * tc + s * ts, c * ts - s * tc  # the tool's turn seen from the primitive
    ux, uy = abs(rc), abs(rs)
    px, py = (
        c * (x - ox) + s * (y - oy),
        c * (y - oy) - s * (x - ox),
    )  # the tool's centre seen from the primitive
    qx, qy = -rc * px - rs * py, rs * px - rc * py  # and the other way round
    sep_a = max(abs(px) - ax - ux * bx - uy * by, abs(py) - ay - uy * bx - ux * by)
    sep_b = max(abs(qx) - bx - ux * ax - uy * ay, abs(qy) - by - uy * ax - ux * ay)
    separation = max(sep_a, sep_b)
    if separation >= margin:
        return 0, separation
    if sep_a >= sep_b - PARALLEL_BIAS:
        along_x = abs(px) - ax - ux * bx - uy * by >= abs(py) - ay - uy * bx - ux * by
        written = _clip(px, py, rc, rs, ax, ay, bx, by, along_x, False, margin, contacts, row)
    else:
        along_x = abs(qx) - bx - ux * ax - uy * ay >= abs(qy) - by - uy * ax - ux * ay
        written = _clip(qx, qy, rc, -rs, bx, by, ax, ay, along_x, True, margin, contacts, row)
        for i in range(row, row + written):
            _to_parent(contacts, i, rc, rs, px, py)
    for i in range(row, row + written):
        _to_parent(contacts, i, c, s, ox, oy)
    return written, separation


@njit(**COMPILED)
def _to_parent(contacts, i, c, s, x, y):
    """Express a contact in the frame in which its present frame has pose (x, y) and turn (c, s)."""
    nx, ny, px, py = contacts[i, NX], contacts[i, NY], contacts[i, PX], contacts[i, PY]
    contacts[i, NX], contacts[i, NY] = c * nx - s * ny, s * nx + c * ny
    contacts[i, PX], contacts[i, PY] = x + c * px - s * py, y + s * px + c * py


@njit(**COMPILED)
def _clip(px, py, c, s, rx, ry, hx, hy, along_x, mirrored, margin, contacts, row):
    """Contacts of a face of a reference rectangle (rx, ry) at the origin with one (hx, hy) at (px, py, c, s).

    The face looks along x or y towards the incident rectangle. Without `mirrored` the reference is the
    object, and normals and points are its face's; with it the reference is the tool, and the points are the
    incident vertices.
    """
    if not along_x:  # work along x: swap the axes, which also turns the sense of rotation
        px, py, s, rx, ry, hx, hy = py, px, -s, ry, rx, hy, hx
    sign = math.copysign(1.0, px)
    # The incident face looks most against the reference's normal (sign, 0).
    if abs(c) >= abs(s):
        d = -math.copysign(1.0, c) * sign
        mx, my, ex, ey = px + d * hx * c, py + d * hx * s, -hy * s, hy * c
    else:
        d = math.copysign(1.0, s) * sign
        mx, my, ex, ey = px - d * hy * s, py + d * hy * c, hx * c, hx * s
    # The face is m + t e with t in [-1, 1]; keep the part in front of the reference face.
    low, high = -1.0, 1.0
    if abs(ey) > 1e-12:
        t1, t2 = (-ry - my) / ey, (ry - my) / ey
        low, high = max(low, min(t1, t2)), min(high, max(t1, t2))
    elif abs(my) > ry:
        high = -2.0
    if low > high:  # corner against corner: the deepest vertex, if it penetrates at all
        low = high = -math.copysign(1.0, ex * sign)
        margin = 0.0
    written = 0
    for end in range(2 if high - low > 1e-9 else 1):
        t = low if end == 0 else high
        vx, vy = mx + t * ex, my + t * ey
        gap = sign * vx - rx
        if gap < margin:
            i = row + written
            nx, ny, qx, qy = sign, 0.0, vx - sign * gap, vy
            if mirrored:
                nx, qx = -sign, vx
            if not along_x:
                nx, ny, qx, qy = ny, nx, qy, qx
            contacts[i, GAP], contacts[i, NX], contacts[i, NY] = gap, nx, ny
            contacts[i, PX], contacts[i, PY] = qx, qy
            written += 1
    return written
