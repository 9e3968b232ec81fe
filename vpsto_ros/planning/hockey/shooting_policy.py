"""The energy-based shooting policy (5.3.3, 5.3.4): angles of low energy are good shots, found by sampling.

Only NumPy is needed to use one; :mod:`vpsto_ros.planning.hockey.shooting_training` trains it.
"""

import dataclasses
import json
import math
import pathlib
import zipfile
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vpsto_ros.contact.puck import PuckModel
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.planning.hockey.shooting_config import SETTINGS
from vpsto_ros.planning.hockey.strikes import StrikeTable

FORMAT = "vpsto_ros shooting policies 2"
SHIPPED = pathlib.Path(__file__).parent / "models" / "shooting_policy.npz"
"""The policies of the three settings, which come with the package; their origin is in the file."""
HIDDEN = 128
LAYERS = ("first", "first_bias", "second", "second_bias", "last")
_REMEDY = "`vpsto learn shooting_policy` makes one"


@dataclasses.dataclass(frozen=True, eq=False)
class PolicySamples:
    """Candidates of Algorithm 2, to go on from.

    Attributes:
        angles: shape (N,) [rad].
        probabilities: softmax of their negative energies, shape (N,).
        std: of what is added to them in the next step [rad].
    """

    angles: NDArray[np.float64]
    probabilities: NDArray[np.float64]
    std: float


