"""Straight pushes: where to touch an object, in which direction and how far, ranked by simulated outcome.

A straight push is the simplest plan that makes contact. Simulating a few hundred of them with the contact
model tells where touching
pays; the contact planner turns that into a Gaussian, the pushing planner into first guesses ("go round,
touch, push").
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.contact.pushing import PushingModel, rollout
from vpsto_ros.planning.goal import PlanarGoal, wrap_angle

CLEARANCE = 0.004
"""Gap between tool and object where a push begins [m]."""

IDLE_COST = 100.0
"""What ranks pushes that gain nothing behind all others [s]."""


@dataclasses.dataclass(frozen=True)
class StraightPushes:
    """S straight pushes, best first, in the base frame.

    Attributes:
        touch: tool centres at the beginning of the pushes, shape (S, 2) [m].
        end: tool centres at their ends, shape (S, 2) [m].
        error: goal error after the push, shape (S,) [m].
        cost: time to get there and to push plus the weighted error, shape (S,) [s].
    """

    touch: NDArray
    end: NDArray
    error: NDArray
    cost: NDArray

    def __len__(self) -> int:
        return len(self.cost)

    def diverse(self, count: int, separation: float) -> "StraightPushes":
        """The best pushes whose touch points are at least `separation` [m] apart, at most `count` of them."""
        chosen: list[int] = []
        for index in range(len(self)):
            gaps = (
                np.linalg.norm(self.touch[chosen] - self.touch[index], axis=1)
                if chosen
                else np.array([np.inf])
            )
            if gaps.min() >= separation:
                chosen.append(index)
            if len(chosen) == count:
                break
        return self.take(np.array(chosen, dtype=int))

    def take(self, index: NDArray) -> "StraightPushes":
        """The pushes of the given indices."""
        return StraightPushes(self.touch[index], self.end[index], self.error[index], self.cost[index])


def to_world(pose: NDArray, points: NDArray) -> NDArray:
    """Points of the object frame, shape (..., 2), in the base frame of an object at pose (x, y, yaw)."""
    return pose[:2] + rotate(points, pose[2])


def rotate(vectors: NDArray, angle: NDArray | float) -> NDArray:
    """Vectors (..., 2) turned by an angle [rad] that broadcasts over their leading axes."""
    c, s = np.cos(angle), np.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    return np.stack([c * x - s * y, s * x + c * y], axis=-1)


def around(start: NDArray, touch: NDArray, center: NDArray, radius: float, count: int) -> NDArray:
    """Points on a way from the tool's position to touch points that leads round the object.

    Args:
        start: tool position, shape (2,) [m].
        touch: destinations, shape (S, 2) [m].
        center: centre of the object, shape (2,) [m].
        radius: distance from the centre at which the tool passes freely [m].
        count: number of points between start and touch, both excluded.

    Returns:
        Shape (S, count, 2) [m].
    """
    a, b = start - center, touch - center
    rho_a, rho_b = np.hypot(*a), np.hypot(b[:, 0], b[:, 1])
    turn = np.asarray(wrap_angle(np.arctan2(b[:, 1], b[:, 0]) - np.arctan2(a[1], a[0])))
    u = np.arange(1, count + 1) / (count + 1)
    straight = start + u[None, :, None] * (touch - start)[:, None, :]
    rho = np.maximum((1 - u) * rho_a + u * rho_b[:, None], radius)
    angle = np.arctan2(a[1], a[0]) + u * turn[:, None]
    arc = center + rho[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    return np.where((np.abs(turn) > 0.7)[:, None, None], arc, straight)


def way_length(start: NDArray, touch: NDArray, center: NDArray, radius: float) -> NDArray:
    """Length of the way of :func:`around`, shape (S,) [m]."""
    way = np.concatenate(
        [np.broadcast_to(start, (len(touch), 1, 2)), around(start, touch, center, radius, 6), touch[:, None]],
        1,
    )
    return np.linalg.norm(np.diff(way, axis=1), axis=2).sum(axis=1)


@dataclasses.dataclass(frozen=True)
class PushRanking:
    """What makes one straight push better than another.

    Attributes:
        speed: speed of the tool [m/s].
        error_cost: seconds that one metre of remaining error is worth [s/m].
        rotation_cost: seconds that one radian of rotation is worth when the goal has no orientation [s/rad].
        contacts: number of touch points along the outline.
        slants: directions relative to the inward normal [rad].
    """

    speed: float = 0.3
    error_cost: float = 60.0
    rotation_cost: float = 0.5
    contacts: int = 40
    slants: tuple[float, ...] = (0.0, -0.35, 0.35)

    def rank(self, model: PushingModel, pose: NDArray, goal: PlanarGoal, tool: NDArray) -> StraightPushes:
        """Simulate straight pushes all along the outline and sort them by cost.

        Args:
            model: contact model with the object's shape and the tool.
            pose: object pose (x, y, yaw) [m, m, rad].
            goal: where the object shall go.
            tool: present tool position, shape (2,) [m].
        """
        touch, direction = self._starts(model, pose)
        error = float(goal.error(pose, model.pressure_radius))
        reach = 1.2 * error + 0.02
        steps = int(np.clip(np.ceil(reach / np.clip(0.25 * error, 0.001, 0.006)), 8, 60))
        lengths = CLEARANCE * (1.0 - 1e-3) + np.linspace(0.0, reach, steps)
        path = touch[:, None, :] + lengths[None, :, None] * direction[:, None, :]
        poses = rollout(model, pose, path, max_step=0.006).object_pose
        errors = goal.error(poses, model.pressure_radius)
        radius = model.shape.bounding_radius + model.tool.bounding_radius + 0.01
        travel = way_length(tool, touch, pose[:2], radius)
        costs = self.error_cost * errors + (travel[:, None] + lengths) / self.speed
        if goal.yaw is None:
            costs = costs + self.rotation_cost * np.abs(poses[..., 2] - pose[2])
        # A push that gains nothing is no plan, however little the remaining error costs compared
        # with going round the object.
        idle = errors > error - max(0.1 * error, 0.0005)
        costs = np.where(idle, costs + IDLE_COST, costs)
        last = costs.argmin(axis=1)
        rows = np.arange(len(touch))
        pushes = StraightPushes(touch, path[rows, last], errors[rows, last], costs[rows, last])
        return pushes.take(np.argsort(pushes.cost, kind="stable"))

    def _starts(self, model: PushingModel, pose: NDArray) -> tuple[NDArray, NDArray]:
        points, normals = model.shape.boundary(self.contacts)
        gap = model.tool.bounding_radius + CLEARANCE
        centers = points + gap * normals
        free = model.shape.signed_distance(centers) > gap - 2e-3
        touch = to_world(pose, centers[free])
        inward = rotate(-normals[free], pose[2])
        directions = np.concatenate([rotate(inward, slant) for slant in self.slants])
        return np.tile(touch, (len(self.slants), 1)), directions
