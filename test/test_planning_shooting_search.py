"""Direct search of shots (5.12): against sampled outcomes, a dense search, and what a shot must keep."""

import dataclasses
import math

import numpy as np
import pytest
from strikes_bench import StandInStrikes

from vpsto_ros.contact.puck import SHIPPED, PuckModel
from vpsto_ros.estimation.puck_motion import hit_time
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.planning.hockey.shooting_config import SETTINGS, ShootingConfig, ShootingObjective
from vpsto_ros.planning.hockey.shooting_search import ShotSearch, Strokes

MODEL, STRIKES = PuckModel.load(SHIPPED), StandInStrikes()
DISTANCE = MODEL.table.contact_distance
COVARIANCE = np.diag([2e-3, 2e-3, 1e-2, 1e-2]) ** 2
PUCKS = np.array(
    [[-0.4, 0.1, 0.0, 0.0], [-0.55, -0.25, 0.2, 0.3], [-0.3, 0.0, -0.4, 0.1], [-0.5, 0.3, 0.0, -0.3]]
)


def search(setting="conservative", strikes=STRIKES, **options):
    return ShotSearch(MODEL, strikes, ShootingConfig(objective=SETTINGS[setting], **options))


def stroke(puck, angle, speed, covariance=COVARIANCE):
    return Strokes(np.zeros(1), puck[None], covariance[None], np.array([angle]), np.array([speed]))


def sampled_goals(puck, angle, speed, covariance, aim_std, speed_std, rng, count=1500):
    """Share of samples that score: the touch is found exactly for each, and its normal from it."""
    normal = np.array([math.cos(angle), math.sin(angle)])
    tangent = np.array([-normal[1], normal[0]])
    pucks = puck + rng.standard_normal((count, 4)) @ np.linalg.cholesky(covariance + 1e-15 * np.eye(4)).T
    speeds = speed + speed_std * rng.standard_normal(count)
    places = puck[:2] - DISTANCE * normal + aim_std * np.outer(rng.standard_normal(count), tangent)
    mallets = np.hstack([places, np.outer(speeds, normal)])
    back = 0.1  # both begin a while before
    for states in (pucks, mallets):
        states[:, :2] -= back * states[:, 2:]
    times = np.array([hit_time(p - m, DISTANCE) for p, m in zip(pucks, mallets, strict=True)])
    for states in (pucks, mallets):
        states[:, :2] += times[:, None] * states[:, 2:]
    mean, spread = MODEL.hit(pucks, mallets)
    noise = rng.standard_normal((count, 4, 1))
    after = mean + (np.linalg.cholesky(spread + 1e-14 * np.eye(4)) @ noise)[..., 0]
    return float(MODEL.outlook(after, np.zeros((count, 4, 4))).goal.mean())


@pytest.mark.parametrize(
    ("puck", "angle", "speed", "aim_std", "speed_std"),
    [
        ([-0.4, 0.1, 0.0, 0.0], -0.077, 1.0, 0.0, 0.0),
        ([-0.4, 0.1, 0.0, 0.0], -0.11, 1.0, 0.004, 0.0),
        ([-0.4, 0.1, 0.0, 0.3], -0.15, 1.1, 0.002, 0.2),
        ([-0.4, 0.1, -0.4, -0.2], 0.0, 1.1, 0.003, 0.05),
        ([-0.4, 0.1, 0.0, 0.0], 0.62, 1.3, 0.002, 0.1),
    ],
)
def test_chances_are_those_of_sampled_touches(puck, angle, speed, aim_std, speed_std):
    """Uncertain pucks and mallets that are off: the touch comes at another time, with another normal."""
    puck, covariance = np.array(puck), np.diag([3e-3, 4e-3, 0.02, 0.03]) ** 2
    covariance[0, 1] = covariance[1, 0] = 4e-6
    found = search(aim_std=aim_std, speed_std=speed_std).outlook(stroke(puck, angle, speed, covariance))
    rng = np.random.default_rng(1000)
    share = sampled_goals(puck, angle, speed, covariance, aim_std, speed_std, rng)
    assert found.goal[0] == pytest.approx(share, abs=0.06)
    assert 0.05 < share < 0.999


def test_errors_of_the_mallet_cost_chance():
    puck = PUCKS[0]
    chances = [
        search(aim_std=std).outlook(stroke(puck, -0.077, 1.0)).goal[0] for std in (0.0, 0.003, 0.01)
    ]
    assert chances[0] > chances[1] > chances[2] + 0.05


@pytest.mark.parametrize("setting", SETTINGS)
def test_the_best_shot_is_that_of_a_dense_search(setting):
    finder = search(setting)
    dense = np.linspace(STRIKES.angle[0], STRIKES.angle[-1], 2801)
    for puck in PUCKS:
        best = finder.best(3.0, puck, COVARIANCE)
        largest = finder.speeds(np.repeat(puck[None, :2], len(dense), axis=0), dense)
        angles, speeds = np.tile(dense, 2), np.concatenate([largest, 0.7 * largest])
        there = speeds > 0.0
        count = there.sum()
        strokes = Strokes(
            np.zeros(count), np.tile(puck, (count, 1)), np.tile(COVARIANCE, (count, 1, 1)), angles[there],
            speeds[there],
        )  # fmt: skip
        outlook = finder.outlook(strokes)
        wanted = finder.config.objective.scores(outlook).max()
        assert 0.97 * wanted <= best.value <= wanted + 1e-3
        assert best.time == 3.0 and best.goal > 0.5 and finder.taken(best)


