"""Compiled rollouts: tools move along sampled paths, objects give way quasi-statically, eq. (6.5a)–(6.5c).

The tool moves straight from sample to sample. Conservative advancement skips what cannot touch: as long as
the object stands still, the last gap bounds how far the tool may travel unseen.

Poses travel as scalars (x, y, cos, sin) and small helpers are inlined: passing arrays or slices between
compiled functions costs more than the arithmetic of a step.
"""

import math

import numpy as np
from numba import njit

from vpsto_ros.contact.narrow_phase import COMPILED, GAP, NX, NY, PX, PY, disc_contact, tool_contacts
from vpsto_ros.contact.projection import CONTACT_COLUMNS, SLIP, refine_contact, solve_contact, solve_contacts

PENETRATION_TOLERANCE = 1e-6
# A correction this small leaves a gap well below the tolerance: the error is quadratic.
SMALL_CHANGE = 5e-5
STEP_ITERATIONS = 8
START_ITERATIONS = 60
# Longest displacement of one linearised projection: what a regular step needs, times this.
STEP_CAP = 2.0


@njit(**COMPILED, inline="always")
def _tool_motion(px, py, ox, oy, c, s, bx, by, bc, bs, tx, ty, tc, ts):
    """Displacement, in the object frame, of the tool's surface where it touches the object at (px, py).

    The tool went from (bx, by, bc, bs) to (tx, ty, tc, ts); the object is at (ox, oy, c, s).
    """
    ax, ay = ox + c * px - s * py - tx, oy + s * px + c * py - ty
    rc, rs = tc * bc + ts * bs, bs * tc - bc * ts  # the turn that leads the tool back to where it was
    wx, wy = tx + ax - bx - rc * ax + rs * ay, ty + ay - by - rs * ax - rc * ay
    return c * wx + s * wy, c * wy - s * wx


@njit(**COMPILED, inline="always")
def _part_in_contact(gap, nx, ny, mx, my):
    """Part of the tool's motion (mx, my) during which it is in contact, if it ends at this gap."""
    approach = -nx * mx - ny * my
    return -gap / approach if 0.0 < -gap < approach else 1.0


@njit(**COMPILED, inline="always")
def _move(ox, oy, c, s, vx, vy, w, fx, fy):
    """Pose of an object after a constant body twist about its centre of friction (fx, fy)."""
    if abs(w) < 0.2:
        q = 0.25 * w * w
        ch = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q / 720.0))
        sh = 0.5 * w * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0 - q / 5040.0)))
    else:
        ch, sh = math.cos(0.5 * w), math.sin(0.5 * w)
    cw, sw = 1.0 - 2.0 * sh * sh, 2.0 * sh * ch
    # The centre moves along the velocity half-way, the origin follows the turn about it.
    lx = fx + ch * vx - sh * vy - cw * fx + sw * fy
    ly = fy + sh * vx + ch * vy - sw * fx - cw * fy
    nc, ns = c * cw - s * sw, s * cw + c * sw
    unit = 1.5 - 0.5 * (nc * nc + ns * ns)  # keeps cosine and sine normalised over thousands of steps
    return ox + c * lx - s * ly, oy + s * lx + c * ly, nc * unit, ns * unit


@njit(**COMPILED)
def _set_slips(contacts, count, ox, oy, c, s, bx, by, bc, bs, tx, ty, tc, ts):
    """Tangential displacement that keeps each of several contacts from sliding."""
    for j in range(count):
        nx, ny = contacts[j, NX], contacts[j, NY]
        mx, my = _tool_motion(contacts[j, PX], contacts[j, PY], ox, oy, c, s, bx, by, bc, bs, tx, ty, tc, ts)
        contacts[j, SLIP] = _part_in_contact(contacts[j, GAP], nx, ny, mx, my) * (nx * my - ny * mx)


@njit(**COMPILED, inline="always")
def _rest_after_hop(rest, clear, step):
    """Way left to the next sample after a hop: at once through free space, in short steps near the object."""
    if clear > step:
        return rest - clear
    return rest - rest / math.ceil(rest / step) if rest > step else 0.0


@njit(**COMPILED, inline="always")
def _limited(vx, vy, w, k, cap):
    """Twist scaled down to at most `cap` in the metric of the limit surface, and whether that was needed."""
    size = vx * vx + vy * vy + w * w / k
    scale = cap / math.sqrt(size) if size > cap * cap else 1.0
    return scale * vx, scale * vy, scale * w, scale < 1.0


