"""Compiled rollouts: tools move along sampled paths, objects give way quasi-statically, eq. (6.5a)–(6.5c).

The tool moves straight from sample to sample. Conservative advancement skips what cannot touch: as long as the object stands
still, the last gap bounds how far the tool may travel unseen.
"""

import math

import numpy as np
from numba import njit

from vpsto_ros.contact.narrow_phase import GAP, NX, NY, PX, PY, disc_contacts, rectangle_contacts
from vpsto_ros.contact.projection import CONTACT_COLUMNS, SLIP, solve_contacts

PENETRATION_TOLERANCE = 1e-6
STEP_ITERATIONS = 8
START_ITERATIONS = 60
# Longest displacement of one linearised projection: what a regular step needs, times this.
STEP_CAP = 2.0


@njit(cache=True, nogil=True)
def find_contacts(primitives, outline, tool, pose, tx, ty, tc, ts, margin, contacts):
    """Contacts in the object frame for a tool at world position (tx, ty), turned by the angle with cosine tc and sine ts."""
    dx, dy = tx - pose[0], ty - pose[1]
    c, s = pose[3], pose[4]
    x, y = c * dx + s * dy, c * dy - s * dx
    if tool[2] > 0.0:
        return disc_contacts(primitives, outline, x, y, tool[2], margin, contacts)
    return rectangle_contacts(primitives, outline, x, y, c * tc + s * ts, c * ts - s * tc, tool, margin, contacts)


@njit(cache=True, nogil=True)
def _set_slip(contacts, count, pose, before, now):
    """Tangential displacement that keeps every contact from sliding: the tool's, for the part of the step in contact."""
    c, s = pose[3], pose[4]
    # Turn and shift that lead the tool back to where it was before this step.
    dc, ds = now[2] * before[2] + now[3] * before[3], before[3] * now[2] - before[2] * now[3]
    for i in range(count):
        ax = pose[0] + c * contacts[i, PX] - s * contacts[i, PY] - now[0]
        ay = pose[1] + s * contacts[i, PX] + c * contacts[i, PY] - now[1]
        wx = now[0] + ax - before[0] - dc * ax + ds * ay
        wy = now[1] + ay - before[1] - ds * ax - dc * ay
        mx, my = c * wx + s * wy, c * wy - s * wx
        nx, ny = contacts[i, NX], contacts[i, NY]
        approach = -nx * mx - ny * my
        depth = -contacts[i, GAP]
        part = depth / approach if 0.0 < depth < approach else 1.0
        contacts[i, SLIP] = part * (nx * my - ny * mx)


@njit(cache=True, nogil=True)
def _move(pose, vx, vy, w, fx, fy):
    """Move the object by a twist about its centre of friction (fx, fy), all in the object frame."""
    c, s = pose[3], pose[4]
    if abs(w) < 0.1:
        q = w * w
        cw = 1.0 - q * (0.5 - q * (1.0 / 24.0 - q / 720.0))
        sw = w * (1.0 - q * (1.0 / 6.0 - q * (1.0 / 120.0 - q / 5040.0)))
    else:
        cw, sw = math.cos(w), math.sin(w)
    # The centre moves by (vx, vy), the origin follows the turn about it.
    lx = fx + vx - cw * fx + sw * fy
    ly = fy + vy - sw * fx - cw * fy
    pose[0] += c * lx - s * ly
    pose[1] += s * lx + c * ly
    pose[2] += w
    nc, ns = c * cw - s * sw, s * cw + c * sw
    unit = 1.5 - 0.5 * (nc * nc + ns * ns)  # keeps cosine and sine normalised over thousands of steps
    pose[3], pose[4] = nc * unit, ns * unit


@njit(cache=True, nogil=True)
def _give_way(primitives, outline, tool, pose, before, now, k, friction, fx, fy, margin, cap, iterations, contacts):
    """Project the object out of the tool; friction acts in the first linearisation, the rest removes its curvature error.

    Returns:
        gap that is left, and whether the object was moved.
    """
    touched = False
    gap = 0.0
    for iteration in range(iterations + 1):
        count, gap = find_contacts(
            primitives, outline, tool, pose, now[0], now[1], now[2], now[3], margin, contacts
        )
        if gap >= -PENETRATION_TOLERANCE or count == 0 or iteration == iterations:
            break
        touched = True
        mu = friction if iteration == 0 else 0.0
        if mu > 0.0:
            _set_slip(contacts, count, pose, before, now)
        vx, vy, w = solve_contacts(contacts, count, k, mu, fx, fy)
        size = math.sqrt(vx * vx + vy * vy + w * w / k)
        scale = cap / size if size > cap else 1.0
        _move(pose, scale * vx, scale * vy, scale * w, fx, fy)
    return gap, touched


