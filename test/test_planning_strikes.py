"""The table of strikes: what it promises holds along whole strikes; damaged files are told."""

import json
import math

import numpy as np
import pytest
from scipy.interpolate import RegularGridInterpolator

from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.planning.hockey.rules import PlayRules
from vpsto_ros.planning.hockey.strike_tabulation import tabulate
from vpsto_ros.planning.hockey.strikes import SHIPPED, StrikeConfig, StrikeTable
from vpsto_ros.robot.iiwa import iiwa14
from vpsto_ros.robot.iiwa_kinematics import arm_points
from vpsto_ros.trajectory import Trajectory

HOME = np.array(PlayRules().home)
MIRROR = np.array([-1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0])
ROBOT = iiwa14()
REMEDY = r"strikes\.np.*`vpsto learn strikes`"  # the file, and what to do


@pytest.fixture(scope="module")
def shipped():
    return StrikeTable.load()


@pytest.fixture(scope="module")
def small():
    """A table that is searched here."""
    grids = [-0.6, -0.4], [-0.2, 0.0, 0.2], np.deg2rad([-40.0, 0.0, 40.0])
    config = StrikeConfig(lead_weights=(0.1, 0.5, 1.0, 3.0))
    return tabulate(*grids, 0.0798, np.random.default_rng(1010), config=config, effort=800)


def entries(table, count, seed):
    """Some entries that have a strike."""
    cells = np.argwhere(table.speed > 0.0)
    return [tuple(cell) for cell in np.random.default_rng(seed).permutation(cells)[:count]]


def wanted(table, cell):
    """Place of the universal joint, base frame, and direction of its motion."""
    _, i, j, k = cell
    along = np.array([math.cos(table.angle[k]), math.sin(table.angle[k])])
    return np.array([table.x[i], table.y[j]]) + table.rules.table - table.contact_distance * along, along


# A strike as a whole.


def curvature(q, rates):
    """Least joint acceleration that keeps the universal joint straight, by central differences."""
    step = 1e-5
    turn = (ROBOT.jacobian(q + step * rates) - ROBOT.jacobian(q - step * rates))[:3] / (2.0 * step)
    return -np.linalg.pinv(ROBOT.jacobian(q)[:3]) @ turn @ rates


def strike(table, cell, step=1e-3):
    """Joint positions and velocities (N, 7) every millisecond: even acceleration, hold, even braking."""
    config, q, rates = table.config, table.posture[cell], table.rates[cell]
    kappa, way, pace, rows = curvature(q, rates), -0.5 * config.run_up, 0.0, []
    for t in np.arange(0.0, config.run_up + config.hold + config.brake, step):
        change = 1.0 / config.run_up if t < config.run_up else 0.0
        if t >= config.run_up + config.hold:
            change = -1.0 / config.brake
        rows.append((q + way * rates + 0.5 * way**2 * kappa, pace * (rates + way * kappa)))
        way += step * (pace + 0.5 * step * change)
        pace = min(max(pace + step * change, 0.0), 1.0)
    return tuple(np.stack(column) for column in zip(*rows, strict=True))


@pytest.mark.parametrize("which", ["shipped", "small"])
def test_whole_strikes_keep_limits_plane_and_places(which, request):
    table = request.getfixturevalue(which)
    rules, limits = table.rules, table.rules.limits(ROBOT)
    lower, upper = limits.position_range
    for cell in entries(table, 80, 1011):
        q, qd = strike(table, cell)
        # The search looks at nine instants, and none is the end of the hold, where joints may be 2 % faster;
        # planning leaves 3 % of what the rules allow.
        assert np.all(np.abs(qd) <= 1.02 * limits.velocity), cell
        assert np.all(np.abs(qd) <= 0.95 * ROBOT.limits.velocity), cell
        assert np.all(np.abs(np.diff(qd, axis=0)) <= 1.05e-3 * limits.acceleration), cell
        assert np.all((q > lower) & (q < upper)), cell
        points = arm_points(q)
        joint, low = points[:, 3], points[:, 1:3, 2].min()
        # The search weighs breaches, in m/s, against speed; this is what the largest one that it takes means.
        assert np.abs(joint[:, 2] - rules.height).max() < 0.4 * rules.height_tolerance + 1e-3, cell
        assert joint[:, 0].min() > rules.least_x - 1.5e-3, cell
        assert np.abs(joint[:, 1]).max() < rules.most_y + 1.5e-3, cell
        assert low > rules.clearance - 3e-3, cell
        rods = np.array([ROBOT.forward(row)[1][2, 2] for row in q[::20]])
        assert rods.max() < -math.cos(rules.rod_tilt) + 6e-3, cell


