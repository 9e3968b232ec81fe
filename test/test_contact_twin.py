"""The compiled rollout against a slow NumPy twin that shares none of its code."""

import itertools
import math

import numpy as np
import pytest

from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.contact.pushing import PushingModel, rollout

RADIUS = 0.015


def contact_of_rectangle(row, point):
    """Nearest point of a rectangle (cx, cy, hx, hy, angle, 0) to a point outside, and its distance."""
    turn = np.array([[math.cos(row[4]), -math.sin(row[4])], [math.sin(row[4]), math.cos(row[4])]])
    nearest = row[:2] + turn @ np.clip(turn.T @ (point - row[:2]), -row[2:4], row[2:4])
    return nearest, np.linalg.norm(point - nearest)


def least_motion(rows, targets, metric, friction):
    """Twist for the normal and tangential displacements `targets`, by trying every contact mode."""
    inverse = np.diag(1.0 / metric)
    for modes in itertools.product(("open", "stick", 1.0, -1.0), repeat=len(rows)):
        columns, equations, values = [], [], []
        for (normal, tangent), (depth, slip), mode in zip(rows, targets, modes, strict=True):
            if mode == "open":
                continue
            if mode == "stick":
                columns += [normal, tangent]
                equations += [normal, tangent]
                values += [depth, slip]
            else:
                columns.append(normal + mode * friction * tangent)
                equations.append(normal)
                values.append(depth)
        twist = np.zeros(3)
        forces = np.zeros(0)
        if columns:
            jacobian, wrench = np.array(equations), np.array(columns)
            forces = np.linalg.lstsq(jacobian @ inverse @ wrench.T, values, rcond=None)[0]
            twist = inverse @ wrench.T @ forces
        if consistent(rows, targets, modes, twist, forces, friction):
            return twist
    raise AssertionError("no contact mode is consistent")


def consistent(rows, targets, modes, twist, forces, friction):
    eps = 1e-9
    forces = list(forces)
    for (normal, tangent), (depth, slip), mode in zip(rows, targets, modes, strict=True):
        if normal @ twist < depth - eps:
            return False
        if mode == "open":
            continue
        pressing = forces.pop(0)
        if pressing < -eps:
            return False
        if mode == "stick":
            if abs(forces.pop(0)) > friction * pressing + eps or abs(tangent @ twist - slip) > eps:
                return False
        elif mode * (slip - tangent @ twist) < -eps:
            return False
    return True


def rollout_numpy(model, start, path, step):
    """First-order rollout of a disc tool with tiny steps; forces from the exhaustive search above."""
    x = np.array(start, dtype=float)
    metric = np.array([1.0, 1.0, model.pressure_radius**2])
    poses = [x.copy()]
    for begin, end in itertools.pairwise(path):
        count = math.ceil(np.linalg.norm(end - begin) / step)
        move = (end - begin) / count
        for i in range(count):
            tool = begin + (i + 1) * move
            turn = np.array([[math.cos(x[2]), -math.sin(x[2])], [math.sin(x[2]), math.cos(x[2])]])
            rows, targets = [], []
            for row in model.shape.as_array():
                nearest, distance = contact_of_rectangle(row, turn.T @ (tool - x[:2]))
                if distance < RADIUS:
                    n = (turn.T @ (tool - x[:2]) - nearest) / distance
                    t = np.array([-n[1], n[0]])
                    arm = nearest - np.array(model.center_of_friction)
                    cross = np.array([arm[0] * n[1] - arm[1] * n[0], arm[0] * t[1] - arm[1] * t[0]])
                    rows.append((-np.append(n, cross[0]), np.append(t, cross[1])))
                    targets.append((RADIUS - distance, t @ turn.T @ move))
            if rows:
                twist = least_motion(rows, targets, metric, model.friction)
                center = np.array(model.center_of_friction)
                moved = x[:2] + turn @ (center + twist[:2])
                x[2] += twist[2]
                turn = np.array([[math.cos(x[2]), -math.sin(x[2])], [math.sin(x[2]), math.cos(x[2])]])
                x[:2] = moved - turn @ center
        poses.append(x.copy())
    return np.array(poses)


@pytest.mark.parametrize("friction", [0.0, 0.15, 0.8])
@pytest.mark.parametrize("name", ["box", "tee"])
def test_compiled_rollouts_agree_with_the_twin(name, friction):
    shape = PlanarShape.box(0.12, 0.08) if name == "box" else PlanarShape.tee()
    model = PushingModel(
        shape, PlanarShape.disc(RADIUS), friction=friction, center_of_friction=(0.005, 0.004)
    )
    begin = [[-0.09, 0.0], [0.1, 0.0], [-0.05, -0.09]]
    end = [[0.02, 0.035], [0.01, 0.055], [0.02, 0.0]]
    for a, b in zip(begin, end, strict=True):
        path = np.linspace(a, b, 12) + np.outer(np.sin(np.linspace(0, 3, 12)), [0.0, 0.01])
        twin = rollout_numpy(model, [0.0, 0.0, 0.05], path, 1e-4)
        ours = rollout(model, [0.0, 0.0, 0.05], path, max_step=0.0005).object_pose[0]
        assert np.abs(twin[-1] - twin[0]).max() > 0.02
        np.testing.assert_allclose(ours[:, :2], twin[:, :2], atol=2e-4)
        np.testing.assert_allclose(ours[:, 2], twin[:, 2], atol=3e-3)
        coarse = rollout(model, [0.0, 0.0, 0.05], path).object_pose[0]
        np.testing.assert_allclose(coarse[:, :2], twin[:, :2], atol=3e-3)
        np.testing.assert_allclose(coarse[:, 2], twin[:, 2], atol=4e-2)
