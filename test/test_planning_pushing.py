"""The pushing planner against a plant made of the contact model itself, with other parameters."""

import dataclasses
import itertools

import numpy as np
import pytest

from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.contact.pushing import PushingModel, rollout
from vpsto_ros.estimation.object_state import ObjectState
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.optimization.vpsto import VpstoConfig
from vpsto_ros.planning.contact import ContactPlan, ContactPlannerConfig, PushContactPlanner
from vpsto_ros.planning.goal import PlanarGoal
from vpsto_ros.planning.mpc import OnlineConfig
from vpsto_ros.planning.pushing import PushingMpc
from vpsto_ros.planning.pushing_config import PushingCosts, PushingMpcConfig
from vpsto_ros.planning.workspace import Workspace
from vpsto_ros.robot.kinematics import fr3_pusher
from vpsto_ros.trajectory import Trajectory

MODEL = PushingModel(PlanarShape.box(0.12, 0.10), PlanarShape.disc(0.015))
START = np.array([0.52, -0.05, 0.3])
GOAL = PlanarGoal(np.array([0.50, 0.10]))


class ModelPlant:
    """An arm that follows its reference exactly, an object with other friction and pressure than assumed."""

    def __init__(self, planner: PushingMpc, tool: np.ndarray, pose: np.ndarray, seed: int = 0) -> None:
        self.planner, self.pose, self.now = planner, pose, 0.0
        self.joints = planner.table_map.joints(tool[None])[0]
        self.model = dataclasses.replace(
            planner.model, pressure_radius=1.2 * planner.model.pressure_radius, friction=0.35
        )
        self.rng = np.random.default_rng(seed)
        self.steps, self.published = [], []

    def state(self) -> ObjectState:
        noise = self.rng.normal(0.0, [1e-3, 1e-3, 5e-3])
        return ObjectState(self.now, self.pose + noise, np.zeros(3), 1e-6 * np.eye(6))

    def advance(
        self, goal: PlanarGoal | None, contact: ContactPlan | None = None, state: ObjectState | None = None
    ) -> None:
        planner = self.planner
        if planner.reference is not None:
            self.joints = planner.reference(self.now)
        step = planner.step(self.now, self.joints, np.zeros(7), state or self.state(), goal, contact)
        planner.accept(step)
        self.steps.append(step)
        if step.trajectory is not None:
            self.published.append(step.trajectory)
        times = np.linspace(self.now, self.now + 0.05, 6)
        path = planner.table_map.tool(planner.reference(times))
        self.pose = rollout(self.model, self.pose, path[None]).object_pose[0, -1]
        self.now += 0.05


def make_planner(seed: int = 1, **options) -> PushingMpc:
    return PushingMpc(PushingMpcConfig(**options), MODEL, fr3_pusher(), np.random.default_rng(seed))


def run(plant: ModelPlant, goal: PlanarGoal, steps: int) -> ModelPlant:
    for _ in range(steps):
        plant.advance(goal)
        if plant.steps[-1].mode == "hold":
            break
    return plant


def assert_safe(planner: PushingMpc, published: list[Trajectory]) -> None:
    """Joint limits and tool height at every instant; no jump from one trajectory to the next."""
    for trajectory in published:
        planner.table_path.check(trajectory)
        assert np.abs(trajectory(trajectory.end_time, 1)).max() < 1e-9
    for old, new in itertools.pairwise(published):
        begin = max(new.start_time, old.start_time)
        q_old, v_old, _ = old.state(begin)
        q_new, v_new, _ = new.state(begin)
        np.testing.assert_allclose(q_new, q_old, atol=1e-9)
        np.testing.assert_allclose(v_new, v_old, atol=1e-7)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_pushes_the_box_to_its_goal_within_all_limits(seed):
    planner = make_planner(seed)
    plant = run(ModelPlant(planner, np.array([0.40, -0.05]), START, seed), GOAL, 300)
    assert plant.steps[-1].mode == "hold"
    assert GOAL.distance(plant.pose)[0] < 0.006
    modes = {step.mode for step in plant.steps}
    assert {"explore", "warm_start", "hold"} <= modes
    assert_safe(planner, plant.published)


def test_pushes_a_tee_to_a_pose():
    model = PushingModel(PlanarShape.tee(), PlanarShape.disc(0.015))
    planner = PushingMpc(PushingMpcConfig(seeds=6), model, fr3_pusher(), np.random.default_rng(4))
    goal = PlanarGoal(np.array([0.52, 0.08]), 1.2)
    plant = run(ModelPlant(planner, np.array([0.36, 0.0]), np.array([0.52, -0.08, 0.0])), goal, 800)
    distance, angle = goal.distance(plant.pose)
    assert plant.steps[-1].mode == "hold" and distance < 0.01 and angle < np.radians(5.0)
    assert_safe(planner, plant.published)


