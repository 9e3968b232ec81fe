"""Training of the energy-based shooting policy (5.3.3): examples by the model, InfoNCE (5.14), Adam."""

import dataclasses
from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import InvalidInputError
from vpsto_ros.planning.hockey.shooting_config import ShootingObjective
from vpsto_ros.planning.hockey.shooting_policy import LAYERS, EnergyModel
from vpsto_ros.planning.hockey.shooting_search import ShotSearch, Strokes

Weights = dict[str, NDArray[np.float32]]
_CHUNK = 50  # states that are weighed at once


@documented
@dataclasses.dataclass(frozen=True)
class TrainingConfig:
    """Options of training a policy.

    Deviations: the thesis has 3000 states and 500 to 1000 epochs. More states in fewer epochs learn better
    here in the same time: with 3000, angles of bank shots are too rough to keep the chance constraint. And
    examples keep a reserve from it: the optimum is often at its edge, where half of all small errors of the
    angle would break it.
    """

    states: int = option(40_000, "puck states N", minimum=1, maximum=10**6)
    actions: int = option(100, "angles per state M", minimum=2, maximum=10**4)
    fastest: float = option(1.0, "largest speed of these pucks", unit="m/s", minimum=0.0, maximum=5.0)
    position_std: float = option(
        0.002, "standard deviation with which their places are known", unit="m", minimum=0.0, maximum=0.1
    )
    velocity_std: float = option(
        0.01, "and likewise their velocities", unit="m/s", minimum=0.0, maximum=1.0
    )
    reserve: float = option(
        0.1, "by how much examples exceed the threshold of the chance constraint where any does", minimum=0.0,
        maximum=0.5,
    )  # fmt: skip
    epochs: int = option(40, "passes over the states", minimum=1, maximum=10**5)
    batch: int = option(50, "states per step of Adam", minimum=1, maximum=10**5)
    negatives: int = option(
        15, "counter-examples of a state that a pass draws of its M - 1", minimum=1, maximum=10**4
    )
    rate: float = option(2e-3, "learning rate at the beginning", minimum=1e-7, maximum=1.0)
    last_rate: float = option(2e-5, "and at the end; a cosine between", minimum=1e-8, maximum=1.0)
    harmonics: int = option(6, "multiples of the angle among the inputs", minimum=0, maximum=50)

    def __post_init__(self) -> None:
        validate(self)

    @property
    def covariance(self) -> NDArray[np.float64]:
        """Of the pucks' states, shape (4, 4)."""
        return np.diag(np.repeat([self.position_std, self.velocity_std], 2) ** 2)


@dataclasses.dataclass(frozen=True, eq=False)
class Examples:
    """Puck states at the touch with angles.

    Attributes:
        states: shape (N, 4).
        angles: the best one first, then the counter-examples, shape (N, M) [rad].
        allowed: whether the best one keeps the chance constraint, shape (N,).
    """

    states: NDArray[np.float64]
    angles: NDArray[np.float64]
    allowed: NDArray[np.bool_]