def test_strikes_run_straight_through_the_touch(shipped):
    for cell in entries(shipped, 60, 1012):
        q, _ = strike(shipped, cell)
        place, along = wanted(shipped, cell)
        off = (arm_points(q)[:, 3, :2] - place) @ [-along[1], along[0]]
        assert np.abs(off).max() < 0.02, cell
        first = round(1000.0 * shipped.config.run_up)
        assert np.abs(off[first : first + 20]).max() < 1e-3, cell


def deviations(table, cell, times, motion):
    """How far the universal joint is off its even way, in mm: aside, along and up, each the largest."""
    along = wanted(table, cell)[1]
    way = arm_points(motion(times))[:, 3] - arm_points(table.posture[cell][None])[0, 3]
    off = way[:, :2] @ [-along[1], along[0]], way[:, :2] @ along - table.speed[cell] * times, way[:, 2]
    return [1e3 * np.abs(row).max() for row in off]


def test_after_the_touch_the_mallet_goes_straight_on_evenly(shipped):
    """At full speed, for the 18 ms of a contact and for as long as it is followed through."""
    hold, straight, bent, touched = shipped.config.hold, [], [], []
    for cell in entries(shipped, 150, 1062):
        q, qd = shipped.posture[cell], shipped.rates[cell]
        after, rates = shipped.straight_on(q, qd, hold)
        on = Trajectory.from_points([0.0, hold], np.stack([q, after]), np.stack([qd, rates]))
        times = np.linspace(0.0, hold, 46)
        straight.append(deviations(shipped, cell, times, on))
        touched.append(deviations(shipped, cell, times[times < 0.0185], on))
        bent.append(deviations(shipped, cell, times, lambda t, q=q, qd=qd: q + t[:, None] * qd))
    straight, bent, touched = np.array(straight), np.array(bent), np.array(touched)
    assert touched[:, 0].max() < 0.1 and touched.max() < 0.2
    assert np.median(straight[:, 0]) < 0.12 and straight[:, 0].max() < 0.4
    assert straight.max() < 1.3
    # With even joint velocities it turns off by some degrees.
    assert np.median(bent[:, 0]) > 10.0 * np.median(straight[:, 0]) and bent[:, 0].max() > 5.0
    assert np.mean(straight[:, 0] < bent[:, 0]) > 0.95


def test_straight_on_for_no_time_is_the_touch_itself(shipped):
    cell = entries(shipped, 1, 1063)[0]
    after, rates = shipped.straight_on(shipped.posture[cell], shipped.rates[cell], 0.0)
    np.testing.assert_array_equal(after, shipped.posture[cell])
    np.testing.assert_array_equal(rates, shipped.rates[cell])


def test_straight_on_is_curved_by_the_least_joint_acceleration(shipped):
    for cell in entries(shipped, 20, 1064):
        q, qd = shipped.posture[cell], shipped.rates[cell]
        after, rates = shipped.straight_on(q, qd, 0.02)
        bend = curvature(q, qd)
        # The library's difference is one-sided, over 10 ms.
        assert np.linalg.norm((rates - qd) / 0.02 - bend) < 0.05 * np.linalg.norm(bend) + 0.1, cell
        np.testing.assert_allclose(after, q + 0.01 * (qd + rates), atol=1e-12)


