"""The ``vpsto`` command: demos over ROS 2 topics, experiments in lock-step, models to learn, benchmarks."""

import argparse
import importlib
import math
import os
import sys
from collections.abc import Callable, Sequence
from types import ModuleType
from typing import NamedTuple

from vpsto_ros import __version__
from vpsto_ros.exceptions import VpstoError

EXAMPLES = """\
examples:
  vpsto demo push_box                         an arm pushes a box to a moving target; see output/push_box
  vpsto demo push_box --viewer                the same with a live 3-D view in the browser
  vpsto demo push_box --real-time-factor 0.5  on a slow machine: simulated time runs at half speed
  vpsto demo bimanual_push                    two arms push a can by a belief; see output/bimanual_push
  vpsto demo air_hockey                       an arm with a mallet shoots pucks; see output/air_hockey
  vpsto experiment push_box --runs 20         20 random boxes, in lock-step and without ROS
  vpsto experiment push_box --resume          go on with an experiment that was stopped
  vpsto learn puck_model                      how a puck bounces and is hit; see output/puck_model.json
  vpsto bench --json bench.json               how long search, replanning and simulation take here
  vpsto bench --compare bench.json            and what has changed since

exit status: 0 success, 1 the run failed, 2 the command was not understood
"""


class Choice(NamedTuple):
    """What can be run: a module, and what it is about in a line."""

    module: str
    summary: str


DEMOS = {
    "push_box": Choice("sim_bridge.demo.push_box", "a simulated FR3 pushes a box to a moving target"),
    "bimanual_push": Choice(
        "sim_bridge.demo.bimanual_push",
        "two simulated FR3 push a can by a belief over where it is; a hand moves it away",
    ),
    "air_hockey": Choice("sim_bridge.demo.air_hockey", "a simulated iiwa shoots ten pucks at a goal"),
}
EXPERIMENTS = {
    "push_box": Choice(
        "sim_bridge.experiments.pushing.push_box",
        "push boxes of unknown mass and friction to a goal",
    ),
    "push_t": Choice("sim_bridge.experiments.pushing.push_t", "push a T to any pose"),
    "planning_space": Choice(
        "sim_bridge.experiments.pushing.planning_space",
        "search in the plane of the tool or in the seven joints",
    ),
    "particle_filter": Choice(
        "sim_bridge.experiments.estimation.particle_filter",
        "track a pushed can that is seen, unseen or felt only",
    ),
    "puck_filter": Choice(
        "sim_bridge.experiments.hockey.puck_filter",
        "velocity of an air-hockey puck through bounces and hits",
    ),
    "clutter_2d": Choice(
        "sim_bridge.experiments.clutter.clutter_2d",
        "a point among three obstacles: ways found, time, success",
    ),
    "clutter_2d_mpc": Choice(
        "sim_bridge.experiments.clutter.clutter_2d_mpc",
        "the same at 20 Hz and among moving discs, beside MPPI",
    ),
    "via_points": Choice(
        "sim_bridge.experiments.timing.via_points",
        "how near to the optimum time-optimal moves come",
    ),
    "cholesky": Choice(
        "sim_bridge.experiments.clutter.cholesky",
        "what the smoothness prior does for the search",
    ),
    "key_timing": Choice(
        "sim_bridge.experiments.timing.key_timing",
        "free timing of key positions against equal spacing",
    ),
    "reach_clutter": Choice(
        "sim_bridge.experiments.reaching.reach_clutter",
        "the arm between random postures in cluttered cells",
    ),
    "bimanual": Choice(
        "sim_bridge.experiments.robust_pushing.bimanual",
        "two arms push a can along a circle, blind",
    ),
    "single_hand": Choice(
        "sim_bridge.experiments.robust_pushing.single_hand",
        "a flat hand pushes a disc there and back, blind",
    ),
    "bimanual_closed_loop": Choice(
        "sim_bridge.experiments.robust_pushing.bimanual_closed_loop",
        "two arms, a can moved by hand, robust or not",
    ),
    "search": Choice(
        "sim_bridge.experiments.search.choices",
        "every option of the search against its alternatives",
    ),
    "belief_1d": Choice(
        "sim_bridge.experiments.belief.belief_1d",
        "belief over a box on a line: closed form and particles",
    ),
    "variance_gain": Choice(
        "sim_bridge.experiments.belief.variance_gain",
        "variance of a disc pushed by one finger, a side, two",
    ),
    "contact_prior": Choice(
        "sim_bridge.experiments.belief.contact_prior",
        "candidates that touch, with a contact prior and without",
    ),
    "robust_push_2d": Choice(
        "sim_bridge.experiments.belief.robust_push_2d",
        "a rectangle pushes a disc into a region, open loop",
    ),
    "belief_ablation": Choice(
        "sim_bridge.experiments.belief.belief_ablation",
        "two balls, a disc, a circle: iterations, prior, joints",
    ),
    "puck_model": Choice(
        "sim_bridge.experiments.hockey.puck_model",
        "how well the learned puck model knows where pucks go",
    ),
    "shooting_policy": Choice(
        "sim_bridge.experiments.hockey.shooting_policy",
        "the energy-based shooting policy and direct search",
    ),
    "shooting": Choice(
        "sim_bridge.experiments.hockey.shooting",
        "the iiwa shoots pucks: score, speed, banks by setting",
    ),
    "goal_probability": Choice(
        "sim_bridge.experiments.hockey.goal_probability",
        "whether shots score as often as the puck model says",
    ),
}
LEARNERS = {
    "puck_model": Choice("sim_bridge.learn.puck_model", "how an air-hockey puck floats, bounces and is hit"),
    "strikes": Choice("sim_bridge.learn.strikes", "in which posture the iiwa strikes a puck fastest"),
    "shooting_policy": Choice(
        "sim_bridge.learn.shooting_policy", "at which angle to shoot, from what direct search finds"
    ),
}

