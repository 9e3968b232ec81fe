"""Where particles are to the end effectors: gaps, normals and how fast these approach, compiled."""

import dataclasses
import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.contact.multi_tool import COLUMNS, _tool_pose
from vpsto_ros.contact.narrow_phase import COMPILED, GAP, NX, NY, PX, PY, tool_contacts


@dataclasses.dataclass(frozen=True)
class ParticleContacts:
    """How P particles are to E end effectors.

    Attributes:
        gaps: signed distances, shape (P, E) [m].
        normals: unit vectors along which the end effectors would push, shape (P, E, 2).
        approach: speed of the end effectors' surface along the normals, shape (P, E) [m/s].
    """

    gaps: NDArray[np.float64]
    normals: NDArray[np.float64]
    approach: NDArray[np.float64]


def particle_contacts(
    dynamics: BeliefDynamics, poses: NDArray, point: NDArray, velocity: NDArray
) -> ParticleContacts:
    """Contacts of objects at these poses, each with its nearest point.

    Args:
        dynamics: shape of the object and end effectors.
        poses: (x, y, yaw), shape (P, 3).
        point: plane coordinates, shape (m,).
        velocity: their rates, shape (m,).
    """
    rows = dynamics.effectors.rows
    shape = len(poses), len(rows)
    contacts = ParticleContacts(np.empty(shape), np.empty((*shape, 2)), np.empty(shape))
    _contacts_of(
        dynamics.shape.kernel_rows, dynamics.shape.outline_segments, rows,
        np.ascontiguousarray(poses), np.ascontiguousarray(point), np.ascontiguousarray(velocity),
        contacts.gaps, contacts.normals, contacts.approach,
    )  # fmt: skip
    return contacts


@njit(**COMPILED)
def _contacts_of(primitives, outline, rows, poses, point, velocity, gaps, normals, approach):
    contacts = np.zeros((2 * primitives.shape[0] + 2, COLUMNS))
    for i in range(poses.shape[0]):
        c, s = math.cos(poses[i, 2]), math.sin(poses[i, 2])
        for e in range(rows.shape[0]):
            tx, ty, tc, ts = _tool_pose(rows, point, point, 1.0, e)
            dx, dy = tx - poses[i, 0], ty - poses[i, 1]
            count, gap = tool_contacts(
                primitives, outline, c * dx + s * dy, c * dy - s * dx, c * tc + s * ts, c * ts - s * tc,
                rows[e, 0], rows[e, 1], rows[e, 2], np.inf, contacts,
            )  # fmt: skip
            nearest, nx, ny, px, py = np.inf, 0.0, 0.0, 0.0, 0.0
            for j in range(count):
                if contacts[j, GAP] < nearest:
                    nearest, nx, ny = contacts[j, GAP], contacts[j, NX], contacts[j, NY]
                    px, py = contacts[j, PX], contacts[j, PY]
            gaps[i, e] = gap
            # Contact normals point out of the object, in its frame.
            normals[i, e, 0], normals[i, e, 1] = s * ny - c * nx, -s * nx - c * ny
            column = int(rows[e, 4])
            vx, vy = velocity[column], velocity[column + 1]
            if rows[e, 5] > 0.0:
                ax, ay = c * px - s * py - dx, s * px + c * py - dy
                vx, vy = vx - velocity[column + 2] * ay, vy + velocity[column + 2] * ax
            approach[i, e] = vx * normals[i, e, 0] + vy * normals[i, e, 1]
