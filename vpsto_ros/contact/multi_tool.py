"""Compiled rollouts of an object of any shape among several end effectors, for many particles.

The general counterpart of :mod:`vpsto_ros.contact.disc_rollout`: the object has an orientation, contacts come
from the narrow phase, and all of them are solved together by block Gauss-Seidel with friction. Steps are cut
so that no end effector moves farther than `SUBSTEP` at once.
"""

import math

import numpy as np
from numba import njit

from vpsto_ros.contact.narrow_phase import COMPILED, GAP, NX, NY, PX, PY, tool_contacts
from vpsto_ros.contact.projection import CONTACT_COLUMNS, LAMBDA_N, SLIP, solve_contacts
from vpsto_ros.contact.rollout_kernel import PENETRATION_TOLERANCE, _move, _part_in_contact, _tool_motion

SUBSTEP = 0.002
"""Longest motion of an end effector between two projections [m]."""
MARGIN = 0.004
"""Contacts that a substep may close are solved for from this gap on [m]."""
PRESSING = 1e-8
"""An impulse [m] smaller than this is what the solver leaves, not a contact that holds the object."""
_ITERATIONS = 20
TOOL = 10
"""Column of a contact that says whose it is."""
COLUMNS = max(CONTACT_COLUMNS, TOOL + 1)


@njit(**COMPILED)
def _tool_pose(rows, point, before, share, e):
    """Pose (x, y, cos, sin) of end effector e at a share of the way from one plane point to the next."""
    c = int(rows[e, 4])
    x = before[c] + share * (point[c] - before[c])
    y = before[c + 1] + share * (point[c + 1] - before[c + 1])
    if rows[e, 5] > 0.0:
        a = before[c + 2] + share * (point[c + 2] - before[c + 2])
        return x, y, math.cos(a), math.sin(a)
    return x, y, 1.0, 0.0


@njit(**COMPILED)
def gather(primitives, outline, rows, point, before, share, pose, margin, contacts):
    """All contacts nearer than `margin`, in the object frame; returns their number and the smallest gap."""
    ox, oy, c, s = pose[0], pose[1], pose[2], pose[3]
    count, smallest = 0, np.inf
    for e in range(rows.shape[0]):
        tx, ty, tc, ts = _tool_pose(rows, point, before, share, e)
        dx, dy = tx - ox, ty - oy
        found, gap = tool_contacts(
            primitives, outline, c * dx + s * dy, c * dy - s * dx, c * tc + s * ts, c * ts - s * tc,
            rows[e, 0], rows[e, 1], rows[e, 2], margin, contacts[count:],
        )  # fmt: skip
        for j in range(count, count + found):
            contacts[j, TOOL] = e
        count += found
        smallest = min(smallest, gap)
    return count, smallest


@njit(**COMPILED)
def _set_slips(contacts, count, rows, point, before, share, previous, pose):
    """Tangential motion of each end effector's surface at its contacts since the last substep."""
    ox, oy, c, s = pose[0], pose[1], pose[2], pose[3]
    for j in range(count):
        e = int(contacts[j, TOOL])
        tx, ty, tc, ts = _tool_pose(rows, point, before, share, e)
        bx, by, bc, bs = _tool_pose(rows, point, before, previous, e)
        mx, my = _tool_motion(
            contacts[j, PX], contacts[j, PY], ox, oy, c, s, bx, by, bc, bs, tx, ty, tc, ts
        )  # fmt: skip
        nx, ny = contacts[j, NX], contacts[j, NY]
        contacts[j, SLIP] = _part_in_contact(contacts[j, GAP], nx, ny, mx, my) * (nx * my - ny * mx)


@njit(**COMPILED)
def _wedge(contacts, count):
    """Smallest product of the normals of two end effectors that both press, after `solve_contacts`."""
    worst = 1.0
    for i in range(count):
        for j in range(i):
            pressing = contacts[i, LAMBDA_N] > PRESSING and contacts[j, LAMBDA_N] > PRESSING
            if pressing and contacts[i, TOOL] != contacts[j, TOOL]:
                product = contacts[i, NX] * contacts[j, NX] + contacts[i, NY] * contacts[j, NY]
                worst = min(worst, product)
    return worst


