import dataclasses
import math
from types import SimpleNamespace

import numpy as np
import pytest

from sim_bridge.demo.push_box import box_scenario
from sim_bridge.report import recording as rec
from sim_bridge.report.bag import BagRecorder, read_messages, typestore
from sim_bridge.report.overlay import LINE_LIST, LINE_STRIP, SPHERE_LIST, overlays_of
from sim_bridge.report.page import push_tables
from sim_bridge.report.recording import Command, JointSeries, PoseSeries, Recording, Status
from sim_bridge.report.summary import (
    RunFacts,
    command_violations,
    failures,
    limit_violations,
    planner_figures,
    summarize,
)
from vpsto_ros.robot.inverse_kinematics import TableMap
from vpsto_ros.robot.kinematics import fr3_pusher

TOOLS = TableMap(fr3_pusher(), 0.02)
NAMES = [f"fr3_joint{i}" for i in range(1, 8)]


def message(kind, **fields):
    return typestore().types[kind](**fields)


def stamp(seconds):
    whole = math.floor(seconds)
    return message("builtin_interfaces/msg/Time", sec=whole, nanosec=round((seconds - whole) * 1e9))


def header(seconds):
    return message("std_msgs/msg/Header", stamp=stamp(seconds), frame_id="fr3_link0")


def pose(x, y, yaw):
    return message(
        "geometry_msgs/msg/Pose",
        position=message("geometry_msgs/msg/Point", x=x, y=y, z=0.0),
        orientation=message(
            "geometry_msgs/msg/Quaternion", x=0.0, y=0.0, z=math.sin(yaw / 2), w=math.cos(yaw / 2)
        ),
    )


