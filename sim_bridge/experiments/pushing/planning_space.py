"""Why the pushing planner searches in the tool's plane and not in the seven joints.

For moves between random points of the table, candidates are drawn around the direct motion as the search
would draw them: via-points in
joint space, the same via-points put back into the plane, and via-points in the plane mapped to joints. The
tool must stay within 5 mm of its
height all along.
"""

import argparse
import functools
import pathlib
import time

import numpy as np
from numpy.typing import NDArray

from sim_bridge.experiments.runs import Execution, markdown_table, print_verdict, run_trials, write_summary
from vpsto_ros.exceptions import InfeasibleError
from vpsto_ros.planning.table_path import TablePath
from vpsto_ros.planning.workspace import Workspace
from vpsto_ros.priors.smoothness import smoothness_prior
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import forward_kinematics_batch, fr3_pusher
from vpsto_ros.trajectory import Limits, OptimalBasis, synthesize, synthesize_batch

TOLERANCE = 0.005
N_VIA = 3
SPREAD = 0.06
CANDIDATES = 32
SAMPLES = 100
SPACES = {
    "joints": "via-points in the 7 joints",
    "projected": "the same, put back into the plane",
    "plane": "via-points in the plane, mapped to joints",
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Nothing beyond the options of every experiment."""


def run(arguments: argparse.Namespace) -> int:
    """Measure and print the table; 0 when the plane keeps the height about as often as the best space."""
    seeds = range(arguments.seed, arguments.seed + arguments.runs)
    execution = Execution.from_arguments(arguments)
    moves = run_trials(random_move, seeds, execution, "planning_space", warm_up=_warm_up)
    rows = {name: summarise([move[name] for move in moves]) for name in SPACES}
    folder = pathlib.Path(arguments.out)
    write_summary(
        folder, {"experiment": "planning_space", "seed": arguments.seed, "moves": arguments.runs, **rows}
    )
    header = [
        "search space",
        "variables",
        "tool within 5 mm",
        "height error, median / p99",
        "time for 32 candidates",
    ]
    table = markdown_table(header, [
        [
            SPACES[name], f"{N_VIA * (2 if name == 'plane' else 7)}", f"{100 * r['within']:.1f} %",
            f"{1e3 * r['error_p50']:.2f} / {1e3 * r['error_p99']:.2f} mm", f"{r['ms']:.2f} ms",
        ]
        for name, r in rows.items()
    ])  # fmt: skip
    (folder / "table.md").write_text(table)
    print(f"{table}\nresults in {folder}")
    good = rows["plane"]["within"] >= max(0.95, rows["joints"]["within"], rows["projected"]["within"] - 0.05)
    return print_verdict(good, "planning in the plane keeps the tool's height")


def _warm_up() -> None:
    random_move(0)


def random_move(seed: int) -> dict[str, tuple[NDArray, float]]:
    """One random move planned in the three spaces; see :meth:`Comparison.move`."""
    rng = np.random.default_rng([seed, 3])
    comparison = shared_comparison()
    return comparison.move(comparison.random_ends(rng), rng)


@functools.cache
def shared_comparison() -> "Comparison":
    """One for all moves of a process: its maps take longer to build than a move to plan."""
    return Comparison()


def summarise(results: list[tuple[NDArray, float]]) -> dict[str, float]:
    """Height errors and times over all moves."""
    errors = np.concatenate([errors for errors, _ in results])
    return {
        "candidates": len(errors),
        "within": float((errors <= TOLERANCE).mean()),
        "error_p50": float(np.median(errors[np.isfinite(errors)])),
        "error_p99": float(np.quantile(errors[np.isfinite(errors)], 0.99)),
        "ms": 1e3 * float(np.median([seconds for _, seconds in results])),
    }


class Comparison:
    """The same move planned in three spaces."""

    def __init__(self) -> None:
        self.robot = fr3_pusher()
        self.map = TableMap(self.robot, 0.02)
        self.path = TablePath(self.robot, self.map)
        self.workspace = Workspace()
        self.basis = OptimalBasis.uniform(N_VIA)
        self.limits = Limits(np.full(2, 0.35), np.full(2, 1.8))

    def random_ends(self, rng: np.random.Generator) -> NDArray:
        """Two points of the tool's region, 10 to 40 cm apart, shape (2, 2) [m]."""
        while True:
            ends = rng.uniform([0.3, -0.35], [0.72, 0.35], (2, 2))
            if (
                0.1 <= np.hypot(*(ends[1] - ends[0])) <= 0.4
                and not self.workspace.tool_excess(ends[None]).any()
            ):
                return ends

    def move(self, corners: NDArray, rng: np.random.Generator) -> dict[str, tuple[NDArray, float]]:
        """Height errors [m] of the candidates and the time [s] to synthesise them, for each space."""
        joints = self.map.joints(corners)
        jacobian = np.linalg.norm(self.map.jacobian(corners[:1])[0])
        results = {}
        for name in SPACES:
            plane = name == "plane"
            ends = corners if plane else joints
            still = np.zeros(ends.shape[1])
            spread = SPREAD if plane else SPREAD * jacobian / np.sqrt(7.0)
            prior = smoothness_prior(self.basis, ends[0], still, ends[1], still, 2.0, spread=spread)
            points = prior.sample(rng, CANDIDATES)
            heights = self._heights(name, ends, points)
            begin = time.thread_time()
            self._candidates(name, ends, points)
            results[name] = heights, time.thread_time() - begin
        return results

    def _candidates(self, name: str, ends: NDArray, points: NDArray) -> None:
        """What planning does with a population: synthesise it; in the plane, map the best one to joints."""
        if name == "plane":
            still = np.zeros(2)
            synthesize_batch(
                self.basis, _between(ends, points), still, still, self.limits, SAMPLES, derivatives=False
            )
            self._plane(ends, points[:1])
        else:
            self._heights(name, ends, points)

    def _heights(self, name: str, ends: NDArray, points: NDArray) -> NDArray:
        if name == "plane":
            return self._plane(ends, points)
        if name == "projected":
            points = np.stack([self._projected(candidate) for candidate in points])
        return self._joints(ends, points)

    def _projected(self, joints: NDArray) -> NDArray:
        tool = self.map.tool(joints)
        radius = np.linalg.norm(tool, axis=1, keepdims=True)
        low, high = self.map.radius_range
        return self.map.joints(tool * np.clip(radius, low, high) / radius)

    def _joints(self, ends: NDArray, points: NDArray) -> NDArray:
        still = np.zeros(7)
        batch = synthesize_batch(
            self.basis, _between(ends, points), still, still, self.robot.limits, SAMPLES, derivatives=False
        )
        heights = forward_kinematics_batch(batch.position.reshape(-1, 7))[:, 2].reshape(len(points), -1)
        return np.abs(heights - self.map.height).max(axis=1)

    def _plane(self, ends: NDArray, points: NDArray) -> NDArray:
        errors = []
        for candidate in points:
            keys = np.concatenate([ends[:1], candidate, ends[1:]])
            motion = synthesize(self.basis, keys, np.zeros(2), np.zeros(2), self.limits)
            try:
                joints = self.path.joints(motion, self.map.joints(ends[:1])[0], np.zeros(7))
            except InfeasibleError:
                # The arm would leave the table or its limits: not a candidate that works.
                errors.append(np.inf)
                continue
            times = np.linspace(joints.start_time, joints.end_time, SAMPLES)
            errors.append(np.abs(forward_kinematics_batch(joints(times))[:, 2] - self.map.height).max())
        return np.array(errors)


def _between(ends: NDArray, points: NDArray) -> NDArray:
    """Key positions (B, P + 2, n): candidates (B, P, n) between two ends (2, n)."""
    first, last = (np.broadcast_to(end, (len(points), 1, len(end))) for end in ends)
    return np.concatenate([first, points, last], axis=1)
