"""Tabulating strikes: the search of postures over a grid of puck positions and shooting angles."""

import itertools
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.planning.hockey.strike_search import search_posture
from vpsto_ros.planning.hockey.strikes import StrikeConfig, StrikeTable
from vpsto_ros.robot.iiwa import iiwa14

_MIRROR = np.array([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0])  # of the joints, across the plane y = 0
_LEAST_SPEED = 0.2  # slower strikes are none [m/s]
_LARGEST_BREACH = 0.05  # what the search may leave of breaches [m/s]; planned motions are checked themselves


def tabulate(
    x: ArrayLike,
    y: ArrayLike,
    angle: ArrayLike,
    contact_distance: float,
    rng: np.random.Generator,
    *,
    config: StrikeConfig | None = None,
    rules: PlayRules | None = None,
    effort: int = 4000,
    progress: Any = iter,
) -> StrikeTable:
    """Search the postures of a grid; grids must be symmetric in y and angle, as the arm is.

    Args:
        x: grid, see :class:`StrikeTable`.
        y: likewise.
        angle: likewise.
        contact_distance: between the centres of puck and mallet when they touch [m].
        rng: source of randomness.
        config: how strikes run.
        rules: what they keep.
        effort: postures that are tried per entry.
        progress: wraps the entries to be searched, such as tqdm.
    """
    config, rules = config or StrikeConfig(), rules or PlayRules()
    x, y, angle = (np.asarray(grid, dtype=float) for grid in (x, y, angle))
    if not (np.allclose(y, -y[::-1]) and np.allclose(angle, -angle[::-1])):
        raise InvalidInputError("strikes: the grids of y and angle must be symmetric about 0")
    layers = [_Search(config, rules, weight, contact_distance, effort, rng) for weight in config.lead_weights]
    shape = (len(layers), len(x), len(y), len(angle))
    speed, posture, rates = np.zeros(shape), np.zeros((*shape, 7)), np.zeros((*shape, 7))
    score = np.full(shape, -np.inf)
    half = itertools.product(range(len(x)), range(len(y) // 2, len(y)), range(len(angle)))
    # The second round starts from the neighbours' postures as well: better, and smoother over the table.
    entries = list(itertools.product(range(2), range(len(layers)), list(half)))
    for again, layer, (i, j, k) in progress(entries):
        cell, twin = (layer, i, j, k), (layer, i, len(y) - 1 - j, len(angle) - 1 - k)
        near = _neighbours(posture[layer], speed[layer], (i, j, k)) if again else np.zeros((0, 7))
        found = layers[layer](np.array([x[i], y[j]]), angle[k], near)
        if found[0] <= score[cell]:
            continue
        score[cell] = score[twin] = found[0]
        speed[cell], posture[cell], rates[cell] = found[1:]
        speed[twin], posture[twin], rates[twin] = found[1], _MIRROR * found[2], _MIRROR * found[3]
    return StrikeTable(x, y, angle, speed, posture, rates, contact_distance, config, rules)


class _Search:
    """The search for one entry."""

    def __init__(
        self, config: StrikeConfig, rules: PlayRules, lead_weight: float, distance: float, effort: int,
        rng: np.random.Generator,
    ) -> None:  # fmt: skip
        limits, self._rules, self._distance = rules.limits(iiwa14()), rules, distance
        self._home = np.array(rules.home)
        self._velocity = config.speed_share * limits.velocity
        self._positions = 0.99 * limits.position_range[1]
        steepness = (limits.acceleration / self._velocity).min()
        self._row = np.array(
            [*rules.kernel_row(), config.run_up, config.hold, config.brake, lead_weight, steepness]
        )
        # A strike as it is searched is nearer to the plane than what is allowed: replanning needs the rest.
        self._row[1] *= 0.4
        spread = np.array([0.5, 0.6, 0.8, 0.5, 0.8, 0.6, 0.0])
        self._seeds = self._home + spread * rng.standard_normal((effort // 5, 7))
        self._noise = rng.standard_normal((effort - effort // 5, 7))
        self._noise[:, 6] = 0.0  # it turns the rod about itself

    def __call__(
        self, puck: NDArray, angle: float, near: NDArray
    ) -> tuple[float, float, NDArray[np.float64], NDArray[np.float64]]:
        """Score, speed, posture and rates for a puck (2,), table frame; postures (S, 7) are tried first."""
        direction = np.array([np.cos(angle), np.sin(angle)])
        place = puck + self._rules.table - self._distance * direction
        posture, rates = np.zeros(7), np.zeros(7)
        score, speed, breaches = search_posture(
            place[0], place[1], angle, self._velocity, self._positions, self._row, self._home,
            np.vstack([near, self._seeds]), self._noise, 8, posture, rates,
        )  # fmt: skip
        if breaches > _LARGEST_BREACH or speed < _LEAST_SPEED:
            return -np.inf, 0.0, posture, rates
        return score, speed, posture, rates


def _neighbours(posture: NDArray, speed: NDArray, index: tuple[int, int, int]) -> NDArray[np.float64]:
    """Postures (S, 7) of an entry and of those next to it that have a strike."""
    block = tuple(slice(max(i - 1, 0), i + 2) for i in index)
    return posture[block][speed[block] > 0.0]