LEARNED_FILES = {"puck_model": ".json", "strikes": ".npz", "shooting_policy": ".npz"}


def positive(text: str) -> float:
    """A finite number above zero, for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value > 0.0):
        raise argparse.ArgumentTypeError(f"{text!r} is not a positive number")
    return value


def count(text: str) -> int:
    """A whole number of at least one, for argparse."""
    return _whole(text, minimum=1)


def jobs(text: str) -> int:
    """A number of processes, 0 for every core, for argparse."""
    return _whole(text, minimum=0)


def seed(text: str) -> int:
    """A seed: a whole number from zero up, for argparse."""
    return _whole(text, minimum=0)


def folder(text: str) -> str:
    """The path of a folder that exists or can be made, for argparse."""
    if not text or (os.path.exists(text) and not os.path.isdir(text)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a folder")
    return text


def file(text: str) -> str:
    """The path of a file that exists or can be made, for argparse."""
    if not text or os.path.isdir(text):
        raise argparse.ArgumentTypeError(f"{text!r} is not a file")
    return text


def _whole(text: str, minimum: int) -> int:
    try:
        value = int(text)
    except ValueError:
        value = minimum - 1
    if value < minimum:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from {minimum} up")
    return value


def build_parser(chosen: Sequence[str] = ()) -> argparse.ArgumentParser:
    """The command line.

    Args:
        chosen: the arguments that will be parsed. Only the experiment named there is imported for its own
            options, so that ``vpsto --help`` answers at once.
    """
    parser = argparse.ArgumentParser(
        prog="vpsto",
        description="Plan contact in real time by via-point-based stochastic trajectory optimisation.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("--version", action="version", version=f"vpsto {__version__}")
    commands = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    demo = commands.add_parser(
        "demo", help="run the nodes as separate processes over ROS 2 topics and judge the run"
    )
    _add_modules(demo, "DEMO", DEMOS, _demo_arguments)
    experiment = commands.add_parser("experiment", help="repeat a task many times in lock-step, without ROS")
    experiments = _add_modules(experiment, "EXPERIMENT", EXPERIMENTS, _experiment_arguments)
    if list(chosen[:1]) == ["experiment"] and chosen[1:2] and chosen[1] in EXPERIMENTS:
        _load(EXPERIMENTS[chosen[1]].module).add_arguments(experiments[chosen[1]])
    learn = commands.add_parser("learn", help="learn or tabulate a model and write it to a file")
    learners = _add_modules(learn, "MODEL", LEARNERS, _learn_arguments)
    if list(chosen[:1]) == ["learn"] and chosen[1:2] and chosen[1] in LEARNERS:
        _load(LEARNERS[chosen[1]].module).add_arguments(learners[chosen[1]])
    bench = commands.add_parser("bench", help="measure the time of each building block on this machine")
    bench.add_argument("--json", metavar="FILE", help="also write the rows to this file")
    bench.add_argument("--only", metavar="NAME", help="measure only the rows whose name contains this")
    bench.add_argument("--compare", metavar="FILE", help="say what changed since --json wrote this file")
    bench.add_argument(
        "--fail-above",
        type=positive,
        metavar="X",
        help="exit with 1 if a row takes more than X times as long as in the file to compare with",
    )
    bench.add_argument(
        "--check", action="store_true", help="exit with 1 if a row does not reach the figure wanted of it"
    )
    bench.add_argument("--quick", action="store_true", help="a few calls per row: does every row work?")
    bench.set_defaults(module="sim_bridge.bench")
    warm_up = commands.add_parser("warm-up", help="compile the numerical kernels into the disk cache")
    warm_up.set_defaults(module="sim_bridge.warm_up")
    return parser


def _add_modules(
    parser: argparse.ArgumentParser,
    noun: str,
    modules: dict[str, Choice],
    add_arguments: Callable[[argparse.ArgumentParser, str], None],
) -> dict[str, argparse.ArgumentParser]:
    """One subcommand per module; returns their parsers by name."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter  # keeps a line for each
    width = max(map(len, modules))
    lines = [f"  {name:{width}}  {summary}" for name, (_, summary) in modules.items()]
    parser.epilog = "\n".join([f"{noun} is one of these, with --help each says more:", *lines])
    names = parser.add_subparsers(dest="name", metavar=noun, required=True, help="what to run, see below")
    parsers = {}
    for name, (module, summary) in modules.items():
        parsers[name] = names.add_parser(name, description=summary)
        add_arguments(parsers[name], name)
        parsers[name].set_defaults(module=module)
    return parsers