@njit(**COMPILED)
def advance(primitives, outline, rows, point, before, pose, k, mu, fx, fy, contacts):
    """Move the end effectors from one plane point to the next; `pose` (x, y, cos, sin, yaw) gives way.

    Returns:
        whether there was contact, smallest product of two normals (-1: no way out was found), and of the last
        substep with contact: normal of a contact in the object frame, whether only one end effector pressed.
    """
    longest = 0.0
    for e in range(rows.shape[0]):
        c = int(rows[e, 4])
        way = math.hypot(point[c] - before[c], point[c + 1] - before[c + 1])
        if rows[e, 5] > 0.0:
            way += abs(point[c + 2] - before[c + 2]) * rows[e, 3]
        longest = max(longest, way)
    # Nothing is in reach: no substeps.
    if gather(primitives, outline, rows, point, before, 1.0, pose, 0.0, contacts)[1] > longest:
        return False, 1.0, 0.0, 0.0, False
    substeps = max(1, math.ceil(longest / SUBSTEP))
    touched, worst, nx, ny, single = False, 1.0, 0.0, 0.0, False
    for i in range(1, substeps + 1):
        share, presses = i / substeps, -1
        for iteration in range(_ITERATIONS + 1):
            count, gap = gather(primitives, outline, rows, point, before, share, pose, MARGIN, contacts)
            if gap >= -PENETRATION_TOLERANCE:
                break
            touched = True
            if iteration == _ITERATIONS or count == 0:
                worst = -1.0
                break
            friction = mu if iteration == 0 else 0.0
            if friction > 0.0:
                _set_slips(contacts, count, rows, point, before, share, (i - 1) / substeps, pose)
            vx, vy, w = solve_contacts(contacts, count, k, friction, fx, fy)
            worst = min(worst, _wedge(contacts, count))
            for j in range(count):
                if contacts[j, LAMBDA_N] > PRESSING:
                    if presses < 0:
                        presses = int(contacts[j, TOOL])
                        nx, ny, single = contacts[j, NX], contacts[j, NY], True
                    single = single and contacts[j, TOOL] == presses
            pose[0], pose[1], pose[2], pose[3] = _move(pose[0], pose[1], pose[2], pose[3], vx, vy, w, fx, fy)
            pose[4] += w
    return touched, worst, nx, ny, single


@njit(**COMPILED)
def tool_gaps(primitives, outline, rows, pose, point, gaps):
    """Signed distances of the object at a pose (x, y, yaw) to every end effector."""
    contacts = np.zeros((2 * primitives.shape[0], COLUMNS))
    c, s = math.cos(pose[2]), math.sin(pose[2])
    for e in range(rows.shape[0]):
        tx, ty, tc, ts = _tool_pose(rows, point, point, 1.0, e)
        dx, dy = tx - pose[0], ty - pose[1]
        gaps[e] = tool_contacts(
            primitives, outline, c * dx + s * dy, c * dy - s * dx, c * tc + s * ts, c * ts - s * tc,
            rows[e, 0], rows[e, 1], rows[e, 2], np.inf, contacts,
        )[1]  # fmt: skip


@njit(**COMPILED)
def predict_shapes(
    primitives, outline, rows, k, friction, start, centers, paths, mean, variance, contact, wedge, step
):
    """Nominal belief dynamics (6.27) of B candidates; as `disc_rollout.predict_discs`.

    The variance is that of the pose in the metric of the limit surface: the yaw counts 1 / k.

    Args:
        primitives: object, shape (Q, 7).
        outline: its visible outline.
        rows: end effectors, shape (E, 6).
        k: 1 / c^2 of the limit surface [1/m^2].
        friction: of each particle, shape (P,).
        start: poses, shape (P, 3).
        centers: centres of friction, object frame, shape (P, 2).
        paths: plane coordinates, shape (B, K + 1, m).
        mean: output, mean poses, shape (B, K + 1, 3).
        variance: output, shape (B, K + 1).
        contact: output, shape (B, K).
        wedge: output, shape (B,).
        step: output, shape (B,).
    """
    particles = start.shape[0]
    contacts = np.zeros((2 * primitives.shape[0] * rows.shape[0], COLUMNS))
    poses = np.empty((particles, 5))
    for b in range(paths.shape[0]):
        wedge[b], step[b] = 1.0, 0.0
        for i in range(particles):
            poses[i, 0], poses[i, 1], poses[i, 4] = start[i, 0], start[i, 1], start[i, 2]
            poses[i, 2], poses[i, 3] = math.cos(start[i, 2]), math.sin(start[i, 2])
        variance[b, 0] = _pose_spread(poses, 1.0 / k, mean[b, 0])
        for j in range(1, paths.shape[1]):
            hits = 0
            for i in range(particles):
                pose = poses[i]
                x, y = pose[0], pose[1]
                touched, product, _, _, _ = advance(
                    primitives, outline, rows, paths[b, j], paths[b, j - 1], pose, k, friction[i],
                    centers[i, 0], centers[i, 1], contacts,
                )  # fmt: skip
                if touched:
                    hits += 1
                    wedge[b] = min(wedge[b], product)
                    step[b] = max(step[b], math.hypot(pose[0] - x, pose[1] - y))
            contact[b, j - 1] = hits / particles
            variance[b, j] = _pose_spread(poses, 1.0 / k, mean[b, j])