def test_same_seed_same_plans():
    def paths(seed):
        plant = ModelPlant(make_planner(seed), np.array([0.40, -0.05]), START)
        for _ in range(8):
            plant.advance(GOAL)
        return plant.steps[-1].tool_path

    np.testing.assert_array_equal(paths(5), paths(5))
    assert not np.array_equal(paths(5), paths(6))


def test_a_target_that_moves_during_the_push_is_followed():
    planner = make_planner()
    plant = ModelPlant(planner, np.array([0.40, -0.05]), START)
    errors = []
    for k in range(400):
        goal = PlanarGoal(np.array([0.50, -0.1 + 0.02 * 0.05 * k]))
        plant.advance(goal)
        errors.append(goal.distance(plant.pose)[0])
    assert np.median(errors[200:]) < 0.025
    assert_safe(planner, plant.published)


@pytest.mark.parametrize(
    ("goal", "age", "words"),
    [
        (None, 0.0, "no goal"),
        (PlanarGoal(np.array([1.5, 0.0])), 0.0, "outside the workspace"),
        (GOAL, 1.0, "old"),
    ],
)
def test_what_forbids_planning_brakes_a_moving_arm(goal, age, words):
    planner = make_planner()
    plant = ModelPlant(planner, np.array([0.40, -0.05]), START)
    for _ in range(16):
        plant.advance(GOAL)
    assert np.abs(planner.reference(plant.now, 1)).max() > 0.05
    state = dataclasses.replace(plant.state(), stamp=plant.now - age)
    plant.advance(goal, state=state)
    step = plant.steps[-1]
    assert step.mode == "brake" and not step.valid and words in step.message
    assert step.trajectory.end_time < plant.now + 1.0
    assert_safe(planner, plant.published)


def test_an_object_that_cannot_be_reached_gives_no_plan_but_a_stop():
    planner = make_planner()
    plant = ModelPlant(planner, np.array([0.40, -0.05]), START)
    for _ in range(10):
        plant.advance(GOAL)
    far = ObjectState(plant.now, np.array([2.0, 0.0, 0.0]), np.zeros(3), 1e-6 * np.eye(6))
    plant.advance(GOAL, state=far)
    assert plant.steps[-1].mode == "brake" and "no valid plan" in plant.steps[-1].message
    assert_safe(planner, plant.published)


def test_a_displaced_arm_is_taken_over_only_when_it_stands_still():
    planner = make_planner()
    plant = ModelPlant(planner, np.array([0.40, -0.05]), START)
    for _ in range(10):
        plant.advance(GOAL)
    elsewhere = planner.table_map.joints(np.array([[0.38, 0.2]]))[0]
    planner.accept(planner.step(plant.now, elsewhere, np.full(7, 0.3), plant.state(), GOAL))
    later = planner.reference.end_time
    moving = planner.step(later, elsewhere, np.full(7, 0.3), plant.state(), GOAL)
    assert moving.mode == "wait" and moving.trajectory is None and "stands still" in moving.message
    still = planner.step(later, elsewhere, np.zeros(7), plant.state(), GOAL)
    assert still.trajectory is not None and still.trajectory.start_time > later
    np.testing.assert_allclose(still.trajectory(still.trajectory.start_time), elsewhere)


def test_an_arm_above_the_table_is_lowered_beside_the_object():
    planner = make_planner()
    robot = planner.robot
    raised = type(planner.table_map)(robot, 0.3).joints(np.array([[0.45, -0.1]]))[0]
    step = planner.step(
        0.0, raised, np.zeros(7), ObjectState(0.0, START, np.zeros(3), 1e-6 * np.eye(6)), GOAL
    )
    assert step.mode == "enter" and not step.trajectory.violations(robot.limits)
    times = np.linspace(step.trajectory.start_time, step.trajectory.end_time, 300)
    tips = np.array([robot.forward(q)[0] for q in step.trajectory(times)])
    beside = np.hypot(*(tips[:, :2] - START[:2]).T) > MODEL.shape.bounding_radius + 0.015
    assert (beside | (tips[:, 2] > 0.08)).all() and tips[:, 2].min() > 0.015
    assert abs(tips[-1, 2] - planner.table_map.height) < 1e-6
    unknown = make_planner().step(0.0, raised, np.zeros(7), None, GOAL)
    assert unknown.trajectory is None and "object" in unknown.message


def test_stop_brakes_at_once_within_limits():
    planner = make_planner()
    plant = ModelPlant(planner, np.array([0.40, -0.05]), START)
    for _ in range(16):
        plant.advance(GOAL)
    q, v, _ = planner.reference.state(plant.now)
    stop = planner.stop(plant.now)
    np.testing.assert_allclose(stop.state(plant.now)[0], q)
    np.testing.assert_allclose(stop.state(plant.now)[1], v)
    assert not stop.violations(planner.robot.limits)
    assert np.abs(stop(plant.now + 0.3, 1)).max() < 1e-12


def test_the_thesis_end_point_ends_at_the_object():
    planner = make_planner(costs=PushingCosts(end_point="object"))
    plant = ModelPlant(planner, np.array([0.40, -0.05]), START)
    for _ in range(6):
        plant.advance(GOAL)
    valid = [step for step in plant.steps if step.plane is not None]
    assert valid
    for step in valid:
        np.testing.assert_allclose(step.tool_path[-1], START[:2], atol=0.01)