@pytest.mark.parametrize("which", ["shipped", "small"])
def test_at_the_touch_place_and_velocity_are_those_of_the_entry(which, request):
    table = request.getfixturevalue(which)
    for cell in entries(table, 100, 1013):
        place, along = wanted(table, cell)
        joint, _ = ROBOT.forward(table.posture[cell])
        np.testing.assert_allclose(joint, [*place, table.rules.height], atol=1e-6)
        velocity = ROBOT.jacobian(table.posture[cell])[:3] @ table.rates[cell]
        np.testing.assert_allclose(velocity, table.speed[cell] * np.append(along, 0.0), atol=2e-5)


@pytest.mark.parametrize("which", ["shipped", "small"])
def test_the_table_is_symmetric_as_the_arm_is(which, request):
    table = request.getfixturevalue(which)
    np.testing.assert_array_equal(table.speed, table.speed[:, :, ::-1, ::-1])
    # On the middle line an entry is its own twin only where the angle is 0: there any posture will do.
    there = table.speed[..., None] * np.ones(7) > 0.0
    there[:, :, table.y == 0.0] = False
    for rows in (table.posture, table.rates):
        mirrored = MIRROR * rows[:, :, ::-1, ::-1]
        np.testing.assert_allclose(rows[there], mirrored[there], atol=1e-6)


# Between the entries.


def test_speeds_are_interpolated_as_scipy_does(shipped):
    rng = np.random.default_rng(1014)
    table = StrikeTable(
        shipped.x, shipped.y, shipped.angle, rng.uniform(0.5, 2.0, shipped.speed.shape), shipped.posture,
        shipped.rates, 0.08, shipped.config, shipped.rules,
    )  # fmt: skip
    low, high = (np.array([grid[end] for grid in table.grids]) for end in (0, -1))
    where = np.vstack([rng.uniform(low, high, (500, 3)), low, high])
    layers = [RegularGridInterpolator(table.grids, values) for values in table.speed]
    expected = np.max([layer(where) for layer in layers], axis=0)
    np.testing.assert_allclose(table.speeds(where[:, :2], where[:, 2]), expected, rtol=1e-9)


def test_there_is_no_speed_outside_nor_beside_an_entry_without_a_strike(small):
    speed = np.full(small.speed.shape, 1.5)
    speed[:, 0, 1, 1] = 0.0
    table = StrikeTable(
        small.x, small.y, small.angle, speed, small.posture, small.rates, 0.08, small.config, small.rules
    )
    inside, beside, outside = [-0.4, -0.1], [-0.5, 0.05], [-0.61, 0.0]
    np.testing.assert_allclose(table.speeds([inside, beside, outside], [0.1, 0.1, 0.1]), [1.5, 0.0, 0.0])
    np.testing.assert_allclose(table.speeds([[-0.4, 0.0], [-0.6, 0.2]], [0.0, 0.0]), 1.5)  # on entries
    assert table.speeds([inside], [0.8])[0] == 0.0
    assert table.speeds(np.zeros((0, 2)), np.zeros(0)).shape == (0,)
    assert np.isinf(table.lead(HOME, [beside, outside], [0.1, 0.1])).all()


def test_not_a_number_has_no_speed(shipped):
    assert shipped.speeds([[np.nan, 0.0], [-0.5, np.nan]], [0.0, 0.0]).tolist() == [0.0, 0.0]
    assert shipped.speeds([[-0.5, 0.0]], [np.nan])[0] == 0.0


# From a state of the mallet to one of the arm.