def _demo_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    parser.add_argument(
        "--seed", type=seed, default=0, metavar="N", help="of camera noise and search (default 0)"
    )
    parser.add_argument(
        "--duration", type=positive, default=90.0, metavar="S",
        help="simulated seconds for all that happens, shared out evenly; a demo needs 35 to 50 (default 90)",
    )
    parser.add_argument(
        "--out", default=f"output/{name}", metavar="DIR", type=folder, help=f"results (default output/{name})"
    )
    parser.add_argument(
        "--viewer", action="store_true", help="open a live 3-D view in the browser, on 127.0.0.1"
    )
    parser.add_argument(
        "--real-time-factor",
        type=positive,
        default=1.0,
        metavar="X",
        help="simulated per real second (default 1)",
    )


def _experiment_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    parser.add_argument("--runs", type=count, default=100, metavar="N", help="random episodes (default 100)")
    parser.add_argument("--seed", type=seed, default=0, metavar="S", help="of the first episode (default 0)")
    out = f"output/experiment_{name}"
    parser.add_argument("--out", default=out, metavar="DIR", type=folder, help=f"results (default {out})")
    place = parser.add_mutually_exclusive_group()
    place.add_argument(
        "--jobs", type=jobs, metavar="N", help="parallel processes; 0, the default, uses every core"
    )
    place.add_argument(
        "--scheduler", metavar="ADDRESS", help="run on this Dask scheduler, for example tcp://10.0.0.1:8786"
    )
    parser.add_argument(
        "--resume", action="store_true", help="keep the finished runs of an interrupted call in --out"
    )


def _learn_arguments(parser: argparse.ArgumentParser, name: str) -> None:
    parser.add_argument("--seed", type=seed, default=0, metavar="S", help="of all that is random (default 0)")
    out = f"output/{name}{LEARNED_FILES[name]}"
    parser.add_argument(
        "--out", default=out, metavar="FILE", type=file, help=f"where to write the model (default {out})"
    )


def _load(module: str) -> ModuleType:
    try:
        return importlib.import_module(module)
    except ModuleNotFoundError as error:
        if error.name == module:
            raise VpstoError(f"this installation has no {module}") from error
        if (error.name or "").startswith(("sim_bridge", "vpsto_ros")):
            raise
        remedy = "make install, or pip install 'vpsto_ros[ros,sim]'"
        raise VpstoError(f"the Python package {error.name!r} is missing; install it: {remedy}") from error


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the ``vpsto`` command.

    Returns:
        0 on success, 1 when the run failed. A command that is not understood exits with status 2.
    """
    given = list(sys.argv[1:] if arguments is None else arguments)
    try:
        parsed = build_parser(given).parse_args(given)
        return _load(parsed.module).run(parsed)
    except VpstoError as error:
        print(f"vpsto: error: {error}", file=sys.stderr)
        return 1
    except BrokenPipeError:
        # The reader of our output left, as `| head` does; nothing can be printed any more, not even at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:
        # An output folder that cannot be written to, a full disk.
        print(f"vpsto: error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("\nstopped", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
