"""The figure of the shooting policies: what they choose for resting pucks, and how inference finds it."""

import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.hockey.recordings import TABLE
from sim_bridge.learn.shooting_comparison import STEPS
from vpsto_ros.planning.hockey.shooting_config import SETTINGS
from vpsto_ros.planning.hockey.shooting_policy import PolicySamples, ShootingPolicy
from vpsto_ros.planning.hockey.shooting_search import ShotSearch

SHOWN = (1, 12, STEPS)
"""Steps of Algorithm 2."""
EXAMPLE = np.array([-0.5, -0.2, 0.0, 0.0])
"""The puck whose landscape is shown."""
_PLACES = [(x, y) for x in (-0.6, -0.5, -0.4, -0.3) for y in (-0.3, -0.2, -0.1, 0.0, 0.1, 0.2, 0.3)]


def write(
    path: pathlib.Path, searches: dict[str, ShotSearch], policies: dict[str, ShootingPolicy]
) -> None:
    """Draw into a PNG file.

    Args:
        path: of the file.
        searches: what the arm can do, by setting.
        policies: by setting.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        len(policies), 1 + len(SHOWN), figsize=(15, 3.3 * len(policies)), layout="constrained",
        width_ratios=[2.2, *[1.0] * len(SHOWN)], squeeze=False,
    )  # fmt: skip
    shots = None
    for row, (setting, policy) in zip(panels, policies.items(), strict=True):
        shots = _shots(row[0], searches[setting], policy, setting)
        _landscapes(row[1:], policy)
    if shots is not None:
        figure.colorbar(shots, ax=panels[:, 0].tolist(), label="speed of the mallet [m/s]", location="bottom")
    figure.savefig(path, dpi=110)
    plt.close(figure)


def _shots(axes: Any, search: ShotSearch, policy: ShootingPolicy, setting: str) -> Any:
    """Directions and speeds that a policy chooses for resting pucks."""
    from matplotlib.patches import Rectangle

    x, y = TABLE.half_length, TABLE.half_width
    axes.add_patch(Rectangle((-x, -y), 2 * x, 2 * y, fill=False, color="0.4"))
    axes.plot([x, x], [-0.5 * TABLE.goal_width, 0.5 * TABLE.goal_width], "g", lw=4)
    pucks = np.array([[*place, 0.0, 0.0] for place in _PLACES] + [EXAMPLE])
    rng = np.random.default_rng(0)
    angles = np.array([policy.solve(puck, STEPS, rng)[0] for puck in pucks])
    speeds = search.speeds(pucks[:, :2], angles)
    axes.plot(*pucks[:, :2].T, "o", color="0.75", ms=7)
    axes.plot(*EXAMPLE[:2], "o", color="red", ms=8)
    arrows = axes.quiver(
        *pucks[:, :2].T, speeds * np.cos(angles), speeds * np.sin(angles), speeds, cmap="viridis",
        angles="xy", scale_units="xy", scale=8.0, width=0.005, clim=(1.0, 3.0),
    )  # fmt: skip
    wanted = SETTINGS[setting]
    axes.set(aspect="equal", xlim=(-x - 0.02, x + 0.02), ylim=(-y - 0.02, y + 0.02), ylabel="y [m]")
    axes.set_title(f"{setting}: λ1 = {wanted.lambda1:g}, λ2 = {wanted.lambda2:g}, β = {wanted.beta:g}")
    return arrows


def _landscapes(row: Any, policy: ShootingPolicy) -> None:
    """Energies over all angles, and the samples of some steps."""
    angles = np.linspace(policy.energy.low[4], policy.energy.high[4], 601)
    energies = _lifted(policy.energy.energies(EXAMPLE, angles))
    rng = np.random.default_rng(0)
    samples: PolicySamples | None = None
    for step in range(1, STEPS + 1):
        chosen, samples = policy.infer(EXAMPLE, samples, rng)
        if step not in SHOWN:
            continue
        axes = row[SHOWN.index(step)]
        axes.plot(np.degrees(angles), energies, color="tab:blue", lw=1.0)
        heights = np.interp(samples.angles, angles, energies)
        axes.plot(np.degrees(samples.angles), heights, ".", color="0.3", ms=4)
        axes.axvline(np.degrees(chosen), color="red", lw=1.0)
        axes.set(title=f"step {step}: {np.degrees(chosen):.1f}°", xlabel="angle [°]", yticks=[])
    row[0].set_ylabel("energy")


def _lifted(energies: NDArray) -> NDArray[np.float64]:
    """Energies above the least one, cut where the landscape is of no interest."""
    above = np.asarray(energies, dtype=float) - energies.min()
    return np.minimum(above, np.quantile(above, 0.9))