def contact_states(table, count, seed):
    """States (N, 4) of the mallet that the table can do, table frame."""
    rng, rows = np.random.default_rng(seed), []
    while len(rows) < count:
        low, high = (np.array([grid[end] for grid in table.grids]) for end in (0, -1))
        x, y, angle = rng.uniform(low, high)
        speed = rng.uniform(0.4, 1.0) * table.speeds([[x, y]], [angle])[0]
        if speed > 0.2:
            along = np.array([math.cos(angle), math.sin(angle)])
            rows.append([*([x, y] - table.contact_distance * along), *(speed * along)])
    return np.array(rows)


def test_contacts_are_met_in_place_and_velocity_near_the_entrys_posture(shipped):
    for state in contact_states(shipped, 200, 1015):
        cell = shipped.cell(state, HOME)
        q, qd = shipped.contact(cell, state[:2] + shipped.rules.table, state[2:])
        joint, _ = ROBOT.forward(q)
        np.testing.assert_allclose(joint[:2], state[:2] + shipped.rules.table, atol=1e-7)
        assert joint[2] == pytest.approx(shipped.rules.height, abs=1e-7)
        np.testing.assert_allclose(ROBOT.jacobian(q)[:3] @ qd, [*state[2:], 0.0], atol=1e-7)
        assert np.abs(q - shipped.posture[cell]).max() < 0.3


def test_a_contact_out_of_reach_is_none(shipped):
    cell = entries(shipped, 1, 1016)[0]
    assert shipped.contact(cell, [3.0, 0.0], [1.0, 0.0]) is None


def test_the_nearest_entry_fast_enough_and_soonest_reached_is_taken(shipped):
    for state in contact_states(shipped, 100, 1017):
        layer, i, j, k = shipped.cell(state, HOME)
        angle, speed = math.atan2(state[3], state[2]), math.hypot(state[2], state[3])
        puck = state[:2] + shipped.contact_distance * np.array([math.cos(angle), math.sin(angle)])
        assert abs(shipped.x[i] - puck[0]) <= 0.5 * np.diff(shipped.x[:2])[0] + 1e-9
        assert abs(shipped.y[j] - puck[1]) <= 0.5 * np.diff(shipped.y[:2])[0] + 1e-9
        assert abs(shipped.angle[k] - angle) <= 0.5 * np.diff(shipped.angle[:2])[0] + 1e-9
        column = shipped.speed[:, i, j, k]
        assert column[layer] > 0.0
        assert column[layer] >= min(speed, column.max())


def test_no_entry_off_the_table_or_backwards(shipped):
    for state in ([0.5, 0.0, 1.0, 0.0], [-0.5, 0.9, 1.0, 0.0], [-0.5, 0.0, -1.0, 0.0]):
        assert shipped.cell(state, HOME) is None


def straight_start(table, cell):
    """Where a run-up that is straight in the joints begins; leads are told from there."""
    return table.posture[cell] - 0.5 * table.config.run_up * table.rates[cell]


def test_leads_are_long_enough_for_a_cubic_to_the_run_up_and_grow_with_the_way(shipped):
    limits = shipped.rules.limits(ROBOT)
    for cell in entries(shipped, 60, 1018):
        _, i, j, k = cell
        puck, angle = [[shipped.x[i], shipped.y[j]]], [shipped.angle[k]]
        leads = []
        for row in range(len(shipped.speed)):
            way = np.abs(straight_start(shipped, (row, i, j, k)) - HOME)
            times = np.maximum(way / limits.velocity, np.sqrt(6.0 * way / limits.acceleration))
            if shipped.speed[row, i, j, k] > 0.0:
                leads.append(shipped.config.run_up + times.max())
        lead = shipped.lead(HOME, puck, angle)[0]
        assert min(leads) - 1e-9 <= lead <= shipped.config.lead_factor * max(leads)
        begin = straight_start(shipped, cell)
        assert shipped.lead(begin, puck, angle)[0] == pytest.approx(shipped.config.run_up, abs=1e-9)
    assert np.all(shipped.lead(HOME, np.tile([-0.5, 0.0], (3, 1)), [-0.1, 0.0, 0.1]) < 1.5)


