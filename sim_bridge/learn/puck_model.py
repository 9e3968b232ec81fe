"""``vpsto learn puck_model``: record episodes of the air-hockey world and fit the puck model, 5.2.2."""

import argparse
import pathlib
from collections.abc import Iterable

from tqdm import tqdm

from sim_bridge.cli import count
from sim_bridge.hockey.recordings import CONTACT_TIME, TABLE, Recorder, kind_of
from sim_bridge.verdict import print_verdict
from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.contact.puck import MODES, PuckModel
from vpsto_ros.contact.puck_learning import LabelledSteps, collect, fit, widened, widening

ENOUGH = 20
"""Steps of each mode, below which its scatter is a guess."""
_STREAM = 1  # its episodes are not those of any experiment, whatever the seed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this command."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = "example: vpsto learn puck_model --episodes 400 --seed 1 --out puck_model.json"
    parser.add_argument(
        "--episodes", type=count, default=100, metavar="N", help="to record, a second each (default 100)"
    )


def run(arguments: argparse.Namespace) -> int:
    """Record, fit, write; 0 when every mode was seen often enough.

    Raises:
        InvalidInputError: a mode was seen too rarely to fit it at all.
    """
    numbers = tqdm(range(arguments.episodes), desc="recording episodes", disable=None)
    steps = record(numbers, arguments.seed)
    model, factors = learn(steps)
    counts = steps.counts()
    path = pathlib.Path(arguments.out)
    path.parent.mkdir(parents=True, exist_ok=True)
    command = f"vpsto learn puck_model --episodes {arguments.episodes} --seed {arguments.seed}"
    model.save(path, command=command, seed=arguments.seed, steps=counts, widened=factors)
    print(describe(model, factors))
    print(f"wrote {path}")
    rare = [f"{counts[name]} {name} steps" for name in MODES if counts[name] < ENOUGH]
    learned = ", ".join(f"{counts[name]} {name}" for name in MODES)
    return print_verdict(
        not rare,
        f"only {', '.join(rare)}, fewer than {ENOUGH}; record more with --episodes" if rare
        else f"learned from {learned} steps; {counts['unclear']} unclear ones were left out",
    )  # fmt: skip


def record(numbers: Iterable[int], seed: int) -> LabelledSteps:
    """Labelled steps of the episodes with these numbers, half of them free, half struck."""
    recorder = Recorder()
    episodes = [recorder.episode(kind_of(number), (_STREAM, seed, number)) for number in numbers]
    return collect([episode.recording for episode in episodes], TABLE, CONTACT_TIME)


def learn(steps: LabelledSteps) -> tuple[PuckModel, dict[str, float]]:
    """The fit, widened to what steps that it has not seen need, and the factors of that."""
    factors = widening(steps, TABLE)
    return widened(fit(steps, TABLE), factors), factors


def describe(model: PuckModel, factors: dict[str, float]) -> str:
    """The modes in words."""
    std = {name: getattr(model, name).covariance.diagonal() ** 0.5 for name in MODES}
    keep = -model.wall.matrix[0, 0], model.wall.matrix[1, 1]
    drag = (1.0 - model.floating.matrix[0, 0]) / model.period
    puck, mallet, late = model.mallet.matrix[0, 0], model.mallet.matrix[0, 2], 1e3 * model.hit_delay
    lines = [
        f"floating: drag {drag:.2f} /s",
        f"wall: keeps {keep[0]:.2f} of the speed across and {keep[1]:.2f} along it",
        f"mallet: {mallet:.2f} of the mallet's speed {puck:+.2f} of the puck's, {late:.1f} ms late",
    ]
    if model.lively is not None:
        lively = -model.lively.matrix[0, 0], model.lively.matrix[1, 1]
        std["lively"] = model.lively.covariance.diagonal() ** 0.5
        lines[1] += (
            f"; {100 * model.lively_share:.0f} % of bounces are lively and keep {lively[0]:.2f} and "
            f"{lively[1]:.2f}, scatter {1e3 * std['lively'][0]:.1f}, {1e3 * std['lively'][1]:.1f} mm/s"
        )
    scatter = [
        f"; scatter {1e3 * std[name][0]:.1f}, {1e3 * std[name][1]:.1f} mm/s{_growing(getattr(model, name))}, "
        f"widened by {factors[name]:.2f}"
        for name in MODES
    ]
    return "\n".join(map("".join, zip(lines, scatter, strict=True)))


def _growing(mode: LinearGaussian) -> str:
    return " at 1 m/s" if mode.growth.any() else ""