@njit(**COMPILED)
def _rollout_one(primitives, outline, tool, paths, p, k, mu, fx, fy, step, contacts, poses, touched, b):
    """Roll out object b, whose start is in poses[b, 0], along path p; return the worst gap.

    Names: object (ox, oy, yaw; c, s), before the step (qx, qy, qc, qs), half-turned (hc, hs); tool (tx, ty,
    tc, ts), before the step (bx, by, bc, bs); path from sample (sx, sy, sa) to (ex, ey, ea); contact (nx, ny,
    px, py), at the end of the last step (nx0, ny0, px0, py0); twist (vx, vy, w), refined (ux, uy, u).
    """
    thx, thy, radius, reach = tool[0], tool[1], tool[2], tool[3]
    single = radius > 0.0 and primitives.shape[0] == 1
    cx, cy, hx, hy = primitives[0, 0], primitives[0, 1], primitives[0, 2], primitives[0, 3]
    pc, ps, pr = primitives[0, 4], primitives[0, 5], primitives[0, 6]
    turning = paths.shape[2] == 3
    ox, oy, yaw = poses[b, 0, 0], poses[b, 0, 1], poses[b, 0, 2]
    c, s = math.cos(yaw), math.sin(yaw)
    worst, clear, cap = 0.0, -1.0, STEP_CAP * step
    touching = False
    nx0 = ny0 = px0 = py0 = vx = vy = w = slip = qx = qy = qc = qs = hc = hs = ta = ea = 0.0
    tc, ts, ex, ey = 1.0, 0.0, paths[p, 0, 0], paths[p, 0, 1]
    if turning:
        ea = paths[p, 0, 2]
        tc, ts = math.cos(ea), math.sin(ea)
    tx, ty = ex, ey
    for i in range(paths.shape[1]):
        sx, sy, sa = ex, ey, ea
        ex, ey = paths[p, i, 0], paths[p, i, 1]
        if turning:
            ea = paths[p, i, 2]
        length = math.sqrt((ex - sx) ** 2 + (ey - sy) ** 2) + abs(ea - sa) * reach
        rest = length
        moved = False
        iterations = START_ITERATIONS if i == 0 else STEP_ITERATIONS
        while rest > clear:
            rest = _rest_after_hop(rest, clear, step)
            bx, by, bc, bs = tx, ty, tc, ts
            back = rest / length if rest > 0.0 else 0.0
            tx, ty = ex + back * (sx - ex), ey + back * (sy - ey)
            if turning:
                ta = ea + back * (sa - ea)
                tc, ts = math.cos(ta), math.sin(ta)
            gap, part, refine, refined = 0.0, 1.0, False, False
            for iteration in range(iterations + 1):
                dx, dy = tx - ox, ty - oy
                lx, ly, count = c * dx + s * dy, c * dy - s * dx, 1
                if single:
                    gap, nx, ny, px, py = disc_contact(lx, ly, radius, cx, cy, hx, hy, pc, ps, pr)
                else:
                    rc, rs = c * tc + s * ts, c * ts - s * tc
                    count, gap = tool_contacts(
                        primitives, outline, lx, ly, rc, rs, thx, thy, radius, step, contacts
                    )
                    nx, ny, px, py = contacts[0, NX], contacts[0, NY], contacts[0, PX], contacts[0, PY]
                if refine and iteration == 1 and count == 1:
                    # Redo the step with the contact half-way.
                    mx, my = _tool_motion(px, py, qx, qy, hc, hs, bx, by, bc, bs, tx, ty, tc, ts)
                    slip = part * (0.5 * (nx + nx0) * my - 0.5 * (ny + ny0) * mx)
                    ux, uy, u = refine_contact(
                        vx, vy, w, gap, nx, ny, px, py, nx0, ny0, px0, py0, slip, k, mu, fx, fy
                    )
                    change = (ux - vx) ** 2 + (uy - vy) ** 2 + (u - w) ** 2 / k
                    if (
                        change < 0.25 * step * step
                    ):  # otherwise the contact jumped, and half-way means nothing
                        refined = True
                        nx0, ny0, px0, py0 = nx, ny, px, py
                        yaw += u - w
                        ox, oy, c, s = _move(qx, qy, qc, qs, ux, uy, u, fx, fy)
                        if change < SMALL_CHANGE * SMALL_CHANGE:
                            gap = 0.0
                            break
                        continue
                if gap >= -PENETRATION_TOLERANCE or count == 0 or iteration == iterations:
                    break
                moved = True
                # Friction acts in the first linearisation; the others only remove what curvature leaves.
                friction = mu if iteration == 0 and i > 0 else 0.0
                if count == 1:
                    if friction > 0.0:
                        mx, my = _tool_motion(px, py, ox, oy, c, s, bx, by, bc, bs, tx, ty, tc, ts)
                        part = _part_in_contact(gap, nx, ny, mx, my)
                        slip = part * (nx * my - ny * mx)
                    vx, vy, w = solve_contact(gap, nx, ny, px, py, slip, k, friction, fx, fy)
                else:
                    if friction > 0.0:
                        _set_slips(contacts, count, ox, oy, c, s, bx, by, bc, bs, tx, ty, tc, ts)
                    vx, vy, w = solve_contacts(contacts, count, k, friction, fx, fy)
                vx, vy, w, limited = _limited(vx, vy, w, k, cap)
                refine = count == 1 and iteration == 0 and i > 0 and not limited
                if not touching:
                    nx0, ny0, px0, py0 = nx, ny, px, py
                qx, qy, qc, qs = ox, oy, c, s
                hc, hs = c - 0.5 * w * s, s + 0.5 * w * c
                ox, oy, c, s = _move(ox, oy, c, s, vx, vy, w, fx, fy)
                yaw += w
            touching = refined
            worst = min(worst, gap)
            clear = max(gap, 0.0)
        clear -= rest
        tx, ty = ex, ey
        if turning and rest > 0.0:
            tc, ts = math.cos(ea), math.sin(ea)
        poses[b, i, 0], poses[b, i, 1], poses[b, i, 2] = ox, oy, yaw
        touched[b, i] = moved
    return worst