@dataclasses.dataclass(frozen=True, eq=False)
class EnergyModel:
    """E_theta(s, u): a perceptron with two hidden layers of 128 units, in single precision.

    Its inputs are scaled to [-1, 1]. Deviation: beside the angle it gets sines and cosines of some multiples
    of it: good angles are a few degrees wide, which a perceptron is slow to learn from the angle alone.

    Attributes:
        low: smallest (x, y, vx, vy, angle), shape (5,) [m, m/s, rad].
        high: largest.
        weights: by the names of :data:`LAYERS`.

    Raises:
        InvalidInputError: shapes do not fit, or a number is not finite.
    """

    low: NDArray[np.float64]
    high: NDArray[np.float64]
    weights: dict[str, NDArray[np.float32]]

    def __post_init__(self) -> None:
        shapes = {name: np.shape(self.weights[name]) for name in LAYERS}
        inputs = shapes["first"][0] if shapes["first"] else 0
        expected = {
            "first": (inputs, HIDDEN), "first_bias": (HIDDEN,), "second": (HIDDEN, HIDDEN),
            "second_bias": (HIDDEN,), "last": (HIDDEN,),
        }  # fmt: skip
        if shapes != expected or inputs < 5 or inputs % 2 == 0:
            raise InvalidInputError(f"layers of an energy model have the shapes {shapes}")
        if np.shape(self.low) != (5,) or np.shape(self.high) != (5,):
            raise InvalidInputError("the range of an energy model's inputs needs five numbers each")
        arrays: list[NDArray] = [self.low, self.high, *self.weights.values()]
        if not all(np.isfinite(array).all() for array in arrays) or not (self.high > self.low).all():
            raise InvalidInputError("numbers of an energy model are not finite, or its range is empty")

    @classmethod
    def random(
        cls, low: ArrayLike, high: ArrayLike, harmonics: int, rng: np.random.Generator
    ) -> "EnergyModel":
        """Weights to begin training with (He's)."""
        inputs = 5 + 2 * harmonics
        drawn = {
            "first": rng.standard_normal((inputs, HIDDEN)) * math.sqrt(2.0 / inputs),
            "second": rng.standard_normal((HIDDEN, HIDDEN)) * math.sqrt(2.0 / HIDDEN),
            "last": rng.standard_normal(HIDDEN) * math.sqrt(2.0 / HIDDEN),
            "first_bias": np.zeros(HIDDEN), "second_bias": np.zeros(HIDDEN),
        }  # fmt: skip
        weights = {name: drawn[name].astype(np.float32) for name in LAYERS}
        return cls(np.asarray(low, dtype=float), np.asarray(high, dtype=float), weights)

    def state_inputs(self, states: ArrayLike) -> NDArray[np.float32]:
        """States (..., 4) scaled."""
        return self._scaled(np.asarray(states, dtype=float), slice(0, 4))

    def angle_inputs(self, angles: ArrayLike) -> NDArray[np.float32]:
        """Angles (...,) scaled, and their sines and cosines, shape (..., 1 + 2 H)."""
        u = self._scaled(np.asarray(angles, dtype=float), 4)
        multiples: NDArray[np.float32] = np.pi * np.arange(1, (len(self.weights["first"]) - 3) // 2)
        phases = u[..., None] * multiples.astype(np.float32)
        return np.concatenate([u[..., None], np.sin(phases), np.cos(phases)], axis=-1)

    def energies(self, state: ArrayLike, angles: ArrayLike) -> NDArray[np.float32]:
        """Energies (N,) of angles (N,) [rad] for a state (4,); the state's part is computed once."""
        w = self.weights
        begun = self.state_inputs(state) @ w["first"][:4] + w["first_bias"]
        hidden = np.maximum(self.angle_inputs(angles) @ w["first"][4:] + begun, 0.0)
        hidden = np.maximum(hidden @ w["second"] + w["second_bias"], 0.0)
        return hidden @ w["last"]

    def _scaled(self, values: NDArray, rows: Any) -> NDArray[np.float32]:
        low, high = self.low[rows], self.high[rows]
        return ((2.0 * values - low - high) / (high - low)).astype(np.float32)


@dataclasses.dataclass(frozen=True, eq=False)
class ShootingPolicy:
    """Angles of least energy, (5.16), by Algorithm 2.

    Attributes:
        energy: the trained model.
        origin: where it comes from (command, seed, figures), for people.
        samples: candidates.
        std: of what is first added to them [rad].
        decay: factor of it at each step.
        least_std: it stays as large, so that a state that moves can be followed [rad].
    """

    energy: EnergyModel
    origin: dict[str, Any] = dataclasses.field(default_factory=dict)
    samples: int = 64
    std: float = 0.12
    decay: float = 0.8
    least_std: float = 0.004

    def __post_init__(self) -> None:
        if self.samples < 2 or not (self.std >= self.least_std > 0.0 and 0.0 < self.decay <= 1.0):
            raise InvalidInputError("a policy needs two samples, positive deviations and a decay up to 1")

    def infer(
        self, state: ArrayLike, samples: PolicySamples | None, rng: np.random.Generator
    ) -> tuple[float, PolicySamples]:
        """A step of Algorithm 2.

        Args:
            state: of the puck just before the touch, shape (4,); the nearest one within the range of training
                is taken.
            samples: of the step before, or None to begin with uniform ones.
            rng: draws the new ones.

        Returns:
            The angle of least energy among the new samples [rad], and these.

        Raises:
            InvalidInputError: the state is not four finite numbers.
        """
        known = np.asarray(state, dtype=float)
        if known.shape != (4,) or not np.isfinite(known).all():
            raise InvalidInputError(f"a state of the puck is four finite numbers, got {known}")
        low, high = self.energy.low[4], self.energy.high[4]
        if samples is None:
            angles, std = rng.uniform(low, high, self.samples), self.std
        else:
            edges = np.cumsum(samples.probabilities)
            drawn = np.searchsorted(edges, edges[-1] * rng.random(self.samples), side="right")
            angles = samples.angles[np.minimum(drawn, len(edges) - 1)]
            angles = np.clip(angles + samples.std * rng.standard_normal(self.samples), low, high)
            std = max(self.decay * samples.std, self.least_std)
        known = np.clip(known, self.energy.low[:4], self.energy.high[:4])
        energies = self.energy.energies(known, angles).astype(float)
        probabilities = np.exp(energies.min() - energies)
        found = PolicySamples(angles, probabilities / probabilities.sum(), std)
        return float(angles[np.argmax(probabilities)]), found

    def solve(
        self, state: ArrayLike, steps: int, rng: np.random.Generator
    ) -> tuple[float, PolicySamples]:
        """The angle after some steps from uniform samples [rad], and the samples."""
        angle, samples = self.infer(state, None, rng)
        for _ in range(steps - 1):
            angle, samples = self.infer(state, samples, rng)
        return angle, samples

    @classmethod
    def load(
        cls, setting: str, model: PuckModel, strikes: StrikeTable, path: str | pathlib.Path = SHIPPED
    ) -> "ShootingPolicy":
        """The policy of a setting from a file that :func:`save_policies` wrote.

        Args:
            setting: one of :data:`~vpsto_ros.planning.hockey.shooting_config.SETTINGS`.
            model: of the puck that is shot at.
            strikes: of the arm that shoots.
            path: of the file.

        Raises:
            ConfigurationError: there is no such file or setting, it is of another format, its numbers are no
                trained model, or the policy was trained for another objective, puck or arm.
        """
        content = _read(path)
        origin = content.pop("origin")
        if setting not in origin["settings"] or setting not in SETTINGS:
            known = ", ".join(origin["settings"])
            raise ConfigurationError(f"{path} has no policy for the setting {setting!r}; it has {known}")
        figures = origin["settings"][setting]
        if not figures.get("epochs"):
            raise ConfigurationError(f"the policy {setting!r} in {path} is not trained; {_REMEDY}")
        strange = _differences(setting, figures, origin, model, strikes)
        if strange:
            raise ConfigurationError(
                f"the policy {setting!r} in {path} was trained for {' and '.join(strange)}; {_REMEDY}"
            )
        try:
            weights = {name: content[f"{setting}.{name}"].astype(np.float32) for name in LAYERS}
            low, high = (content[f"{setting}.{name}"].astype(float) for name in ("low", "high"))
            return cls(EnergyModel(low, high, weights), {**origin, "settings": {setting: figures}})
        except (KeyError, InvalidInputError) as error:
            raise ConfigurationError(f"{path} has no usable policy {setting!r}: {error}; {_REMEDY}") from None


def save_policies(
    path: str | pathlib.Path, models: dict[str, EnergyModel], figures: dict[str, dict], model: PuckModel,
    strikes: StrikeTable, **origin: Any,
) -> None:  # fmt: skip
    """Write the models of several settings into one file, with what they were trained for.

    Args:
        path: of the file (npz).
        models: by setting, one of :data:`~vpsto_ros.planning.hockey.shooting_config.SETTINGS`.
        figures: of their training by setting, `epochs` among them.
        model: of the puck that they were trained with.
        strikes: of the arm, likewise.
        origin: where they come from (command, seed), for people.
    """
    arrays: dict[str, Any] = {}
    for setting, energy in models.items():
        arrays |= {f"{setting}.{name}": energy.weights[name] for name in LAYERS}
        arrays |= {f"{setting}.low": energy.low, f"{setting}.high": energy.high}
    objectives = {setting: {"objective": dataclasses.asdict(SETTINGS[setting])} for setting in models}
    settings = {setting: figures[setting] | objectives[setting] for setting in models}
    made_for = {"puck_model": model.fingerprint, "strikes": strikes.fingerprint}
    header = json.dumps({"format": FORMAT, **origin, **made_for, "settings": settings})
    with pathlib.Path(path).open("wb") as file:
        np.savez_compressed(file, header=np.array(header), **arrays)


def _differences(
    setting: str, figures: dict[str, Any], origin: dict[str, Any], model: PuckModel, strikes: StrikeTable
) -> list[str]:
    """For what else than what it is wanted for a policy was trained, in words."""
    found, wanted = figures.get("objective"), dataclasses.asdict(SETTINGS[setting])
    strange = []
    if found != wanted:
        strange.append(f"the objective {found}, not {wanted}")
    if origin.get("puck_model") != model.fingerprint:
        strange.append("another model of the puck")
    if origin.get("strikes") != strikes.fingerprint:
        strange.append("other strikes of the arm")
    return strange


def _read(path: str | pathlib.Path) -> dict[str, Any]:
    """The arrays of a file, and its origin.

    Raises:
        ConfigurationError: there is no such file, or it is something else.
    """
    try:
        with np.load(path, allow_pickle=False) as file:
            content: dict[str, Any] = dict(file)
        origin = json.loads(str(content.pop("header")))
    except FileNotFoundError:
        raise ConfigurationError(f"there are no shooting policies {path}; {_REMEDY}") from None
    except (OSError, ValueError, KeyError, TypeError, EOFError, AttributeError, zipfile.BadZipFile) as error:
        raise ConfigurationError(f"{path} holds no shooting policies: {error}; {_REMEDY}") from None
    if not isinstance(origin, dict) or origin.pop("format", None) != FORMAT:
        raise ConfigurationError(f"{path} is not of the format '{FORMAT}'; {_REMEDY}")
    if not isinstance(origin.get("settings"), dict):
        raise ConfigurationError(f"{path} does not say which settings it has; {_REMEDY}")
    return {**content, "origin": origin}
