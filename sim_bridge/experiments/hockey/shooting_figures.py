"""The figures of the shooting experiment: chances of single shots, plans, and what was shot."""

import pathlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.hockey.shooting_players import OBJECTIVES, PLAYERS, puck_model, strike_table
from sim_bridge.experiments.hockey.shooting_summary import reliability
from sim_bridge.experiments.hockey.shooting_trials import ShotResult
from sim_bridge.hockey.recordings import TABLE
from vpsto_ros.contact.puck import PuckModel
from vpsto_ros.planning.hockey.shooting_config import SETTINGS, ShootingConfig, Shot
from vpsto_ros.planning.hockey.shooting_search import ShotSearch

PUCK = np.array([-0.45, 0.1, 0.0, 0.0])
"""At rest, from where single shots are looked at, table frame."""
SHOTS = (("a) direct, 1.2 m/s", 0, 1.2), ("b) direct, 2 m/s", 0, 2.0), ("c) one bank, 1.2 m/s", 1, 1.2))
"""Title, banks and speed of the mallet [m/s], as in Fig. 5.4."""
DRAWN, ROLLOUTS = 60, 2000
_STEPS = 150
_GRID_X, _GRID_Y = np.linspace(-0.65, -0.25, 6), np.linspace(-0.35, 0.35, 8)
_STILL = 1e-8 * np.eye(4)  # of a puck at rest that is well known


def write(folder: pathlib.Path, found: Sequence[ShotResult]) -> None:
    """Draw shooting_chances.png, shooting_plans.png and shooting.png into a folder.

    Args:
        folder: that exists.
        found: what was shot.
    """
    import matplotlib

    matplotlib.use("Agg")
    write_chances(folder / "shooting_chances.png")
    write_plans(folder / "shooting_plans.png")
    write_shots(folder / "shooting.png", found)


