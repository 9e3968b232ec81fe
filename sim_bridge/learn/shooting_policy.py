"""``vpsto learn shooting_policy``: train the energy-based policies of the three settings, 5.3.3."""

import argparse
import dataclasses
import pathlib
import time
from typing import Any

import numpy as np
from tqdm import tqdm

from sim_bridge.cli import count, file
from sim_bridge.learn.shooting_comparison import compare
from sim_bridge.verdict import print_verdict
from vpsto_ros.contact.puck import SHIPPED, PuckModel
from vpsto_ros.planning.hockey.shooting_config import SETTINGS, ShootingConfig
from vpsto_ros.planning.hockey.shooting_policy import EnergyModel, ShootingPolicy, save_policies
from vpsto_ros.planning.hockey.shooting_search import ShotSearch
from vpsto_ros.planning.hockey.shooting_training import TrainingConfig, examples, states, train
from vpsto_ros.planning.hockey.strikes import SHIPPED as STRIKES
from vpsto_ros.planning.hockey.strikes import StrikeTable

ENOUGH = 0.9
"""Of the best objective, on states that training has not seen, below which a policy is not worth having."""
_UNSEEN = 300  # pucks on which a policy is judged
_STREAM = 4  # its pucks are not those of any experiment, whatever the seed
_DEFAULT = TrainingConfig()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "example: vpsto learn shooting_policy --epochs 20 --out shooting_policy.npz"
    parser.add_argument(
        "--states", type=count, default=_DEFAULT.states, metavar="N",
        help=f"puck states to learn from (default {_DEFAULT.states})",
    )  # fmt: skip
    parser.add_argument(
        "--epochs", type=count, default=_DEFAULT.epochs, metavar="N",
        help=f"passes over them (default {_DEFAULT.epochs})",
    )  # fmt: skip
    parser.add_argument(
        "--model", default=str(SHIPPED), metavar="FILE", type=file,
        help="of the puck (default: the one that comes with the package)",
    )  # fmt: skip
    parser.add_argument(
        "--strikes", default=str(STRIKES), metavar="FILE", type=file,
        help="of the arm (default: the table that comes with the package)",
    )  # fmt: skip


def run(arguments: argparse.Namespace) -> int:
    """Train, judge, write; 0 when every policy is worth having.

    Raises:
        ConfigurationError: a file is no model of a puck or no table of strikes.
    """
    model, strikes = PuckModel.load(arguments.model), StrikeTable.load(arguments.strikes)
    config = dataclasses.replace(_DEFAULT, states=arguments.states, epochs=arguments.epochs)
    models, figures = {}, {}
    for number, (setting, objective) in enumerate(SETTINGS.items()):
        search = ShotSearch(model, strikes, ShootingConfig(objective=objective))
        rng = np.random.default_rng((_STREAM, arguments.seed, number))
        models[setting], figures[setting] = learn(setting, search, config, rng)
        print(describe(setting, figures[setting]))
    path = pathlib.Path(arguments.out)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_policies(path, models, figures, model, strikes, command=command(arguments), seed=arguments.seed)
    print(f"wrote {path}")
    poor = [setting for setting in SETTINGS if figures[setting]["objective_ratio"] < ENOUGH]
    ratios = ", ".join(f"{figures[setting]['objective_ratio']:.3f} ({setting})" for setting in SETTINGS)
    return print_verdict(not poor, f"policies reach {ratios} of the best objective on unseen states")


def command(arguments: argparse.Namespace) -> str:
    """What has been asked for, as far as it is not the default."""
    text = f"vpsto learn shooting_policy --states {arguments.states} --epochs {arguments.epochs}"
    text += f" --seed {arguments.seed}"
    for name, default in (("model", SHIPPED), ("strikes", STRIKES)):
        given = getattr(arguments, name)
        text += f" --{name} {given}" if given != str(default) else ""
    return text


def learn(
    setting: str, search: ShotSearch, config: TrainingConfig, rng: np.random.Generator
) -> tuple[EnergyModel, dict[str, Any]]:
    """The trained model of a setting, and figures of its training."""
    began = time.perf_counter()
    data = examples(
        search, config, rng,
        lambda parts: tqdm(list(parts), desc=f"{setting}: examples", disable=None, leave=False),
    )  # fmt: skip
    model, losses = EnergyModel.random(*input_range(search, config), config.harmonics, rng), []
    epochs = train(model, data, config, rng)
    with tqdm(epochs, total=config.epochs, desc=f"{setting}: epochs", disable=None, leave=False) as bar:
        for trained, loss in bar:
            model = trained
            losses.append(loss)
            bar.set_postfix(loss=f"{loss:.3f}")
    duration = time.perf_counter() - began
    unseen = states(search, _UNSEEN, config.fastest, rng)
    policy = ShootingPolicy(model)
    ratios = [compare(search, policy, state, config.covariance, rng).ratio for state in unseen]
    return model, {
        "epochs": config.epochs, "states": len(data.states), "actions": config.actions,
        "allowed": float(data.allowed.mean()), "first_loss": losses[0], "last_loss": losses[-1],
        "training_s": round(duration, 1), "objective_ratio": float(np.nanmean(ratios)),
    }  # fmt: skip


def input_range(search: ShotSearch, config: TrainingConfig) -> tuple[list[float], list[float]]:
    """Smallest and largest (x, y, vx, vy, angle) that the model is trained for."""
    strikes, fastest = search.strikes, max(config.fastest, 1e-3)
    low = [strikes.x[0], strikes.y[0], -fastest, -fastest, strikes.angle[0]]
    return low, [strikes.x[-1], strikes.y[-1], fastest, fastest, strikes.angle[-1]]


def describe(setting: str, figures: dict[str, Any]) -> str:
    """The figures of a training in words."""
    return (
        f"{setting}: {figures['states']} states, {figures['allowed']:.0%} with a shot that keeps the "
        f"constraint; loss {figures['first_loss']:.2f} to {figures['last_loss']:.2f} in {figures['epochs']} "
        f"epochs, {figures['training_s']:.0f} s"
    )