def test_configuration_errors_name_field_value_and_range():
    with pytest.raises(ConfigurationError, match=r"speed = -1.*0\.01 to 2\.0"):
        PushingMpcConfig(speed=-1)
    with pytest.raises(ConfigurationError, match="resume_distance"):
        PushingMpcConfig(hold_distance=0.01, resume_distance=0.005)
    with pytest.raises(ConfigurationError, match="the arm reaches"):
        make_planner(workspace=Workspace(radius_max=1.2))


def test_contact_plan_is_behind_the_object_and_well_defined():
    planner = PushContactPlanner(ContactPlannerConfig(), MODEL)
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = rng.uniform([0.45, -0.2, -3.0], [0.6, 0.2, 3.0])
        goal = PlanarGoal(rng.uniform([0.45, -0.2], [0.6, 0.2]))
        if np.hypot(*(goal.position - pose[:2])) < 0.05:
            continue
        plan = planner.plan(
            1.0, np.array([0.4, 0.0]), ObjectState(1.0, pose, np.zeros(3), 1e-6 * np.eye(6)), goal
        )
        assert plan.stamp >= 1.0 and np.linalg.eigvalsh(plan.covariance).min() > 0.0
        ahead = goal.position - pose[:2]
        assert (plan.position - pose[:2]) @ ahead < 0.0 and plan.velocity @ ahead > 0.0
        c, s = np.cos(pose[2]), np.sin(pose[2])
        in_object = np.array([[c, s], [-s, c]]) @ (plan.position - pose[:2])
        assert MODEL.shape.signed_distance(in_object[None])[0] >= 0.015


@pytest.mark.parametrize("age", [0.05, 0.08, 0.12, 0.3])
def test_an_old_object_state_is_brought_up_to_date_with_what_the_tool_did(age):
    planner = make_planner()
    plant = ModelPlant(planner, np.array([0.40, -0.05]), START)
    plant.model = planner.model
    history = {}
    worst = 0.0
    for _ in range(45):
        history[round(plant.now, 3)] = plant.pose
        plant.advance(GOAL)
        then = round(plant.now - age, 3)
        if then not in history or planner.reference is None:
            continue
        old = ObjectState(then, history[then], np.zeros(3), 1e-6 * np.eye(6))
        worst = max(worst, np.hypot(*(planner._object_at(plant.now, old) - plant.pose)[:2]))
    assert np.hypot(*(plant.pose - START)[:2]) > 0.02, "the object was pushed meanwhile"
    assert worst < 5e-4


def test_a_moving_arm_that_lags_far_behind_is_stopped_first():
    planner = make_planner()
    plant = ModelPlant(planner, np.array([0.40, -0.05]), START)
    for _ in range(16):
        plant.advance(GOAL)
    lagging = planner.reference(plant.now) + np.array([0.0, 0.07, 0.0, 0.0, 0.0, 0.0, 0.0])
    step = planner.step(plant.now, lagging, np.full(7, 0.2), plant.state(), GOAL)
    assert step.mode == "brake" and "follow" in step.message
    assert step.trajectory.end_time < plant.now + 1.0
    assert_safe(planner, [*plant.published, step.trajectory])


def test_a_reversed_workspace_is_an_error():
    with pytest.raises(ConfigurationError, match=r"object_x = 0\.6, 0\.4"):
        Workspace(object_x=(0.6, 0.4))
    with pytest.raises(ConfigurationError, match="radius_min, radius_max"):
        Workspace(radius_min=0.7, radius_max=0.4)


def test_many_seeds_and_a_small_population_still_plan():
    online = OnlineConfig(search=VpstoConfig(population=6, iterations=3))
    planner = make_planner(seeds=12, online=online)
    plant = ModelPlant(planner, np.array([0.40, -0.05]), START)
    for _ in range(8):
        plant.advance(GOAL)
    assert plant.steps[-1].valid


def test_the_contact_plan_says_where_and_which_way_to_push_first():
    planner = make_planner()
    plant = ModelPlant(planner, np.array([0.40, -0.05]), START)
    for _ in range(5):
        plant.advance(GOAL)
    touch = np.array([0.53, -0.13])
    velocities = np.array([[0.0, 0.3], [0.3, 0.0]])
    plans = [ContactPlan(plant.now + 0.4, touch, velocity, 1e-4 * np.eye(2)) for velocity in velocities]
    guesses = [planner._problem(plant.now, plant.pose, GOAL, plan).guesses(3)[0] for plan in plans]
    for guess, direction in zip(guesses, np.array([[0.0, 1.0], [1.0, 0.0]]), strict=True):
        np.testing.assert_allclose(guess[2], touch, atol=1e-9)
        push = guess[3] - guess[2]
        np.testing.assert_allclose(push / np.hypot(*push), direction, atol=1e-9)