def test_with_more_time_the_mallet_is_faster_up_to_the_largest_speed(shipped):
    states = contact_states(shipped, 100, 1019)
    angles = np.arctan2(states[:, 3], states[:, 2])
    puck = states[:, :2] + shipped.contact_distance * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    before = np.zeros(len(puck))
    lead = shipped.lead(HOME, puck, angles)
    for available in (0.1, 0.4, 0.6, 0.8, 1.0, 1.5, 3.0):
        speeds = shipped.timely_speeds(HOME, puck, angles, np.full(len(puck), available))
        assert np.all(speeds >= before)
        np.testing.assert_array_equal(speeds > 0.0, lead <= available)
        before = speeds
    np.testing.assert_allclose(before, shipped.speeds(puck, angles))


def test_a_strike_begins_where_the_run_up_does(shipped):
    for cell in entries(shipped, 20, 1020):
        q, _ = strike(shipped, cell)
        assert np.abs(q[0] - shipped.start(cell)).max() < 0.1


# The table that comes with the package.


@pytest.mark.parametrize(
    ("place", "speeds"),
    [
        ((0.8, 0.0), (2.31, 1.33, 1.15, 1.33, 2.31)),
        ((1.0, 0.0), (2.05, 1.18, 1.02, 1.18, 2.05)),
        ((1.2, 0.0), (1.58, 0.91, 0.79, 0.91, 1.58)),
    ],
)
def test_searched_postures_strike_faster_than_the_start_ones_neighbour(shipped, place, speeds):
    """(5.13) at the posture that inverse kinematics finds, where nothing but the touch counts, is beaten."""
    angles = np.deg2rad([-60.0, -30.0, 0.0, 30.0, 60.0])
    along = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    puck = place - shipped.rules.table + shipped.contact_distance * along
    np.testing.assert_array_less(np.array(speeds)[1:4], shipped.speeds(puck, angles)[1:4])


def test_the_shipped_table_says_how_it_was_made():
    with np.load(SHIPPED) as content:
        origin = json.loads(str(content["about"]))["origin"]
    assert origin["command"].startswith("vpsto learn strikes ")
    assert f"--seed {origin['seed']}" in origin["command"]
    assert origin["duration_s"] > 0.0


# Files.


def test_what_is_saved_is_what_is_loaded(small, tmp_path):
    small.save(tmp_path / "strikes.npz", command="a test")
    again = StrikeTable.load(tmp_path / "strikes.npz")
    for name in ("x", "y", "angle", "speed"):
        np.testing.assert_array_equal(getattr(again, name), getattr(small, name))
    np.testing.assert_allclose(again.posture, small.posture, atol=1e-6)
    np.testing.assert_allclose(again.rates, small.rates, atol=1e-6)
    assert (again.config, again.rules) == (small.config, small.rules)
    assert again.contact_distance == small.contact_distance
    assert not again.speed.flags.writeable


def altered(small, path, about=None, **arrays):
    """A file in which something was changed; None takes it away."""
    small.save(path, command="a test")
    with np.load(path) as content:
        parts = {name: content[name] for name in content.files}
    if about is not None:
        text = about if isinstance(about, str) else json.dumps(about(json.loads(str(parts["about"]))))
        parts["about"] = np.array(text)
    parts.update(arrays)
    np.savez_compressed(path, **{name: part for name, part in parts.items() if part is not None})