def test_settings_trade_chance_for_speed():
    for puck in PUCKS:
        shots = [search(setting).best(0.0, puck, COVARIANCE) for setting in SETTINGS]
        assert shots[0].goal >= shots[1].goal - 1e-3 and shots[1].goal >= shots[2].goal - 1e-3
        assert shots[0].goal_speed <= shots[1].goal_speed + 0.02 <= shots[2].goal_speed + 0.04


def test_the_mallet_touches_the_puck_along_its_motion_and_stays_off_the_walls():
    finder = search()
    for puck in (*PUCKS, np.array([-0.6, 0.4, 0.0, 0.0]), np.array([-0.69, -0.39, 0.0, 0.0])):
        shot = finder.best(0.0, puck, COVARIANCE)
        offset = puck[:2] - shot.mallet[:2]
        assert np.linalg.norm(offset) == pytest.approx(MODEL.table.contact_distance)
        assert shot.mallet[2:] @ offset == pytest.approx(shot.speed * MODEL.table.contact_distance)
        walls = np.array([MODEL.table.half_length, MODEL.table.half_width])
        assert (np.abs(shot.mallet[:2]) + MODEL.table.mallet_radius < walls).all()
        assert shot.speed <= STRIKES.speeds(puck[None, :2], np.array([shot.angle]))[0] + 1e-9


def test_a_mirrored_puck_is_shot_in_the_mirror():
    mirror = np.array([1.0, -1.0, 1.0, -1.0])
    for setting in SETTINGS:
        for puck in PUCKS:
            shot, twin = (search(setting).best(0.0, state, COVARIANCE) for state in (puck, mirror * puck))
            assert twin.value == pytest.approx(shot.value, abs=2e-3)
            if setting == "conservative":
                assert twin.angle == pytest.approx(-shot.angle, abs=0.02)


def test_banks_can_be_demanded():
    objective = dataclasses.replace(SETTINGS["conservative"], least_banks=1, beta=0.3)
    finder = ShotSearch(MODEL, STRIKES, ShootingConfig(objective=objective))
    shot = finder.best(0.0, PUCKS[0], COVARIANCE)
    assert shot.banks >= 1 and shot.goal > 0.3 and finder.taken(shot)
    assert search().best(0.0, PUCKS[0], COVARIANCE).banks == 0


def test_what_breaks_the_chance_constraint_is_only_a_fallback():
    strict = ShootingObjective(1.0, 0.0, 0.999)
    uncertain = np.diag([0.02, 0.02, 0.2, 0.2]) ** 2
    for fallback in (False, True):
        finder = ShotSearch(MODEL, STRIKES, ShootingConfig(objective=strict, fallback=fallback))
        shot = finder.best(0.0, PUCKS[0], uncertain)
        assert shot.goal < 0.999 and finder.taken(shot) == fallback


def test_a_place_without_strikes_gives_no_shot():
    class Nothing(StandInStrikes):
        def speeds(self, puck, angles):
            return np.zeros(len(angles))

    assert search(strikes=Nothing()).best(0.0, PUCKS[0], COVARIANCE) is None


def test_strikes_with_another_mallet_than_the_model_s_are_refused():
    others = StandInStrikes()
    others.contact_distance = MODEL.table.contact_distance + 0.001
    with pytest.raises(ConfigurationError, match=r"0.0798 m apart.*0.0808 m by the strikes; `vpsto"):
        search(strikes=others)


def test_a_run_up_needs_room():
    finder, longer = search(), search(run_up=0.2)
    place, angle = np.array([[-0.69, 0.0]]), np.array([0.0])
    assert finder.fits(place, angle)[0] and not longer.fits(place, angle)[0]


def test_scores_put_what_is_allowed_first():
    objective = ShootingObjective(1.0, 0.2, 0.5, 1)
    mallets = np.array([[-0.48, 0.1, v, w] for v in (0.5, 1.0) for w in (0, 0.7)])
    outlook = dataclasses.replace(
        MODEL.shots(PUCKS[0], COVARIANCE, mallets), goal=np.array([0.9, 0.6, 0.4, 0.0]),
        speed=np.array([1.0, 2.0, 3.0, math.nan]), banks=np.array([0, 1, 1, 2]),
    )  # fmt: skip
    np.testing.assert_allclose(objective.values(outlook), [1.1, 1.0, 1.0, 0.0])
    np.testing.assert_array_equal(objective.allowed(outlook), [False, True, False, False])
    assert list(np.argsort(-objective.scores(outlook))) == [1, 2, 3, 0]


@pytest.mark.parametrize(
    "options", [{"beta": 1.5}, {"lambda1": -1.0}, {"lambda1": 0.0, "lambda2": 0.0}, {"least_banks": -1}]
)
def test_nonsense_is_refused(options):
    with pytest.raises(ConfigurationError, match="ShootingObjective"):
        ShootingObjective(**options)


def test_the_settings_are_those_of_the_thesis_but_for_one_threshold():
    found = [(o.lambda1, o.lambda2, o.beta, o.least_banks) for o in SETTINGS.values()]
    assert found == [(1.0, 0.0, 0.5, 0), (1.0, 0.2, 0.5, 0), (0.0, 1.0, 0.7, 0)]
    with pytest.raises(ConfigurationError, match="time_step"):
        ShootingConfig(time_step=0.0)
