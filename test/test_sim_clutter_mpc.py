"""Model-predictive control in the cluttered plane: discs, the baseline, and runs from end to end."""

import argparse
import copy
import dataclasses
import json

import numpy as np
import pytest

from sim_bridge import cli
from sim_bridge.experiments.clutter import clutter_2d_mpc, moving_discs, mpc_runs, mppi, mppi_tuning
from sim_bridge.experiments.clutter.moving_discs import BouncingDisc, random_discs, stays
from sim_bridge.experiments.clutter.mpc_runs import PERIOD, Task, VpstoController, run_task
from sim_bridge.experiments.clutter.world import GOAL, LIMITS, STARTS
from vpsto_ros.planning.joint_space_problem import OnlineJointSpaceProblem
from vpsto_ros.trajectory import OptimalBasis, Trajectory, synthesize

START = "start_0.10_0.20"
STILL = np.zeros(2)


def disc(velocity=(0.05, -0.03), centre=(0.3, 0.2), radius=0.03):
    lower, upper = moving_discs.REGION[0] + radius, moving_discs.REGION[1] - radius
    return BouncingDisc(np.array(centre), np.array(velocity), radius, lower, upper)


def straight(begin, end, limits=LIMITS):
    return synthesize(OptimalBasis.uniform(0), np.array([begin, end]), STILL, STILL, limits)


@pytest.mark.parametrize("velocity", [(0.05, -0.03), (-0.05, 0.0), (0.01, 0.04), (0.0, 0.0)])
def test_a_disc_moves_straight_and_is_reflected(velocity):
    moving = disc(velocity)
    position, now, step = moving.centre.copy(), np.array(velocity), 1e-3
    flips = []
    for k in range(20_000):
        if k % 500 == 0:
            np.testing.assert_allclose(moving.state(k * step)[0], position, atol=2e-3)
        position = position + step * now
        out = (position < moving.lower) | (position > moving.upper)
        if out.any():
            flips.append(k * step)
            now = np.where(out, -now, now)
    np.testing.assert_allclose(moving.turns(20.0), flips, atol=0.02)
    assert (len(flips) > 1) == bool(np.any(velocity))
    for turn in moving.turns(20.0):
        assert (moving.state(turn - 1e-6)[1] != moving.state(turn + 1e-6)[1]).any()


@pytest.mark.parametrize("seed", range(1000, 1008))
def test_random_discs_do_not_make_collisions_unavoidable(seed):
    start = STARTS[START]
    discs = random_discs(np.random.default_rng(seed), start, 20.0)
    again = random_discs(np.random.default_rng(seed), start, 20.0)
    assert len(discs) in range(moving_discs.COUNTS[0], moving_discs.COUNTS[1] + 1)
    for one, other in zip(discs, again, strict=True):
        np.testing.assert_array_equal(one.centre, other.centre)
        path = np.array([one.state(time)[0] for time in np.linspace(0.0, 20.0, 4001)])
        assert np.hypot(*(path - GOAL).T).min() > one.radius + 0.025
        assert np.hypot(*(one.centre - start)) > one.radius + 0.035
        assert path[:, 0].min() - one.radius > 0.169, "out of the bay left of the obstacle L"
        assert np.hypot(*one.velocity) <= 0.5 * LIMITS.velocity.min() + 1e-12


def test_collisions_with_discs_are_found_across_their_turns():
    moving = disc((0.05, 0.0), centre=(0.45, 0.06))  # turns at x = 0.47 after 0.4 s and comes back
    motion = straight([0.2, 0.06], [0.48, 0.06])
    times = np.linspace(0.0, motion.end_time, 20_001)
    inside = np.array([np.hypot(*(motion(t) - moving.state(t)[0])) < moving.radius for t in times])
    found = stays((moving,), motion)
    assert inside.any() and found
    assert found[0].start == pytest.approx(times[inside.argmax()], abs=1e-3)
    assert {stay.obstacle for stay in found} == {"disc 1"}
    assert stays((), motion) == []