DAMAGE = {
    "another format": {"about": lambda about: about | {"format": "vpsto_ros strikes 0"}},
    "no format": {"about": lambda about: {key: about[key] for key in about if key != "format"}},
    "no object": {"about": lambda about: [about]},
    "no json": {"about": "{"},
    "no rules": {"about": lambda about: {key: about[key] for key in about if key != "rules"}},
    "rules that are none": {"about": lambda about: about | {"rules": 3}},
    "rules without a home": {"about": lambda about: about | {"rules": {}}},
    "a rule out of range": {"about": lambda about: about | {"rules": about["rules"] | {"height": 77.0}}},
    "an unknown rule": {"about": lambda about: about | {"rules": about["rules"] | {"hight": 0.1}}},
    "a rule in words": {"about": lambda about: about | {"rules": about["rules"] | {"height": "low"}}},
    "a config out of range": {"about": lambda about: about | {"config": about["config"] | {"run_up": -1.0}}},
    "an unknown option": {"about": lambda about: about | {"config": about["config"] | {"runup": 0.2}}},
    "no config": {"about": lambda about: {key: about[key] for key in about if key != "config"}},
    "a distance in words": {"about": lambda about: about | {"contact_distance": "far"}},
    "a distance that is a list": {"about": lambda about: about | {"contact_distance": [1.0]}},
    "no speeds": {"speed": None},
    "no grid": {"x": None},
    "speeds of another shape": {"speed": np.ones((1, 2, 3))},
    "postures of another shape": {"posture": np.ones((3, 2, 3, 3, 6))},
    "a speed that is no number": {"speed": np.full((3, 2, 3, 3), np.nan)},
    "a speed below zero": {"speed": np.full((3, 2, 3, 3), -1.0)},
    "words for speeds": {"speed": np.full((3, 2, 3, 3), "fast")},
    "a grid that falls": {"x": np.array([-0.4, -0.6])},
    "a grid that is not uniform": {"y": np.array([-0.2, 0.1, 0.2])},
    "pickled objects": {"x": np.array([{}, {}], dtype=object)},
}


@pytest.mark.parametrize("damage", DAMAGE)
def test_damaged_files_are_told_from_good_ones(small, tmp_path, damage):
    path = tmp_path / "strikes.npz"
    altered(small, path, **DAMAGE[damage])
    with pytest.raises(ConfigurationError, match=REMEDY):
        StrikeTable.load(path)


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04", b"no table", b"\x93NUMPY" + bytes(40)])
def test_files_of_other_kinds_are_told(tmp_path, content):
    path = tmp_path / "strikes.npz"
    path.write_bytes(content)
    with pytest.raises(ConfigurationError, match=REMEDY):
        StrikeTable.load(path)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9, 0.99])
def test_files_that_were_cut_off_or_changed_are_told(small, tmp_path, share):
    path = tmp_path / "strikes.npz"
    small.save(path)
    content = path.read_bytes()
    path.write_bytes(content[: int(share * len(content))])
    with pytest.raises(ConfigurationError, match=REMEDY):
        StrikeTable.load(path)
    middle = int(0.6 * len(content))
    path.write_bytes(content[:middle] + bytes(64) + content[middle + 64 :])
    with pytest.raises(ConfigurationError, match=REMEDY):
        StrikeTable.load(path)


def test_a_single_array_is_no_table(tmp_path):
    np.save(tmp_path / "strikes.npy", np.zeros(3))
    with pytest.raises(ConfigurationError, match=REMEDY):
        StrikeTable.load(tmp_path / "strikes.npy")


def test_a_missing_file_or_a_folder_says_what_to_do(tmp_path):
    for path in (tmp_path / "none.npz", tmp_path):
        with pytest.raises(ConfigurationError, match="`vpsto learn strikes`"):
            StrikeTable.load(path)


def test_grids_must_be_symmetric():
    with pytest.raises(InvalidInputError, match="symmetric"):
        tabulate([-0.6, -0.4], [0.0, 0.2], [-0.1, 0.0, 0.1], 0.08, np.random.default_rng(0), effort=10)


def test_options_out_of_range_are_named():
    with pytest.raises(ConfigurationError, match="run_up"):
        StrikeConfig(run_up=0.0)
    with pytest.raises(ConfigurationError, match="clearance"):
        PlayRules(clearance=-1.0)
