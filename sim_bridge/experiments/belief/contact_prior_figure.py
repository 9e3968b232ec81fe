"""The figure of candidates with and without the contact prior, coloured by speed."""

import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

SHOWN = 30
SAMPLES = 60
ELLIPSE_STDS = 2.0


def speed_lines(axes: Any, path: NDArray, speed: NDArray, norm: Any, **style: Any) -> Any:
    """A path (K, 2) [m] coloured by speed (K,) [m/s]."""
    from matplotlib.collections import LineCollection

    pieces = np.stack([path[:-1], path[1:]], axis=1)
    lines = LineCollection(list(pieces), cmap="viridis", norm=norm, **style)
    lines.set_array(0.5 * (speed[1:] + speed[:-1]))
    return axes.add_collection(lines)


def write(path: pathlib.Path, seed: int) -> None:
    """Draw candidates of one random scene into a PNG file.

    Args:
        path: of the file.
        seed: of the scene.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.colors import Normalize

    from sim_bridge.experiments.belief.contact_prior import PRIORS, SPACES, Scene, pose_problem

    scene = Scene.random(np.random.default_rng([seed, 0]))
    figure, grid = plt.subplots(2, 2, figsize=(11.5, 11.5), layout="constrained", sharex=True, sharey=True)
    figure.suptitle(f"{SHOWN} candidates for two balls that shall push a disc (Figs. 6.6 and 6.7)")
    norm = Normalize(0.0, 0.17)
    lines: Any = None
    for row, space in zip(grid, SPACES, strict=True):
        for axes, prior in zip(row, PRIORS, strict=True):
            rng = np.random.default_rng([seed, 9])
            problem = pose_problem(scene, space, prior, rng)
            lines = _candidates(axes, problem, rng, norm)
            _surroundings(axes, problem, prior == "with")
            axes.set(title=f"{SPACES[space]}: {PRIORS[prior]}", aspect="equal")
            axes.set(xlim=(0.28, 0.62), ylim=(-0.17, 0.17))
    for axes in grid[1]:
        axes.set_xlabel("x [m]")
    for axes in grid[:, 0]:
        axes.set_ylabel("y [m]")
    figure.colorbar(lines, ax=grid, label="speed of a ball [m/s]", shrink=0.6)
    handles, labels = grid[0, 1].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=3)
    figure.savefig(path, dpi=100)
    plt.close(figure)


def _candidates(axes: Any, problem: Any, rng: np.random.Generator, norm: Any) -> Any:
    lines = None
    for points in problem.prior().sample(rng, SHOWN):
        motion = problem.trajectory(points)
        times = np.linspace(0.0, motion.duration, SAMPLES)
        plane = problem.space.plane(motion(times)[None])[0][0].reshape(SAMPLES, -1, 2)
        for ball in range(plane.shape[1]):
            speed = np.linalg.norm(np.gradient(plane[:, ball], times, axis=0), axis=1)
            lines = speed_lines(axes, plane[:, ball], speed, norm, lw=1.1, alpha=0.8)
            axes.plot(*plane[-1, ball], "k.", ms=4)
    return lines


def _surroundings(axes: Any, problem: Any, informed: bool) -> None:
    from matplotlib.patches import Circle, Ellipse

    from sim_bridge.experiments.belief.bimanual import RADIUS
    from vpsto_ros.robot.tip_kinematics import BALL_RADIUS

    belief = problem.belief
    for x, y, _ in belief.poses:
        axes.add_patch(Circle((x, y), RADIUS, fill=False, color="tab:orange", alpha=0.35, lw=0.8))
    axes.plot(*belief.poses[:, :2].T, ".", color="tab:orange", ms=4, label="particles")
    balls = problem.present.reshape(-1, 2)
    for index, (x, y) in enumerate(balls):
        label = "balls now" if index == 0 else None
        axes.add_patch(Circle((x, y), BALL_RADIUS, color="0.75", zorder=0, label=label))
    axes.plot([], [], "k.", label="where a ball ends")
    way = problem.way[-1, :2] - belief.mean[:2]
    arrow = {"arrowstyle": "->", "color": "tab:red", "lw": 1.6}
    axes.annotate("", belief.mean[:2] + way, belief.mean[:2], arrowprops=arrow)
    axes.plot([], [], color="tab:red", label="where the disc shall go")
    if not informed:
        return
    mean, covariance = problem.contact
    for ball in range(len(balls)):
        part = slice(2 * ball, 2 * ball + 2)
        values, vectors = np.linalg.eigh(covariance[part, part])
        width, height = 2.0 * ELLIPSE_STDS * np.sqrt(values)
        angle = float(np.degrees(np.arctan2(vectors[1, 0], vectors[0, 0])))
        label = f"contact prior, {ELLIPSE_STDS:g} standard deviations" if ball == 0 else None
        style = {"fill": False, "color": "tab:purple", "lw": 1.6, "label": label}
        axes.add_patch(Ellipse(mean[part], width, height, angle=angle, **style))
