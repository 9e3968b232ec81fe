"""Markers that make a run legible in RViz or Foxglove without a robot description or transforms."""

from collections.abc import Sequence

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from std_msgs.msg import ColorRGBA
from visualization_msgs.msg import Marker

from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.robot.kinematics import (
    ELBOW_OFFSET,
    FLANGE_OFFSET,
    FOREARM,
    SHOULDER_HEIGHT,
    TOOL_LENGTH,
    UPPER_ARM,
    WRIST_OFFSET,
)
from vpsto_ros.robot.tip_kinematics import BALL_BASES
from vpsto_ros.robot.tool_plane import ToolPlane

ROBOT = (0.85, 0.87, 0.9, 1.0)
OBJECT = (0.93, 0.58, 0.16, 1.0)
ESTIMATE = (0.95, 0.8, 0.2, 1.0)
GOAL = (0.16, 0.66, 0.36, 1.0)
PLAN = (0.15, 0.4, 0.9, 1.0)
CONTACT = (0.1, 0.7, 0.75, 1.0)
PREDICTION = (0.75, 0.3, 0.7, 1.0)
_RING = np.linspace(0.0, 2.0 * np.pi, 25)

# Along the arm, from one joint to the next: rotation about x [rad], then the offset (along x before it) [m].
_HALF = 0.5 * np.pi
_ARM = (
    (0.0, (0.0, 0.0, SHOULDER_HEIGHT)),
    (-_HALF, (0.0, 0.0, 0.0)),
    (_HALF, (0.0, 0.0, UPPER_ARM)),
    (_HALF, (ELBOW_OFFSET, 0.0, 0.0)),
    (-_HALF, (-ELBOW_OFFSET, 0.0, FOREARM)),
    (_HALF, (0.0, 0.0, 0.0)),
    (_HALF, (WRIST_OFFSET, 0.0, 0.0)),
)


def arm_points(q: NDArray) -> NDArray[np.float64]:
    """The arm as a polyline: base, joints, flange and tip of the tool (10, 3) [m], for q (7,) [rad]."""
    points, position, rotation = [np.zeros(3)], np.zeros(3), np.eye(3)
    for angle, (twist, offset) in zip(q, _ARM, strict=True):
        position = position + rotation @ (np.array([offset[0], 0.0, 0.0]) + _about_x(twist)[:, 2] * offset[2])
        rotation = rotation @ _about_x(twist) @ _about_z(angle)
        points.append(position)
    points += [position + rotation[:, 2] * along for along in (FLANGE_OFFSET, FLANGE_OFFSET + TOOL_LENGTH)]
    return np.array(points)


def arm_bases(tools: ToolPlane) -> NDArray[np.float64]:
    """Where the arms of a robot stand, shape (arms, 3) [m]."""
    return BALL_BASES if tools.robot.dof == 14 else np.zeros((1, 3))


def arm_lines(tools: ToolPlane, q: NDArray) -> list[NDArray[np.float64]]:
    """Each arm of a robot as a polyline (P, 3) [m], from its base by a crank, if it has one, to the tip."""
    tips, lines = tools.tips(q), []
    for base, joints, tip in zip(arm_bases(tools), np.split(np.asarray(q), len(tips)), tips, strict=True):
        points = base + arm_points(joints)
        flange, axis = points[-2], (points[-1] - points[-2]) / TOOL_LENGTH
        corner = tip - axis * (axis @ (tip - flange))
        lines.append(np.vstack([points[:-1], corner, tip]))
    return lines