def states(search: ShotSearch, count: int, fastest: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Random puck states (count, 4) at which the arm could strike in some direction.

    Places are uniform over the grid of strikes; directions of motion are uniform, and so are speeds, but
    every fourth puck rests.

    Raises:
        InvalidInputError: the arm cannot strike anywhere.
    """
    strikes, found, tries = search.strikes, np.empty((0, 4)), 0
    low = np.array([strikes.x[0], strikes.y[0]])
    high = np.array([strikes.x[-1], strikes.y[-1]])
    while len(found) < count:
        places = rng.uniform(low, high, (count, 2))
        directions, speeds = rng.uniform(-np.pi, np.pi, count), fastest * rng.random(count)
        speeds[rng.random(count) < 0.25] = 0.0
        velocities = speeds[:, None] * np.stack([np.cos(directions), np.sin(directions)], axis=1)
        good = _strikes(search, places, np.tile(search.angles, (count, 1))).any(axis=1)
        found = np.vstack([found, np.hstack([places, velocities])[good]])
        tries += 1
        if tries > 100:
            raise InvalidInputError("the arm can strike nowhere on its grid")
    return found[:count]


def examples(
    search: ShotSearch,
    config: TrainingConfig,
    rng: np.random.Generator,
    progress: Callable[[Iterator], Iterator] = iter,
) -> Examples:
    """Random states, each with M random angles of which the best by (5.12) comes first.

    Where no angle keeps the chance constraint, the one that scores most likely is the example: a policy must
    answer something, and whoever uses it checks the constraint anyway. A state from which no angle reaches
    the goal at all gives no example.

    Args:
        search: weighs shots.
        config: how many.
        rng: draws them.
        progress: wraps the iteration over parts of the states.

    Raises:
        InvalidInputError: no state has an angle that reaches the goal.
    """
    known = states(search, config.states, config.fastest, rng)
    low, high = search.strikes.angle[0], search.strikes.angle[-1]
    angles = rng.uniform(low, high, (len(known), config.actions))
    scores = np.full(angles.shape, -np.inf)
    wanted = search.config.objective
    reserved = dataclasses.replace(wanted, beta=min(wanted.beta + config.reserve, 0.999))
    for begin in progress(iter(range(0, len(known), _CHUNK))):
        part = slice(begin, begin + _CHUNK)
        scores[part] = score(search, known[part], angles[part], config.covariance, reserved)
    best = scores.argmax(axis=1)
    kept = np.isfinite(scores.max(axis=1))
    if not kept.any():
        raise InvalidInputError("no shot of the examples reaches the goal")
    rows = np.arange(len(known))
    angles[rows, 0], angles[rows, best] = angles[rows, best], angles[rows, 0].copy()
    allowed = score(search, known[kept], angles[kept, :1], config.covariance)[:, 0] >= 0.0
    return Examples(known[kept], angles[kept], allowed)


def score(
    search: ShotSearch, known: NDArray, angles: NDArray, covariance: NDArray,
    objective: ShootingObjective | None = None,
) -> NDArray[np.float64]:  # fmt: skip
    """Scores (B, M) of angles (B, M) for states (B, 4); -inf where no puck comes to the goal line.

    Negative ones break a constraint. The objective is that of the search if None.
    """
    wanted = objective or search.config.objective
    speeds = _strikes(search, known[:, :2], angles)
    row, column = np.nonzero(speeds)
    scores = np.full(angles.shape, -np.inf)
    if row.size:
        spread = np.broadcast_to(covariance, (len(row), 4, 4))
        strokes = Strokes(np.zeros(len(row)), known[row], spread, angles[row, column], speeds[row, column])
        outlook = search.outlook(strokes)
        scores[row, column] = np.where(
            np.isfinite(outlook.speed), wanted.scores(outlook), -np.inf
        )
    return scores


def _strikes(search: ShotSearch, places: NDArray, angles: NDArray) -> NDArray[np.float64]:
    """Speeds (B, M) for places (B, 2) and angles (B, M)."""
    flat = np.repeat(places, angles.shape[1], axis=0)
    return search.speeds(flat, angles.ravel()).reshape(angles.shape)


def train(
    model: EnergyModel, data: Examples, config: TrainingConfig, rng: np.random.Generator
) -> Iterator[tuple[EnergyModel, float]]:
    """Train; yields the model and the mean loss after each epoch.

    Args:
        model: to begin with.
        data: examples.
        config: epochs, batches, rates.
        rng: shuffles, and draws counter-examples.
    """
    weights = {name: model.weights[name].copy() for name in LAYERS}
    adam = _Adam(weights)
    count, total = len(data.states), config.epochs * -(-len(data.states) // config.batch)
    state_inputs, angle_inputs = model.state_inputs(data.states), model.angle_inputs(data.angles)
    negatives = min(config.negatives, data.angles.shape[1] - 1)
    for _ in range(config.epochs):
        order, losses = rng.permutation(count), []
        for begin in range(0, count, config.batch):
            rows = order[begin : begin + config.batch]
            drawn = rng.integers(1, data.angles.shape[1], (len(rows), negatives))
            columns = np.hstack([np.zeros((len(rows), 1), dtype=drawn.dtype), drawn])
            loss, gradients = loss_and_gradients(
                weights, state_inputs[rows], angle_inputs[rows[:, None], columns]
            )
            share = 0.5 * (1.0 + np.cos(np.pi * adam.steps / total))
            adam.step(weights, gradients, config.last_rate + share * (config.rate - config.last_rate))
            losses.append(loss * len(rows))
        trained = dataclasses.replace(model, weights={name: weights[name].copy() for name in LAYERS})
        yield trained, float(np.sum(losses) / count)


def loss_and_gradients(
    weights: Weights, state_inputs: NDArray, angle_inputs: NDArray
) -> tuple[float, Weights]:
    """InfoNCE (5.14), the mean over states, and its gradients.

    Args:
        weights: of the energy model.
        state_inputs: scaled, shape (B, 4).
        angle_inputs: of the example and its counter-examples, shape (B, M, F).
    """
    b, m, f = angle_inputs.shape
    flat = angle_inputs.reshape(b * m, f)
    begun = state_inputs @ weights["first"][:4] + weights["first_bias"]
    first = np.maximum((flat @ weights["first"][4:]).reshape(b, m, -1) + begun[:, None], 0.0)
    first = first.reshape(b * m, -1)
    second = np.maximum(first @ weights["second"] + weights["second_bias"], 0.0)
    logits = -(second @ weights["last"]).reshape(b, m)  # of (5.15)
    logits -= logits.max(axis=1, keepdims=True)
    probabilities = np.exp(logits)
    probabilities /= probabilities.sum(axis=1, keepdims=True)
    loss = -float(np.log(np.maximum(probabilities[:, 0], 1e-30)).mean())
    energy = -probabilities / b
    energy[:, 0] += 1.0 / b  # dL/dE
    back = np.outer(energy.ravel(), weights["last"]) * (second > 0.0)
    gradients = {
        "last": second.T @ energy.ravel(), "second": first.T @ back, "second_bias": back.sum(axis=0),
    }  # fmt: skip
    back = (back @ weights["second"].T) * (first > 0.0)
    of_states = back.reshape(b, m, -1).sum(axis=1)
    gradients["first"] = np.vstack([state_inputs.T @ of_states, flat.T @ back])
    gradients["first_bias"] = of_states.sum(axis=0)
    return loss, gradients


class _Adam:
    """Kingma and Ba's optimiser, with their constants."""

    def __init__(self, weights: Weights) -> None:
        self.steps = 0
        self._first = {name: np.zeros_like(array) for name, array in weights.items()}
        self._second = {name: np.zeros_like(array) for name, array in weights.items()}

    def step(self, weights: Weights, gradients: Weights, rate: float) -> None:
        """Change the weights in place."""
        self.steps += 1
        scale = rate * np.sqrt(1.0 - 0.999**self.steps) / (1.0 - 0.9**self.steps)
        for name, gradient in gradients.items():
            first, second = self._first[name], self._second[name]
            first += 0.1 * (gradient - first)
            second += 0.001 * (gradient * gradient - second)
            weights[name] -= (scale * first / (np.sqrt(second) + 1e-8)).astype(weights[name].dtype)