def test_simulated_samples_keep_the_limits_and_follow_where_they_can():
    rng = np.random.default_rng(1)
    wanted = 0.2 * rng.standard_normal((50, 30, 2))
    velocity = np.array([0.08, -0.1])
    bounds = PERIOD, LIMITS.velocity, LIMITS.acceleration
    velocities, positions = mppi.simulate(np.array([0.2, 0.3]), velocity, wanted, False, *bounds)
    steps = np.diff(velocities, axis=1, prepend=np.broadcast_to(velocity, (50, 1, 2)))
    assert (np.abs(velocities) <= LIMITS.velocity).all()
    assert (np.abs(steps) <= PERIOD * LIMITS.acceleration + 1e-15).all()
    free = (np.abs(wanted) <= LIMITS.velocity) & (np.abs(steps) < PERIOD * LIMITS.acceleration - 1e-12)
    assert free.mean() > 0.05
    np.testing.assert_allclose(velocities[free], wanted[free], atol=1e-15)
    before = velocities - steps
    np.testing.assert_allclose(
        positions, [0.2, 0.3] + np.cumsum(0.5 * PERIOD * (before + velocities), axis=1), atol=1e-14
    )
    same = mppi.simulate(np.array([0.2, 0.3]), velocity, steps / PERIOD, True, *bounds)
    np.testing.assert_allclose(same, (velocities, positions), atol=1e-14)


def test_the_baseline_is_good_where_nothing_is_in_the_way():
    baseline = clutter_2d_mpc.MPPI[clutter_2d_mpc.SHORT]
    result = run_task(Task(baseline, "mppi", "open", False, 1000))
    quickest = straight([0.25, 0.3], GOAL).duration
    assert result.success and result.time_to_goal < quickest + 0.4


def test_drawing_accelerations_stops_and_arrives_where_nothing_is_in_the_way():
    settings = dataclasses.replace(clutter_2d_mpc.MPPI[clutter_2d_mpc.SHORT], accelerations=True)
    baseline = mppi.Mppi(LIMITS, settings, np.random.default_rng(0))
    velocity = np.array([0.08, -0.05])
    after = baseline._simulated(STILL, velocity, baseline._stop(velocity)[None]).velocities[0]
    np.testing.assert_allclose(after[0], velocity - np.sign(velocity) * PERIOD * LIMITS.acceleration)
    np.testing.assert_allclose(after[4:], 0.0, atol=1e-15)
    result = run_task(Task(settings, "mppi", "open", False, 1000))
    assert result.contact is None and result.broken == []


def test_both_controllers_simulate_the_same_number_of_points():
    search = clutter_2d_mpc.VPSTO.online.search
    points = search.population * search.iterations * clutter_2d_mpc.VPSTO.samples
    for config in clutter_2d_mpc.MPPI.values():
        used = config.samples * config.steps * config.iterations
        assert config.points == points and 0.95 * points <= used <= points


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize("start", STARTS)
def test_runs_reach_the_goal_and_can_be_repeated(start, moving):
    one, two = (run_task(Task(clutter_2d_mpc.VPSTO, "vpsto", start, moving, 1001)) for _ in range(2))
    assert one.success and one.time_to_goal < 8.0
    assert one.contact is None and one.broken == []
    np.testing.assert_array_equal(one.motion.coefficients, two.motion.coefficients)
    assert one.modes == two.modes
    assert np.allclose(np.diff(one.motion.times).sum(), len(one.step_seconds) * PERIOD)
    if moving:
        dense = np.linspace(0.0, one.motion.end_time, 3000)
        gaps = [np.hypot(*(one.motion(t) - d.state(t)[0])) - d.radius for t in dense for d in one.discs]
        assert min(gaps) > 0.0


def test_a_collision_and_a_broken_limit_are_counted(monkeypatch):
    class Ghost(VpstoController):
        """Drives straight through everything, and at full speed at once."""

        def executed(self, begin, end):
            ends = (STARTS[START] + min(t / 3.0, 1.0) * (GOAL - STARTS[START]) for t in (begin, end))
            return Trajectory.from_points(np.array([begin, end]), np.stack(list(ends)))

    monkeypatch.setattr(mpc_runs, "VpstoController", Ghost)
    result = run_task(Task(clutter_2d_mpc.VPSTO, "vpsto", START, False, 1000, longest=3.2))
    assert result.contact is not None and result.contact[0] == "L"
    assert result.time_to_goal is not None and not result.success
    assert any("steps" in text for text in result.broken)