def write_chances(path: pathlib.Path) -> None:
    """Fig. 5.4: rollouts of shots whose expected way ends in the middle of the goal, and their chance."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(SHOTS), figsize=(15, 3.6), layout="constrained", sharey=True)
    model = puck_model()
    for axes, (title, banks, speed) in zip(panels, SHOTS, strict=True):
        mallet = aimed(model, banks, speed)
        chance = float(model.shots(PUCK, _STILL, mallet[None]).goal[0])
        ways = rollouts(model, mallet)
        inside = np.array([scores(way) for way in ways])
        _draw_table(axes)
        for way, good in zip(ways[:DRAWN], inside, strict=False):
            axes.plot(*way[:, :2].T, color="tab:blue" if good else "tab:red", lw=0.5, alpha=0.5)
        _disc(axes, PUCK[:2], TABLE.puck_radius, "tab:red")
        _disc(axes, mallet[:2], TABLE.mallet_radius, "tab:blue")
        goals = f"goals in {100 * inside.mean():.0f} % of {ROLLOUTS} rollouts"
        axes.set_title(f"{title}\nchance {chance:.2f}, {goals}")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def aimed(model: PuckModel, banks: int, speed: float) -> NDArray[np.float64]:
    """State (4,) of the mallet whose shot at the resting puck is expected nearest the middle of the goal."""
    angles = np.radians(np.linspace(-70.0, 70.0, 4001))
    normals = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    mallets = np.hstack([PUCK[:2] - model.table.contact_distance * normals, speed * normals])
    outlook = model.shots(PUCK, _STILL, mallets)
    off = np.where((outlook.banks == banks) & (outlook.goal > 0.0), np.abs(outlook.offset[:, 0]), np.inf)
    best: NDArray[np.float64] = mallets[int(np.nanargmin(off))]
    return best


def rollouts(model: PuckModel, mallet: NDArray, seed: int = 0) -> list[NDArray[np.float64]]:
    """Sampled ways (K, 4) of the puck from the touch to the goal line or as long as is looked at."""
    rng = np.random.default_rng(seed)
    mean, covariance = model.hit(PUCK[None], mallet[None])
    states = rng.multivariate_normal(mean[0], covariance[0], ROLLOUTS)
    ways = model.simulate(states, _STEPS, rng)
    beyond = np.abs(ways[:, :, 0]) > TABLE.reach[0]
    ends = np.where(beyond.any(axis=1), beyond.argmax(axis=1) + 1, ways.shape[1])
    return [way[:end] for way, end in zip(ways, ends, strict=True)]


def scores(way: NDArray) -> bool:
    """Whether a way (K, 4) ends beyond the far goal line."""
    return bool(way[-1, 0] > TABLE.reach[0])


def write_plans(path: pathlib.Path) -> None:
    """Fig. 5.5: direction and speed of the mallet for pucks at rest, for each setting."""
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(1, len(SETTINGS), figsize=(15, 4.6), layout="constrained", sharey=True)
    for axes, name in zip(panels, SETTINGS, strict=True):
        arrows = axes.quiver(*_arrows(plans(name)), cmap="viridis", angles="xy", pivot="tip", scale=16)
        arrows.set_clim(0.5, 3.0)
        axes.axhline(TABLE.half_width, color="0.4")
        axes.axhline(-TABLE.half_width, color="0.4")
        axes.set(title=name, xlabel="x [m]", aspect="equal", xlim=(-0.85, -0.1), ylim=(-0.56, 0.56))
    panels[0].set_ylabel("y [m]")
    figure.colorbar(arrows, ax=panels, label="mallet [m/s]")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def plans(name: str) -> list[Shot]:
    """The shots of a setting at resting pucks on a grid, where it takes one."""
    search = ShotSearch(puck_model(), strike_table(), ShootingConfig(objective=SETTINGS[name]))
    places = [np.array([x, y, 0.0, 0.0]) for x in _GRID_X for y in _GRID_Y]
    found = [search.best(0.0, place, _STILL) for place in places]
    return [shot for shot in found if shot is not None and search.taken(shot)]


def _arrows(shots: Sequence[Shot]) -> tuple[NDArray[np.float64], ...]:
    """Places x and y, components and speeds of some shots."""
    rows = np.array([[*shot.puck[:2], *shot.mallet[2:], shot.speed] for shot in shots])
    return tuple(rows.T)


def write_shots(path: pathlib.Path, found: Sequence[ShotResult]) -> None:
    """True ways of all pucks after the touch, or from the start if there was none; and how chances held."""
    import matplotlib.pyplot as plt

    names = [name for name in PLAYERS if any(shot.task.name == name for shot in found)]
    columns = min(len(names) + 1, 4)
    rows = -(-(len(names) + 1) // columns)
    size = 4.6 * columns, 2.9 * rows
    figure, panels = plt.subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for axes in panels.ravel()[len(names) + 1 :]:
        axes.axis("off")
    for axes, name in zip(panels.ravel(), names, strict=False):
        _draw_ways(axes, name, [shot for shot in found if shot.task.name == name])
    chosen = [shot for shot in found if shot.task.name in OBJECTIVES]
    _draw_reliability(panels.ravel()[len(names)], reliability(chosen))
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _draw_ways(axes: Any, name: str, chosen: Sequence[ShotResult]) -> None:
    _draw_table(axes)
    for shot in sorted(chosen, key=lambda shot: not shot.scored):
        way = shot.path[shot.touched :] if shot.touched < len(shot.path) else shot.path
        axes.plot(*way[:, :2].T, color="tab:blue" if shot.scored else "tab:red", lw=0.6, alpha=0.6)
    axes.set_title(f"{name}: {sum(shot.scored for shot in chosen)} of {len(chosen)} score")


def _draw_reliability(axes: Any, rows: Sequence[dict[str, Any]]) -> None:
    """Shares of goals among shots of about the same chance, with intervals."""
    for row in rows:
        axes.plot([row["predicted"]] * 2, row["interval"], color="tab:blue", lw=1)
        axes.plot(row["predicted"], row["observed"], "o", color="tab:blue", ms=4)
    axes.plot([0, 1], [0, 1], "k--", lw=0.8)
    axes.set(xlabel="predicted chance", ylabel="share of goals", xlim=(0.45, 1.02), ylim=(-0.02, 1.02))
    axes.set_title("all settings of the agent")
    axes.grid(alpha=0.3)


def _draw_table(axes: Any) -> None:
    from matplotlib.patches import Rectangle

    x, y, goal = TABLE.half_length, TABLE.half_width, 0.5 * TABLE.goal_width
    axes.add_patch(Rectangle((-x, -y), 2 * x, 2 * y, fill=False, color="0.4"))
    for end in (-x, x):
        axes.plot([end, end], [-goal, goal], color="tab:green", lw=4)
    axes.set(aspect="equal", xlim=(-x - 0.05, x + 0.12), ylim=(-y - 0.05, y + 0.05))


def _disc(axes: Any, place: NDArray, radius: float, colour: str) -> None:
    from matplotlib.patches import Circle

    axes.add_patch(Circle((float(place[0]), float(place[1])), radius, color=colour, zorder=3))