@njit(**COMPILED)
def rollout_batch(
    primitives, outline, tool, start, paths, radius, friction, center, step, poses, touched, penetration
):
    """Roll out B objects; every input with one row is shared by all of them.

    Args:
        primitives: object, shape (P, 7).
        outline: visible outline, shape (S, 7).
        tool: half sizes, radius and bounding radius, shape (4,).
        start: object poses, shape (1 or B, 3).
        paths: tool centres, shape (1 or B, K, 2 or 3).
        radius: pressure radius, shape (1 or B,).
        friction: tool friction, shape (1 or B,).
        center: centre of friction in the object frame, shape (1 or B, 2).
        step: longest tool motion between projections.
        poses: output, shape (B, K, 3).
        touched: output, shape (B, K).
        penetration: output, shape (B,).
    """
    contacts = np.zeros((2 * primitives.shape[0], CONTACT_COLUMNS))
    for b in range(poses.shape[0]):
        first = min(b, start.shape[0] - 1)
        poses[b, 0, 0], poses[b, 0, 1], poses[b, 0, 2] = start[first, 0], start[first, 1], start[first, 2]
        p = min(b, paths.shape[0] - 1)
        k = radius[min(b, radius.shape[0] - 1)] ** -2
        mu = friction[min(b, friction.shape[0] - 1)]
        f = min(b, center.shape[0] - 1)
        fx, fy = center[f, 0], center[f, 1]
        worst = _rollout_one(
            primitives, outline, tool, paths, p, k, mu, fx, fy, step, contacts, poses, touched, b
        )
        penetration[b] = -worst if worst < -PENETRATION_TOLERANCE else 0.0


@njit(**COMPILED)
def push_response(primitives, outline, tool, points, directions, radius, friction, fx, fy, twists):
    """First-order response to a touching tool; see `vpsto_ros.contact.pushing.push_directions`."""
    contacts = np.zeros((2 * primitives.shape[0], CONTACT_COLUMNS))
    hx, hy, r = tool[0], tool[1], tool[2]
    for i in range(points.shape[0]):
        c, s = 1.0, 0.0
        if points.shape[1] == 3:
            c, s = math.cos(points[i, 2]), math.sin(points[i, 2])
        count, gap = tool_contacts(
            primitives, outline, points[i, 0], points[i, 1], c, s, hx, hy, r, np.inf, contacts
        )
        used = 0
        for j in range(count):
            if contacts[j, GAP] <= gap + PENETRATION_TOLERANCE:
                contacts[used, : PY + 1] = contacts[j, : PY + 1]
                nx, ny = contacts[used, NX], contacts[used, NY]
                contacts[used, GAP] = nx * directions[i, 0] + ny * directions[i, 1]
                contacts[used, SLIP] = nx * directions[i, 1] - ny * directions[i, 0]
                used += 1
        vx, vy, w = solve_contacts(contacts, used, radius**-2, friction, fx, fy)
        # From the centre of friction to the origin of the object.
        twists[i, 0], twists[i, 1], twists[i, 2] = vx + w * fy, vy - w * fx, w