class MarkerFactory:
    """Makes markers of one node: same frame, same stamp, numbered by their names."""

    def __init__(self, frame: str, stamp: Time, level: float = 0.0) -> None:
        """Begin.

        Args:
            frame: of all markers.
            stamp: of all markers.
            level: height of the table, on which planar points are drawn [m].
        """
        self.frame, self.stamp, self.level = frame, stamp, level

    def line(self, name: str, points: NDArray, colour: Sequence[float], width: float = 0.004) -> Marker:
        """A polyline through points (K, 2) on the table or (K, 3) [m]; fewer than two make it vanish."""
        marker = self._marker(name, Marker.LINE_STRIP, colour)
        marker.scale.x = width
        marker.points = self._points(points)
        if len(points) < 2:
            marker.action = Marker.DELETE
        return marker

    def robot(self, tools: ToolPlane, q: NDArray) -> list[Marker]:
        """The arms of a robot at joint positions (n,) [rad]: "robot", "robot_1" ..."""
        lines = enumerate(arm_lines(tools, q))
        return [self.line(f"robot_{i}" if i else "robot", points, ROBOT, 0.03) for i, points in lines]

    def paths(self, name: str, coordinates: NDArray, colour: Sequence[float]) -> Marker:
        """Paths of all tools on the table, given their plane coordinates (K, m)."""
        pieces = [np.stack([path[:-1], path[1:]], axis=1) for path in tool_paths(coordinates)]
        return self.segments(name, np.concatenate(pieces).reshape(-1, 2), colour)

    def ellipses(
        self, name: str, centers: NDArray, covariances: NDArray, colour: Sequence[float]
    ) -> Marker:
        """The ellipses of one standard deviation of Gaussians on the table, (E, 2) and (E, 2, 2) [m, m^2]."""
        circle = np.stack([np.cos(_RING), np.sin(_RING)], axis=1)
        rings = [
            center + circle @ np.linalg.cholesky(covariance + 1e-12 * np.eye(2)).T
            for center, covariance in zip(centers, covariances, strict=True)
        ]
        pieces = [np.stack([ring[:-1], ring[1:]], axis=1).reshape(-1, 2) for ring in rings]
        return self.segments(name, np.concatenate([np.zeros((0, 2)), *pieces]), colour)

    def circles(self, name: str, centers: NDArray, radii: NDArray, colour: Sequence[float]) -> Marker:
        """Circles on the table, (E, 2) and (E,) [m]."""
        covariances = np.square(radii)[:, None, None] * np.eye(2)
        return self.ellipses(name, centers[: len(radii)], covariances, colour)

    def shape(
        self,
        name: str,
        shape: PlanarShape,
        pose: NDArray | None,
        colour: Sequence[float],
        height: float = 0.002,
    ) -> Marker:
        """The outlines of a shape's parts at pose (x, y, yaw), height [m] above the table; None hides it."""
        marker = self._marker(name, Marker.LINE_LIST, colour)
        marker.scale.x = 0.004
        if pose is None:
            marker.action = Marker.DELETE
            return marker
        for polygon in shape.transform(np.asarray(pose, dtype=float)):
            ring = np.column_stack([polygon, np.full(len(polygon), self.level + height)])
            segments = np.stack([ring, np.roll(ring, -1, axis=0)], axis=1).reshape(-1, 3)
            marker.points.extend(self._points(segments))
        return marker

    def spheres(self, name: str, points: NDArray, colour: Sequence[float], diameter: float = 0.006) -> Marker:
        """Small spheres at points (K, 2) on the table or (K, 3) [m]."""
        marker = self._marker(name, Marker.SPHERE_LIST, colour)
        marker.scale.x = marker.scale.y = marker.scale.z = diameter
        marker.points = self._points(points)
        if not len(points):
            marker.action = Marker.DELETE
        return marker

    def text(self, name: str, text: str, position: Sequence[float], size: float = 0.03) -> Marker:
        """A line of text at a position [m]."""
        marker = self._marker(name, Marker.TEXT_VIEW_FACING, (1.0, 1.0, 1.0, 1.0))
        marker.pose.position.x, marker.pose.position.y, marker.pose.position.z = map(float, position)
        marker.scale.z = size
        marker.text = text
        return marker

    def segments(self, name: str, ends: NDArray, colour: Sequence[float]) -> Marker:
        """Segments between each two ends, shape (2 S, 2) on the table [m]; without any it vanishes."""
        marker = self._marker(name, Marker.LINE_LIST, colour)
        marker.scale.x = 0.003
        marker.points = self._points(ends)
        if not len(ends):
            marker.action = Marker.DELETE
        return marker

    def _points(self, points: NDArray) -> list[Point]:
        rows = np.asarray(points, dtype=float)
        if rows.shape[1] == 2:
            rows = np.column_stack([rows, np.full(len(rows), self.level + 0.003)])
        return [Point(x=x, y=y, z=z) for x, y, z in rows.tolist()]

    def _marker(self, name: str, kind: int, colour: Sequence[float]) -> Marker:
        marker = Marker(ns=name, type=kind, action=Marker.ADD)
        marker.header.frame_id, marker.header.stamp = self.frame, self.stamp
        marker.color = ColorRGBA(**dict(zip("rgba", map(float, colour), strict=True)))
        marker.pose.orientation.w = 1.0
        return marker


def tool_paths(coordinates: NDArray) -> list[NDArray]:
    """Paths (K, 2) of the tools in their plane coordinates (K, m): one for 2 or 3 columns, two for 4."""
    count = coordinates.shape[1] // 2
    return [coordinates[:, 2 * tool : 2 * tool + 2] for tool in range(count)]


def _about_x(angle: float) -> NDArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])


def _about_z(angle: float) -> NDArray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