def odometry(seconds, *planar):
    zero = message("geometry_msgs/msg/Vector3", x=0.0, y=0.0, z=0.0)
    twist = message("geometry_msgs/msg/Twist", linear=zero, angular=zero)
    return message(
        "nav_msgs/msg/Odometry", header=header(seconds), child_frame_id="object",
        pose=message("geometry_msgs/msg/PoseWithCovariance", pose=pose(*planar), covariance=np.zeros(36)),
        twist=message("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )  # fmt: skip


def joint_state(seconds, position):
    values = {"position": position, "velocity": 0.1 * position, "effort": 2.0 * position}
    return message("sensor_msgs/msg/JointState", header=header(seconds), name=NAMES, **values)


def trajectory(seconds, positions):
    points = [
        message(
            "trajectory_msgs/msg/JointTrajectoryPoint", positions=row, velocities=np.zeros(7),
            accelerations=np.array([]), effort=np.array([]),
            time_from_start=message("builtin_interfaces/msg/Duration", sec=index, nanosec=500_000_000),
        )
        for index, row in enumerate(positions)
    ]  # fmt: skip
    return message(
        "trajectory_msgs/msg/JointTrajectory", header=header(seconds), joint_names=NAMES, points=points
    )


def diagnostic(seconds, level, **values):
    pairs = [message("diagnostic_msgs/msg/KeyValue", key=key, value=value) for key, value in values.items()]
    status = message(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name="mpc_planner",
        message="ok",
        hardware_id="",
        values=pairs,
    )
    return message("diagnostic_msgs/msg/DiagnosticArray", header=header(seconds), status=[status])


@pytest.fixture
def bag(tmp_path):
    written = BagRecorder(tmp_path / "bag")
    kinds = {
        rec.JOINT_STATES: "sensor_msgs/msg/JointState",
        rec.JOINT_TRAJECTORY: "trajectory_msgs/msg/JointTrajectory",
        rec.GROUND_TRUTH: "nav_msgs/msg/Odometry",
        rec.GOAL_POSE: "geometry_msgs/msg/PoseStamped",
        rec.DIAGNOSTICS: "diagnostic_msgs/msg/DiagnosticArray",
    }
    for topic, kind in kinds.items():
        written.add_topic(topic, kind)
    goal = message("geometry_msgs/msg/PoseStamped", header=header(0.0), pose=pose(0.5, 0.2, 0.0))
    rows = [
        (rec.JOINT_STATES, 1.0, joint_state(1.0, np.arange(7.0))),
        (rec.GROUND_TRUTH, 1.0, odometry(1.0, 0.5, 0.0, 3.1)),
        (rec.GOAL_POSE, 1.5, goal),
        (rec.JOINT_TRAJECTORY, 1.6, trajectory(1.5, np.ones((3, 7)))),
        (rec.DIAGNOSTICS, 1.7, diagnostic(1.7, 1, compute_p50_ms="3.25", note="fine")),
        (rec.JOINT_STATES, 2.0, joint_state(2.0, np.arange(7.0) + 1.0)),
        (rec.GROUND_TRUTH, 2.0, odometry(2.0, 0.5, 0.1, -3.1)),
    ]
    for topic, seconds, content in rows:
        written.write(topic, seconds, typestore().serialize_cdr(content, kinds[topic]))
    written.close()
    return tmp_path / "bag"


def test_a_bag_comes_back_as_arrays(bag):
    run = Recording.from_bag(bag)
    assert run.joints.time == pytest.approx([1.0, 2.0])
    assert run.joints.position[1] == pytest.approx(np.arange(7.0) + 1.0)
    assert run.joints.effort[0] == pytest.approx(2.0 * np.arange(7.0))
    assert run.object.pose[0] == pytest.approx([0.5, 0.0, 3.1])
    assert run.commands[0].time == pytest.approx([2.0, 3.0, 4.0])
    assert run.commands[0].acceleration is None
    status = run.diagnostics["mpc_planner"][0]
    assert (status.level, status.number("compute_p50_ms")) == (1, 3.25)
    assert math.isnan(status.number("note")) and math.isnan(status.number("missing"))


def test_the_bag_is_mcap_with_its_message_definitions(bag):
    files = {file.suffix for file in bag.iterdir()}
    assert files == {".mcap", ".yaml"}
    data = next(bag.glob("*.mcap")).read_bytes()
    assert data.startswith(b"\x89MCAP0\r\n") and data.endswith(b"\x89MCAP0\r\n")
    assert b"ros2msg" in data and b"float64[36] covariance" in data


def test_a_second_run_replaces_the_bag_but_nothing_else(bag, tmp_path):
    BagRecorder(bag).close()
    assert list(read_messages(bag, [rec.JOINT_STATES])) == []
    other = tmp_path / "precious"
    other.mkdir()
    (other / "thesis.tex").write_text("x")
    with pytest.raises(FileExistsError, match="is not a bag"):
        BagRecorder(other)
    assert (other / "thesis.tex").exists()


def test_poses_are_interpolated_the_short_way_round_and_targets_are_held(bag):
    run = Recording.from_bag(bag)
    assert run.object.at(np.array([1.5]))[0] == pytest.approx([0.5, 0.05, math.pi])
    assert np.isnan(run.goal.held(np.array([1.4]))).all()
    assert run.goal.held(np.array([1.5, 9.0]))[:, 1] == pytest.approx([0.2, 0.2])
    time, distance = run.distance()
    assert time == pytest.approx([2.0])
    assert distance == pytest.approx([0.1])


def driver_status(**changes):
    kinds = ("reference_position", "joint_velocity", "torque")
    values = {f"limit.{kind}.instants": "0" for kind in kinds} | {
        f"limit.{kind}.worst": "0.9" for kind in kinds
    }
    values |= {"limit_violations": "0", "demand.torque_rate.instants": "12"}
    return Status(10.0, 0, "ok", values | changes)


def good_run():
    robot = fr3_pusher()
    time = np.linspace(0.0, 10.0, 1001)
    joints = np.tile(TableMap(robot, 0.02).joints([(0.5, 0.0)])[0], (time.size, 1))
    still = np.zeros_like(joints)
    target = np.tile([0.5, 0.1, 0.0], (time.size, 1))
    commands = [
        Command(t, t + np.array([0.0, 1.0]), joints[:2], still[:2], None) for t in np.arange(0.0, 10.0, 0.05)
    ]
    values = {
        "compute_p50_ms": "3",
        "compute_p99_ms": "5",
        "compute_max_ms": "9",
        "deadline_misses": "1",
        "skipped_cycles": "0",
        "cycles": "200",
    }
    diagnostics = {"mpc_planner": [Status(10.0, 0, "ok", values)], "franka_driver": [driver_status()]}
    return Recording(
        JointSeries(time, joints, still, still.copy()), *[PoseSeries(time, target) for _ in range(3)],
        commands, diagnostics,
    )  # fmt: skip


def good_story():
    story = box_scenario(np.random.default_rng(0))
    story.phases = [
        dataclasses.replace(phase, start=i, end=i + 1.0, reached=i + 0.5)
        for i, phase in zip([0.0, 2.0, 4.0, 6.0, 8.0, 9.0], story.phases, strict=True)
    ]
    story.drift_distances = [0.01, 0.02, 0.03]
    return story


FACTS = RunFacts(seed=3, first_plan=1.5, elapsed=5.0, trouble=[], planner_rate=20.0)


def test_a_good_run_is_a_success_with_all_promised_figures():
    summary = summarize(good_run(), good_story(), TOOLS, FACTS)
    assert summary["success"] and summary["failures"] == []
    assert summary["final_error_m"] == pytest.approx(0.0)
    assert summary["limit_violations"] == 0
    assert summary["mpc"]["rate_hz"] == pytest.approx(19.9)
    assert summary["mpc"]["compute_ms"] == {"p50": 3.0, "p99": 5.0, "max": 9.0}
    assert summary["mpc"]["deadline_misses"] == 1
    assert summary["drift"]["median_distance_m"] == pytest.approx(0.02)
    assert summary["tool_height_deviation_m"] == pytest.approx(0.0, abs=1e-9)
    assert summary["real_time_factor"] == pytest.approx(2.0)


def test_each_shortcoming_fails_the_run():
    base = summarize(good_run(), good_story(), TOOLS, FACTS)
    assert failures(base) == []
    late = [
        {**phase, "time_to_reach_s": math.nan} if phase["name"] == "knock" else phase
        for phase in base["phases"]
    ]
    for change, word in [
        ({"phases": late}, "knock"),
        ({"drift": {"median_distance_m": 0.03}}, "30 mm"),
        ({"drift": {"median_distance_m": math.nan}}, "drift"),
        (
            {"limit_violations": 2, "limit_violations_by_kind": {"driver_torque": 2, "driver_other": 0}},
            "driver_torque",
        ),
        ({"limit_violations_by_kind": {}}, "driver did not say"),
        ({"mpc": {**base["mpc"], "rate_hz": 19.6}}, "19.60 plans"),
        ({"mpc": {**base["mpc"], "rate_hz": math.nan}}, "plans per simulated second"),
        ({"mpc": {**base["mpc"], "deadline_miss_fraction": 0.02}}, "2.0%"),
        ({"mpc": {**base["mpc"], "deadline_miss_fraction": math.nan}}, "deadlines"),
        ({"tool_height_deviation_m": 0.006}, "6.0 mm"),
    ]:
        found = failures({**base, **change})
        assert len(found) == 1 and word in found[0]
    trouble = dataclasses.replace(FACTS, trouble=["mpc_planner exited with status 1"])
    assert not summarize(good_run(), good_story(), TOOLS, trouble)["success"]


def test_a_strict_verdict_minds_contacts_and_refused_trajectories():
    run = good_run()
    kinds = {f"contact.{kind}.steps": "7" for kind in ("arms", "table", "object")}
    refused = {"rejected.joint_trajectory.jump": "2", "rejected.joint_trajectory.past": "1"}
    before, after = driver_status(**kinds, **refused), driver_status(**kinds, **refused)
    run.diagnostics["franka_driver"] = [dataclasses.replace(before, time=-1.0), after]
    summary = summarize(run, good_story(), TOOLS, FACTS, strict=True)
    assert summary["success"], "what was before the start is the start's"
    assert summary["contacts"] == {"arms": 0, "table": 0, "object": 0}
    assert summary["refused_trajectories"] == 0
    after.values.update({"contact.arms.steps": "9", "rejected.joint_trajectory.jump": "3"})
    assert summarize(run, good_story(), TOOLS, FACTS)["success"], "others do not mind"
    found = summarize(run, good_story(), TOOLS, FACTS, strict=True)["failures"]
    assert found == ["the arms touched each other for 2 ms", "the controller refused 1 trajectories"]
    after.values.update({"contact.table.steps": "8", "contact.object.steps": "8"})
    assert len(summarize(run, good_story(), TOOLS, FACTS, strict=True)["failures"]) == 4
    run.diagnostics["franka_driver"] = [driver_status()]
    failed = summarize(run, good_story(), TOOLS, FACTS, strict=True)["failures"]
    assert failed == ["the driver did not say what the arms touched"]


def test_a_scenario_without_a_drift_is_not_judged_by_one():
    story = good_story()
    story.phases = [phase for phase in story.phases if phase.judged]
    summary = summarize(good_run(), story, TOOLS, FACTS)
    assert summary["success"] and "drift" not in summary
    assert all("drift" not in row[0] for _, rows in push_tables(summary) for row in rows)


def marker(name, kind, *points, action=0):
    vector = [message("geometry_msgs/msg/Point", x=x, y=y, z=z) for x, y, z in points]
    colour, scale = SimpleNamespace(r=0.1, g=0.2, b=0.3), SimpleNamespace(x=0.004)
    return SimpleNamespace(ns=name, type=kind, action=action, points=vector, color=colour, scale=scale)


def test_what_nodes_draw_becomes_lines_and_points():
    corners = [(0.4, 0.0, 0.003), (0.5, 0.0, 0.003), (0.5, 0.1, 0.003), (0.6, 0.1, 0.003)]
    drawn = [
        marker("path", LINE_STRIP, *corners),
        marker("rings", LINE_LIST, *corners),
        marker("object_belief", SPHERE_LIST, *corners),
        marker("gone", LINE_STRIP, *corners, action=2),
        marker("unwanted", LINE_STRIP, *corners),
        marker("empty", LINE_LIST),
    ]
    wanted = ("path", "rings", "object_belief", "gone", "empty")
    path, rings, belief = overlays_of(drawn, wanted, height=0.12)
    assert path.points.shape == (3, 2, 3) and rings.points.shape == (2, 2, 3) and path.lines
    assert np.allclose(path.points[1, 0], path.points[0, 1])
    assert belief.points.shape == (4, 3) and not belief.lines
    assert belief.points[0, 2] > 0.12 > path.points[0, 0, 2], "below the object it would be hidden"
    assert path.width == 0.004 and path.colour == (0.1, 0.2, 0.3)


def test_what_was_drawn_is_shown_until_it_is_old():
    path = overlays_of([marker("path", LINE_STRIP, (0, 0, 0), (1, 0, 0))], ("path",), 0.0)
    run = dataclasses.replace(good_run(), drawn={"a": [rec.Drawing(1.0, path), rec.Drawing(1.1, ())]})
    assert run.overlays(0.9) == () and run.overlays(1.05) == path and run.overlays(1.2) == ()
    run.drawn["b"] = [rec.Drawing(1.0, path)]
    assert run.overlays(1.5) == path and run.overlays(3.0) == ()


def test_violations_are_counted_wherever_they_happen():
    robot, run = fr3_pusher(), good_run()
    assert sum(limit_violations(run, robot).values()) == 0
    run.joints.velocity[5, 2] = 1.01 * robot.limits.velocity[2]
    run.joints.position[9, 3] = robot.limits.upper[3] + 1e-3
    start = run.joints.position[0]
    # A cubic between two resting points is fastest half-way: 1.5 times the mean, between its points.
    fast = np.stack((start, start + [0.7 * robot.limits.velocity[0], 0, 0, 0, 0, 0, 0]))
    run.commands.append(Command(1.0, np.array([1.0, 2.0]), fast, np.zeros((2, 7)), None))
    assert command_violations(run.commands[-1], robot.limits)
    counts = limit_violations(run, robot)
    assert counts == {
        "measured_position": 1,
        "measured_velocity": 1,
        "published_trajectory": 1,
        "driver_reference_position": 0,
        "driver_joint_velocity": 0,
        "driver_torque": 0,
        "driver_other": 0,
    }


def test_torques_that_were_asked_for_count_but_not_ramped_ones():
    robot, run = fr3_pusher(), good_run()
    # The driver sums up all kinds; a torque beyond its limit is one of them.
    asked = {"limit_violations": "3", "limit.torque.instants": "3"}
    run.diagnostics["franka_driver"] = [driver_status(**asked)]
    counts = limit_violations(run, robot)
    assert counts["driver_torque"] == 3 and sum(counts.values()) == 3
    summary = summarize(run, good_story(), TOOLS, FACTS)
    assert summary["failures"] == ["3 limit violations (driver_torque)"]
    run.diagnostics["franka_driver"] = [driver_status(limit_violations="2")]
    assert limit_violations(run, robot)["driver_other"] == 2


def test_the_verdict_takes_the_keys_that_the_driver_has():
    from sim_bridge import driver_messages
    from sim_bridge.simulation import Simulation

    simulation = Simulation()
    values = {key: str(value) for key, value in driver_messages.figures(simulation).items()}
    run = good_run()
    run.diagnostics["franka_driver"] = [Status(10.0, 0, "ok", values)]
    counts = limit_violations(run, fr3_pusher())
    assert {"driver_torque", "driver_reference_acceleration", "driver_other"} <= set(counts)
    assert "driver_torque_rate" not in counts and sum(counts.values()) == 0
    demand, still, q = np.zeros((2, 7)), np.zeros(7), simulation.joint_position
    demand[:, 3] = 1.5
    simulation.limits.observe(q, still, still, q, still, demand)
    values = {key: str(value) for key, value in driver_messages.figures(simulation).items()}
    run.diagnostics["franka_driver"] = [Status(10.0, 0, "ok", values)]
    assert sum(limit_violations(run, fr3_pusher()).values()) == simulation.limits.violations == 1


def counters(time, cycles, misses, skipped):
    values = {"cycles": cycles, "deadline_misses": misses, "skipped_cycles": skipped}
    return Status(time, 0, "", {key: str(value) for key, value in values.items()})


def rate_of(*statuses, start=2.0, end=12.0):
    run = good_run()
    run.diagnostics["mpc_planner"] = list(statuses)
    return planner_figures(run, start, end, 20.0)


def test_the_planning_rate_is_what_the_planner_counted_in_simulated_time():
    # The recording holds 20 trajectories a second all the same; a recorder that lost some would not matter.
    half = rate_of(counters(1.5, 0, 0, 0), counters(7.0, 50, 0, 0), counters(12.0, 100, 0, 0))
    assert half["rate_hz"] == pytest.approx(10.0)
    full = rate_of(counters(1.5, 0, 0, 0), counters(12.5, 210, 0, 0), counters(13.5, 230, 0, 0))
    assert full["rate_hz"] == pytest.approx(20.0)


def test_skipped_cycles_are_misses_and_what_was_before_the_start_dilutes_nothing():
    # Of 200 cycles that were due, 10 were skipped and 5 came late; the planner's misses hold both.
    figures = rate_of(counters(1.9, 1000, 3, 2), counters(12.0, 1190, 18, 12))
    assert (figures["cycles"], figures["deadline_misses"], figures["skipped_cycles"]) == (200, 15, 10)
    assert figures["deadline_miss_fraction"] == pytest.approx(0.075)
    assert figures["rate_hz"] == pytest.approx(18.5)


def test_a_planner_that_falls_silent_is_not_taken_to_have_gone_on():
    assert rate_of(counters(7.0, 100, 0, 0))["rate_hz"] == pytest.approx(10.0)
    for figures in (rate_of(), rate_of(counters(1.0, 100, 0, 0))):
        assert math.isnan(figures["rate_hz"]) and math.isnan(figures["deadline_miss_fraction"])
    assert math.isnan(rate_of(counters(12.0, 0, 0, 0))["deadline_miss_fraction"])


def test_the_length_of_a_recording_is_that_since_the_start():
    assert good_run().duration(0.0) == pytest.approx(10.0)
    assert good_run().duration(4.0) == pytest.approx(6.0) and good_run().duration(math.nan) == 0.0
    empty = PoseSeries(np.empty(0), np.empty((0, 3)))
    assert dataclasses.replace(good_run(), object=empty).duration(0.0) == 0.0
    none = JointSeries(np.empty(0), *[np.empty((0, 7))] * 3)
    assert dataclasses.replace(good_run(), joints=none).duration(0.0) == 0.0