def test_the_duration_of_a_shifted_plan_does_not_jump(monkeypatch):
    """The largest root of 3.2.1 may lie far above what is left of a plan; with few via-points it does not."""
    ratios = []

    class Watched(OnlineJointSpaceProblem):
        def shifted(self, previous, n_via):
            points = super().shifted(previous, n_via)
            ratios.append(self.trajectory(points).duration / (previous.end_time - self.start_time))
            return points

    monkeypatch.setattr("vpsto_ros.planning.joint_space.OnlineJointSpaceProblem", Watched)
    for seed in range(1000, 1003):
        run_task(Task(clutter_2d_mpc.VPSTO, "vpsto", START, False, seed))
    assert len(ratios) > 200 and max(ratios) < 1.2


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("clutter_2d_mpc")
    quick = {horizon: dataclasses.replace(o, points=1000) for horizon, o in clutter_2d_mpc.MPPI.items()}
    arguments = argparse.Namespace(
        runs=1, seed=1000, out=folder, jobs=1, scheduler=None, resume=False, no_sweep=True, no_animation=True,
        tune=False,
    )
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(clutter_2d_mpc, "MPPI", quick)
        return clutter_2d_mpc.run(arguments), folder


def test_the_experiment_writes_what_it_found(finished, capsys):
    status, folder = finished
    summary = json.loads((folder / "summary.json").read_text())
    assert status == 0
    assert summary["success_rate"] == 1.0 and summary["runs"] == 2
    assert summary["collisions"] == summary["limit_violations"] == 0
    assert 0.0 <= summary["baseline_success_rate"] <= 1.0
    assert summary["moving"]["success_rate"] == 1.0
    assert sum(summary["modes"].values()) == pytest.approx(1.0)
    for name in ("table.md", "paths.png", "profiles.png"):
        assert (folder / name).stat().st_size > 300


@pytest.mark.parametrize("world", ["static", "moving"])
@pytest.mark.parametrize(
    ("key", "value"), [("success_rate", 0.99), ("collisions", 1), ("limit_violations", 2)]
)
def test_the_verdict_fails_when_anything_falls_short(finished, world, key, value):
    summary = json.loads((finished[1] / "summary.json").read_text())
    assert clutter_2d_mpc.shortcomings(summary) == []
    worse = copy.deepcopy(summary)
    (worse if world == "static" else worse["moving"])[key] = value
    (text,) = clutter_2d_mpc.shortcomings(worse)
    assert text.startswith(world)


def tuned(times, open_times=(2.0,) * 8):
    starts = zip(mppi_tuning.STARTS, (times, open_times), strict=True)
    return {s: {"successes": len(t) - t.count(None), "times_s": list(t)} for s, t in starts}


@pytest.mark.parametrize(
    ("other", "better"),
    [
        (tuned([5.0 + 0.1 * k for k in range(8)]), True),
        (tuned([5.9 + 0.1 * k for k in range(8)]), False),  # by luck
        (tuned([5.0] * 7 + [None]), False),  # quicker, but not as sure
        (tuned([7.0] * 8, [1.8 + 0.01 * k for k in range(8)]), True),
        (tuned([7.0] * 8), False),
    ],
)
def test_a_setting_is_better_when_luck_does_not_explain_it(other, better):
    chosen = tuned([6.0 + 0.1 * k for k in range(8)])
    figures = {(1.5, mppi_tuning.CHOSEN): chosen, (1.5, "noise 9"): other}
    assert mppi_tuning.clearly_better(figures) == ["horizon 1.5 s is better with noise 9"] * better
    sure = {(1.5, mppi_tuning.CHOSEN): tuned([None] * 8), (1.5, "noise 9"): tuned([9.0] * 8)}
    assert mppi_tuning.clearly_better(sure)


def test_tuning_writes_what_other_settings_do(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(mppi_tuning, "STARTS", ("open",))
    monkeypatch.setattr(mppi_tuning, "LONGEST", 0.5)
    chosen = {1.0: dataclasses.replace(clutter_2d_mpc.MPPI[1.0], points=500)}
    monkeypatch.setattr(clutter_2d_mpc, "MPPI", chosen)
    assert cli.main(
        ["experiment", "clutter_2d_mpc", "--tune", "--runs", "1", "--jobs", "1", "--out", str(tmp_path)]
    ) == 0  # fmt: skip
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["seed"] == 1000, "no seed that a reported figure uses"
    names = [each["setting"] for each in summary["settings"]]
    assert names[0] == mppi_tuning.CHOSEN and "accelerations" in names and len(set(names)) == len(names) > 7
    assert capsys.readouterr().out.strip().splitlines()[-1].startswith("verdict: passed")


def test_no_task_is_run_twice():
    tasks = [task for group in clutter_2d_mpc._tasks(range(3), sweep=True).values() for task in group]
    assert len(dict.fromkeys(tasks)) == len(tasks) - 2 * 3, "the short horizon belongs to two groups"


def test_baseline_options_are_checked():
    with pytest.raises(Exception, match="horizon"):
        dataclasses.replace(clutter_2d_mpc.MPPI[1.0], horizon=0.0)