@njit(cache=True, nogil=True)
def _set_tool(row, out):
    out[0], out[1] = row[0], row[1]
    if row.shape[0] == 3:
        out[2], out[3] = math.cos(row[2]), math.sin(row[2])


@njit(cache=True, nogil=True)
def _advance(primitives, outline, tool, pose, start, end, clear, k, friction, fx, fy, step, contacts, before, now):
    """Move the tool straight from path sample `start` to `end`.

    Returns:
        distance the tool may travel from there unseen, worst gap, whether the object was moved.
    """
    turn = end[2] - start[2] if start.shape[0] == 3 else 0.0
    length = math.sqrt((end[0] - start[0]) ** 2 + (end[1] - start[1]) ** 2) + abs(turn) * tool[3]
    worst = 0.0
    touched = False
    done = 0.0
    while length - done > clear:
        rest = length - done
        if clear > step:
            # Nothing can happen before this much is travelled; look again there.
            done += clear
            _interpolate(start, end, done / length, now)
            _, clear = find_contacts(
                primitives, outline, tool, pose, now[0], now[1], now[2], now[3], 0.0, contacts
            )
            clear = max(clear, 0.0)
            continue
        _interpolate(start, end, done / length, before)
        done = length if rest <= step else done + rest / math.ceil(rest / step)
        _interpolate(start, end, done / length, now)
        gap, moved = _give_way(
            primitives, outline, tool, pose, before, now, k, friction, fx, fy, step, STEP_CAP * step,
            STEP_ITERATIONS, contacts,
        )  # fmt: skip
        worst = min(worst, gap)
        touched = touched or moved
        clear = max(gap, 0.0)
    return clear - (length - done), worst, touched


@njit(cache=True, nogil=True)
def _interpolate(start, end, part, out):
    out[0] = start[0] + part * (end[0] - start[0])
    out[1] = start[1] + part * (end[1] - start[1])
    if start.shape[0] == 3:
        yaw = start[2] + part * (end[2] - start[2])
        out[2], out[3] = math.cos(yaw), math.sin(yaw)


@njit(cache=True, nogil=True)
def rollout_batch(primitives, outline, tool, start, paths, radius, friction, center, step, poses, touched, penetration):
    """Roll out B objects; every input with one row is shared by all of them.

    Args:
        primitives: object, shape (P, 7).
        outline: visible outline, shape (S, 6).
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
    pose = np.zeros(5)
    before = np.array([0.0, 0.0, 1.0, 0.0])
    now = np.array([0.0, 0.0, 1.0, 0.0])
    for b in range(poses.shape[0]):
        path = paths[min(b, paths.shape[0] - 1)]
        pose[:3] = start[min(b, start.shape[0] - 1)]
        pose[3], pose[4] = math.cos(pose[2]), math.sin(pose[2])
        k = radius[min(b, radius.shape[0] - 1)] ** -2
        mu = friction[min(b, friction.shape[0] - 1)]
        fx, fy = center[min(b, center.shape[0] - 1)]
        _set_tool(path[0], now)
        gap, moved = _give_way(
            primitives, outline, tool, pose, now, now, k, 0.0, fx, fy, step, STEP_CAP * step, START_ITERATIONS, contacts
        )
        poses[b, 0], touched[b, 0] = pose[:3], moved
        worst, clear = min(gap, 0.0), max(gap, 0.0)
        for i in range(1, path.shape[0]):
            clear, gap, moved = _advance(
                primitives, outline, tool, pose, path[i - 1], path[i], clear, k, mu, fx, fy, step, contacts, before, now
            )
            worst = min(worst, gap)
            poses[b, i, 0], poses[b, i, 1], poses[b, i, 2] = pose[0], pose[1], pose[2]
            touched[b, i] = moved
        penetration[b] = max(-worst - PENETRATION_TOLERANCE, 0.0)


@njit(cache=True, nogil=True)
def push_response(primitives, outline, tool, points, directions, radius, friction, fx, fy, twists):
    """First-order response of the object to a touching tool; see :func:`vpsto_ros.contact.pushing.push_directions`."""
    contacts = np.zeros((2 * primitives.shape[0], CONTACT_COLUMNS))
    pose = np.array([0.0, 0.0, 0.0, 1.0, 0.0])
    tool_pose = np.array([0.0, 0.0, 1.0, 0.0])
    for i in range(points.shape[0]):
        _set_tool(points[i], tool_pose)
        count, gap = find_contacts(
            primitives, outline, tool, pose, tool_pose[0], tool_pose[1], tool_pose[2], tool_pose[3], np.inf, contacts
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
