"""Figs. 6.6 and 6.7: candidates drawn with and without the contact prior, in the plane and in 14 joints.

The balls of two arms start somewhere in front of a disc whose place is uncertain, which shall go somewhere.
Candidates are drawn from the smoothness prior alone (Q_q = 0) and from its product with the contact prior, as
in the first iteration of a search; neither depends on the other's random numbers. A candidate touches if
some particle of the belief is in contact at some step; what comes of the motion does not matter here.

In joint space the package's contact prior also asks that the balls keep their height, eq. (6.43) for every
point; shares are counted with and without regard to the height.
"""

import argparse
import dataclasses
import itertools
import pathlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.belief import bimanual, contact_prior_figure
from sim_bridge.experiments.belief.models import THESIS, disc_belief, mean_interval, mean_text
from sim_bridge.experiments.runs import Execution, markdown_table, print_verdict, run_trials, write_summary
from vpsto_ros.planning.belief_space.config import RobustPushingConfig
from vpsto_ros.planning.belief_space.problem import RobustPushingProblem
from vpsto_ros.planning.belief_space.spaces import JointSpace

CANDIDATES = 30
SPACES = {"plane": "plane, 4 coordinates", "joints": "14 joints"}
PRIORS = {"without": "smoothness prior alone", "with": "times contact prior"}
ALMOST_ALL, MUCH_MORE = 0.9, 2.0
"""Share of the candidates that shall touch in the plane, where the thesis says "almost all" do (6.5), and by
which factor more shall than without the prior, in either space."""


@dataclasses.dataclass(frozen=True)
class Scene:
    """A random start.

    Attributes:
        point: plane coordinates of the balls, shape (4,).
        center: expected place of the disc, shape (2,) [m].
        angle: direction in which to push [rad].
    """

    point: NDArray
    center: NDArray
    angle: float

    @classmethod
    def random(cls, rng: np.random.Generator) -> "Scene":
        """Balls about 20 cm apart and 12 to 14 cm behind the disc, which shall go to any side but back."""
        center = np.array([0.47, 0.0]) + rng.uniform(-0.02, 0.02, 2)
        ahead = rng.uniform(0.12, 0.14, 2)
        aside = rng.uniform(0.09, 0.12, 2)
        point = np.array([center[0] - ahead[0], aside[0], center[0] - ahead[1], -aside[1]])
        return cls(point, center, float(rng.uniform(-1.2, 1.2)))


def pose_problem(scene: Scene, space: str, prior: str, rng: np.random.Generator) -> RobustPushingProblem:
    """One horizon of the push."""
    config, joints = RobustPushingConfig(contact_prior=prior == "with"), space == "joints"
    pusher = bimanual.pusher(config, THESIS, joints=joints, rng=rng)
    start = bimanual.start(joints, scene.point)
    goal = scene.center + 0.1 * np.array([np.cos(scene.angle), np.sin(scene.angle)])
    return RobustPushingProblem(
        config, pusher.dynamics, pusher.space, pusher.rule, start=start, velocity=np.zeros(len(start)),
        belief=disc_belief(scene.center, bimanual.STD, bimanual.RADIUS, config.particles, rng),
        way=np.array([[*goal, 0.0]]), reach=bimanual.arms().contains,
    )  # fmt: skip


@dataclasses.dataclass(frozen=True)
class Shares:
    """Of the candidates of one population.

    Attributes:
        touch: share that touches.
        both: share in which all particles are touched at some step.
        level: share that touches and whose balls keep their height; in the plane they always do.
    """

    touch: float
    both: float
    level: float


def draw(seed: int) -> dict[tuple[str, str], Shares]:
    """One population from every distribution."""
    scene, found = Scene.random(np.random.default_rng([seed, 0])), {}
    for index, (space, prior) in enumerate(itertools.product(SPACES, PRIORS)):
        rng = np.random.default_rng([seed, 1 + index])
        problem = pose_problem(scene, space, prior, rng)
        outcome = problem.outcome(problem.prior().sample(rng, CANDIDATES))
        contact = outcome.prediction.contact.max(axis=1)
        level = np.ones(CANDIDATES, dtype=bool)
        if isinstance(problem.space, JointSpace):
            _, heights = problem.space.plane(outcome.motion.position)
            off = np.abs(heights - problem.space.height).max(axis=(1, 2))
            level = off <= problem.space.height_tolerance
        touches = contact > 0.0
        found[space, prior] = Shares(
            float(touches.mean()), float((contact >= 1.0).mean()), float((touches & level).mean())
        )
    return found


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Nothing beyond the options of every experiment."""


def run(arguments: argparse.Namespace) -> int:
    """Draw populations; 0 when nearly all candidates touch with the prior, and far fewer without."""
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    found = run_trials(draw, seeds, Execution.from_arguments(arguments), "contact_prior", bimanual.arms)
    rows: dict[str, dict[str, Any]] = {
        f"{space}_{prior}": {
            key: {"mean": float(np.mean(values)), "interval": mean_interval(values)}
            for key in Shares.__annotations__
            for values in ([getattr(each[space, prior], key) for each in found],)
        }
        for space in SPACES
        for prior in PRIORS
    }
    summary: dict[str, Any] = {
        "experiment": "contact_prior", "seed": arguments.seed, "runs": arguments.runs,
        "candidates": CANDIDATES, "shares": rows,
    }  # fmt: skip
    folder = pathlib.Path(arguments.out)
    write_summary(folder, summary)
    text = table(found)
    (folder / "table.md").write_text(text)
    contact_prior_figure.write(folder / "contact_prior.png", arguments.seed)
    print(f"{text}\nresults in {folder}")
    missed = missed_targets(summary)
    return print_verdict(not missed, "; ".join(missed or _checks(summary)))


def missed_targets(summary: dict[str, Any]) -> list[str]:
    """What falls short, in words."""
    return [text for text, good in _checks(summary).items() if not good]


def _checks(summary: dict[str, Any]) -> dict[str, bool]:
    """What is compared with its target, in words, and whether it is as asked."""
    touch = {name: row["touch"] for name, row in summary["shares"].items()}
    share = touch["plane_with"]["mean"]
    checks = {
        f"{SPACES['plane']}: {100 * share:.0f} % of the candidates touch with the prior (at least "
        f"{100 * ALMOST_ALL:.0f} %)": share >= ALMOST_ALL,
    }
    for space, title in SPACES.items():
        least, most = touch[f"{space}_with"]["interval"][0], touch[f"{space}_without"]["interval"][1]
        checks[
            f"{title}: {100 * least:.0f} % or more touch with the prior, {100 * most:.0f} % or fewer without "
            f"(more than {MUCH_MORE:g} times as many)"
        ] = least > MUCH_MORE * most
    return checks


def table(found: list[dict[tuple[str, str], Shares]]) -> str:
    """One row per space and prior."""
    header = [
        "search space", "candidates from", "touch (95 %)", "touch all particles", "touch, at their height",
    ]  # fmt: skip
    rows = [
        [
            SPACES[space], PRIORS[prior],
            *(
                f"{mean_text([getattr(each[space, prior], key) for each in found], 100.0, '.0f')} %"
                for key in Shares.__annotations__
            ),
        ]
        for space in SPACES
        for prior in PRIORS
    ]  # fmt: skip
    return markdown_table(header, rows)
