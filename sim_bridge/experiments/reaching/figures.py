"""Pictures of arms in their cells: obstacles, the arm at the start, on its way and at the goal, its tip."""

import itertools
import pathlib

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.reaching.cells import ReachTask
from vpsto_ros.collision.arm import ArmCollision
from vpsto_ros.collision.shapes import Box, Capsule, HalfSpace, Shape, Sphere
from vpsto_ros.robot.kinematics import forward_kinematics_batch

_START, _BETWEEN, _GOAL = "#3a7d44", "#8fa3ad", "#0b4f9c"
_POSTURES = ((0.0, _START, 0.9), (0.33, _BETWEEN, 0.35), (0.67, _BETWEEN, 0.35), (1.0, _GOAL, 0.9))
_TIP = "#c1121f"
_OBSTACLE = "#c8803a"
_TABLE = "#e8e0d2"


def draw_solutions(
    folder: pathlib.Path, solutions: list[tuple[str, ReachTask, NDArray[np.float64]]]
) -> pathlib.Path:
    """One panel per solution.

    Args:
        folder: where ``solutions.png`` goes.
        solutions: title, cell and postures along the motion, shape (K, 7) [rad], each.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    columns = min(len(solutions), 3)
    rows = -(-len(solutions) // columns)
    figure = plt.figure(figsize=(5.2 * columns, 5.0 * rows))
    for number, (title, task, postures) in enumerate(solutions):
        axes = figure.add_subplot(rows, columns, number + 1, projection="3d")
        _draw(axes, task, postures)
        axes.set_title(title, fontsize=10)
    figure.tight_layout(rect=(0.0, 0.5 / (5.0 * rows), 1.0, 1.0))
    figure.legend(handles=_explained(), loc="lower center", ncols=5 if columns > 1 else 2, fontsize=11)
    path = folder / "solutions.png"
    figure.savefig(path, dpi=110)
    plt.close(figure)
    return path


def _explained() -> list:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Patch(color=_START, label="arm at the start"),
        Patch(color=_BETWEEN, alpha=0.6, label="after a third and two thirds"),
        Patch(color=_GOAL, label="arm at the goal"),
        Line2D([], [], color=_TIP, lw=2.0, label="path of the tip"),
        Patch(color=_OBSTACLE, alpha=0.6, label="obstacles"),
    ]


def _draw(axes, task: ReachTask, postures: NDArray) -> None:
    for shape in task.obstacles:
        _add(axes, shape, _OBSTACLE, 0.45)
    checker = ArmCollision(None, ())
    for share, colour, opacity in _POSTURES:
        for capsule in checker.capsules(postures[round(share * (len(postures) - 1))]):
            _add(axes, capsule, colour, opacity)
    tip = forward_kinematics_batch(postures)
    axes.plot(*tip.T, color=_TIP, linewidth=2.0, zorder=10)
    axes.set(
        xlim=(-0.9, 0.9), ylim=(-0.9, 0.9), zlim=(0.0, 1.4), xlabel="x [m]", ylabel="y [m]", zlabel="z [m]"
    )
    axes.set_box_aspect((1.8, 1.8, 1.4))
    axes.view_init(elev=28, azim=-55)


def _add(axes, shape: Shape, colour: str, opacity: float) -> None:
    from mpl_toolkits.mplot3d.art3d import Poly3DCollection

    if isinstance(shape, HalfSpace):
        corners = np.array([(-0.9, -0.9, 0.0), (0.9, -0.9, 0.0), (0.9, 0.9, 0.0), (-0.9, 0.9, 0.0)])
        table = Poly3DCollection([corners], facecolor=_TABLE, alpha=0.6)
        table.set_sort_zpos(-5.0)  # else it is drawn over what stands on it
        axes.add_collection3d(table)
    elif isinstance(shape, Box):
        faces = _faces(shape)
        axes.add_collection3d(Poly3DCollection(faces, facecolor=colour, edgecolor="#7a4a1a", linewidth=0.4,
                                               alpha=opacity))  # fmt: skip
    else:
        surface = _surface(shape)
        axes.plot_surface(*surface, color=colour, alpha=opacity, linewidth=0, shade=True)


def _faces(box: Box) -> list[NDArray]:
    faces = []
    for axis, side in itertools.product(range(3), (-1.0, 1.0)):
        others = [i for i in range(3) if i != axis]
        corners = np.zeros((4, 3))
        corners[:, axis] = side
        corners[:, others] = [(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)]
        faces.append(box.centre + (corners * box.half_size) @ box.rotation.T)
    return faces


def _surface(shape: Sphere | Capsule) -> NDArray[np.float64]:
    """Surface points (3, 12, 16) of a capsule, or of a ball."""
    a, b = (shape.centre, shape.centre) if isinstance(shape, Sphere) else (shape.a, shape.b)
    along = b - a
    length = float(np.linalg.norm(along))
    z = along / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    x = np.cross(z, [1.0, 0.0, 0.0] if abs(z[0]) < 0.9 else [0.0, 1.0, 0.0])
    x /= np.linalg.norm(x)
    y = np.cross(z, x)
    polar = np.concatenate([np.linspace(0.0, np.pi / 2, 6), np.linspace(np.pi / 2, np.pi, 6)])
    around = np.linspace(0.0, 2.0 * np.pi, 16)
    height = -shape.radius * np.cos(polar) + np.repeat([0.0, length], 6)
    ring = shape.radius * np.sin(polar)
    circle = np.cos(around)[:, None] * x + np.sin(around)[:, None] * y
    points = a + height[:, None, None] * z + ring[:, None, None] * circle
    return np.moveaxis(points, -1, 0)