@njit(**COMPILED)
def _pose_spread(poses, angle_weight, mean):
    """Mean pose, written to `mean`, and the sum of the variances of x, y and sqrt(angle_weight) yaw."""
    count, total = poses.shape[0], 0.0
    for column in range(3):
        source = 4 if column == 2 else column
        value = 0.0
        for i in range(count):
            value += poses[i, source]
        value /= count
        mean[column] = value
        square = 0.0
        for i in range(count):
            square += (poses[i, source] - value) ** 2
        total += (angle_weight if column == 2 else 1.0) * square / count
    return total


@njit(**COMPILED)
def simulate_shapes(
    primitives,
    outline,
    rows,
    k,
    friction,
    poses,
    centers,
    path,
    step_variance,
    way_variance,
    rng,
    stride,
    noted,
):
    """Noisy dynamics (6.7) of P particles along one path; as `disc_rollout.simulate_discs`.

    Args:
        primitives: object, shape (Q, 7).
        outline: its visible outline.
        rows: end effectors, shape (E, 6).
        k: 1 / c^2 of the limit surface [1/m^2].
        friction: of each particle, shape (P,).
        poses: (x, y, yaw), shape (P, 3); updated.
        centers: centres of friction, object frame, shape (P, 2).
        path: plane coordinates, shape (K + 1, m).
        step_variance: variance of the perturbation per step in contact [m^2].
        way_variance: and per metre that the object is pushed [m].
        rng: source of randomness.
        stride: every how many steps poses are noted.
        noted: output, shape (R, P, 3).

    Returns:
        smallest product of two contact normals.
    """
    contacts = np.zeros((2 * primitives.shape[0] * rows.shape[0], COLUMNS))
    pose, worst = np.empty(5), 1.0
    noted[0] = poses
    for j in range(1, path.shape[0]):
        for i in range(poses.shape[0]):
            x, y = poses[i, 0], poses[i, 1]
            pose[0], pose[1], pose[4] = x, y, poses[i, 2]
            pose[2], pose[3] = math.cos(poses[i, 2]), math.sin(poses[i, 2])
            touched, product, nx, ny, single = advance(
                primitives, outline, rows, path[j], path[j - 1], pose, k, friction[i],
                centers[i, 0], centers[i, 1], contacts,
            )  # fmt: skip
            worst = min(worst, product)
            if touched and single:
                way = math.hypot(pose[0] - x, pose[1] - y)
                w = math.sqrt(step_variance + way_variance * way) * rng.standard_normal()
                tx, ty = -pose[2] * ny - pose[3] * nx, -pose[3] * ny + pose[2] * nx
                pose[0] += w * tx
                pose[1] += w * ty
                # The end effectors stand: what the perturbation made penetrate is projected out.
                _, product, _, _, _ = advance(
                    primitives, outline, rows, path[j], path[j], pose, k, 0.0, centers[i, 0], centers[i, 1],
                    contacts,
                )  # fmt: skip
                worst = min(worst, product)
            poses[i, 0], poses[i, 1], poses[i, 2] = pose[0], pose[1], pose[4]
        if j % stride == 0 and j // stride < noted.shape[0]:
            noted[j // stride] = poses
    return worst
