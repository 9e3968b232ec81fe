"""The particle filter: closed forms, consistency, what contact and touch tell, and what must not break it."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.belief.particles import ObjectBelief
from vpsto_ros.contact.end_effectors import EndEffectors
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.estimation.contact_queries import particle_contacts
from vpsto_ros.estimation.measurement import MeasurementLimits
from vpsto_ros.estimation.object_state import wrap_angle
from vpsto_ros.estimation.particle_cloud import ParticleCloud, moments, pose_moments, systematic
from vpsto_ros.estimation.particle_filter import ObjectParticleFilter
from vpsto_ros.estimation.particle_filter_config import ParticleFilterConfig
from vpsto_ros.estimation.planar_kalman import PlanarKalman
from vpsto_ros.estimation.touch import TouchConfig, likelihoods, read
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError

CAMERA = np.diag([0.002, 0.002, 0.0175]) ** 2
CAN, BOX = PlanarShape.disc(0.05), PlanarShape.box(0.1, 0.1)
BALL = EndEffectors.discs(0.03)
AWAY = np.array([0.2, -0.4])
EXACT = ParticleFilterConfig(model_std=(1e-6, 1e-6))


def dynamics(shape=CAN, effectors=BALL, **fields):
    return BeliefDynamics(shape, effectors, friction=True, step_variance=0.0, way_variance=1e-5, **fields)


def make(seed=0, config=None, model=None, limits=None, **fields):
    config = dataclasses.replace(config or ParticleFilterConfig(), **fields)
    return ObjectParticleFilter(config, model or dynamics(), np.random.default_rng([7, seed]), limits)


def started(pose=(0.5, 0.0, 0.0), std=None, point=AWAY, seed=0, **kwargs):
    """A filter that has seen one plane point and one pose, both at time 0."""
    tracker = make(seed, **kwargs)
    assert tracker.predict(0.0, point) == "accepted"
    noise = CAMERA if std is None else np.diag([std, std, 0.0175]) ** 2
    assert tracker.update(0.0, np.array(pose), noise) == "accepted"
    return tracker


def deviations(tracker, time):
    return np.sqrt(np.diag(tracker.state(time).covariance)[:3])


class World:
    """An object that follows the filter's own model with parameters of its own, and a camera."""

    def __init__(self, seed, model, pose):
        self.rng, self.model = np.random.default_rng([11, seed]), model
        friction, center = self.rng.uniform(0.0, 0.5), 0.005 * self.rng.standard_normal(2)
        self.truth = ObjectBelief(np.tile(pose, (2, 1)), np.full(2, friction), np.tile(center, (2, 1)))
        self.point, self.pictures = None, []

    def move(self, point):
        path = np.array([point if self.point is None else self.point, point])
        self.point = np.array(point)
        self.truth = self.model.simulate(self.truth, path, self.rng).belief
        return self.truth.poses[0]

    def picture(self, std=(0.002, 0.002, 0.0175)):
        return self.truth.poses[0] + np.array(std) * self.rng.standard_normal(3)


def push(
    world, tracker, *, seconds=2.0, speed=0.1, blind=(9.0, 9.0), late=4, start=(0.40, 0.012), kalman=None
):
    """Push along x at 100 Hz, with a picture at 50 Hz that is late by some steps and none while blind."""
    pictures = []
    for k in range(round(100 * seconds)):
        t = 0.01 * k
        point = np.array([start[0] + speed * max(t - 0.3, 0.0), start[1]])
        world.move(point)
        assert tracker.predict(t, point) == "accepted"
        if k % 2 == 0 and not blind[0] <= t < blind[1]:
            pictures.append((k + late, t, world.picture()))
        while pictures and pictures[0][0] <= k:
            _, stamp, pose = pictures.pop(0)
            tracker.update(stamp, pose, CAMERA)
            if kalman is not None:
                kalman.update(stamp, pose, CAMERA)
    return t


# What is known in closed form


def test_poses_of_an_object_at_rest_fuse_like_gaussians():
    """A random walk observed with Gaussian noise: the Kalman filter is the oracle."""
    rng, config = np.random.default_rng(3), dataclasses.replace(EXACT, particles=4000, outlier_share=1e-6)
    tracker = make(1, config, model=dynamics(BOX))
    mean, noise = np.array([0.5, 0.1, 3.1]), CAMERA + 3e-6 * (np.ones((3, 3)) - np.eye(3))
    walk = 0.02 * np.diag([config.drift[0], *config.drift]) ** 2
    covariance, truth = noise.copy(), mean.copy()
    for k in range(25):
        t, pose = 0.02 * k, truth + np.linalg.cholesky(noise) @ rng.standard_normal(3)
        tracker.predict(t, AWAY)
        assert tracker.update(t, pose, noise) == "accepted"
        if k == 0:
            mean = pose
            continue
        covariance = covariance + walk
        gain = covariance @ np.linalg.inv(covariance + noise)
        mean = mean + gain @ (pose - mean)
        covariance = covariance - gain @ covariance
    state = tracker.state(t)
    std = np.sqrt(np.diag(covariance))
    off = state.pose - mean
    assert np.all(np.abs([*off[:2], wrap_angle(off[2])]) < 0.35 * std)
    np.testing.assert_allclose(np.sqrt(np.diag(state.covariance))[:3], std, rtol=0.15)


def test_the_error_is_as_large_as_the_covariance_says():
    """Normalised squared error over seeds, pushed and during a drop-out, two degrees of freedom."""
    values = []
    for seed in range(40):
        world = World(seed, dynamics(), (0.5, 0.0, 0.0))
        tracker = make(seed)
        t = push(world, tracker, blind=(1.3, 1.8), seconds=1.8)
        state = tracker.state(t)
        off = (state.pose - world.truth.poses[0])[:2]
        values.append(off @ np.linalg.solve(state.covariance[:2, :2], off))
    # The model's own error is counted, though this world has none: rather too careful than too sure.
    assert np.sum(values) < stats.chi2.ppf(0.999, 2 * len(values))
    assert np.sum(values) > 0.2 * len(values)


@pytest.mark.parametrize("offset", [0.0, 0.5, 0.999])
def test_systematic_rows_are_in_proportion(offset):
    weights = np.random.default_rng(0).dirichlet(np.ones(50))
    counts = np.bincount(systematic(weights, 1000, offset), minlength=50)
    assert counts.sum() == 1000 and np.abs(counts - 1000 * weights).max() < 1.0


def test_resampling_keeps_mean_and_covariance():
    rng, count = np.random.default_rng(5), 4000
    cloud = ParticleCloud(0.3)
    cloud.push(0.0, AWAY, np.empty((0, 3)))
    poses = rng.standard_normal((count, 3)) @ (np.array([[3.0, 0, 0], [1, 1, 0], [0, 2, 9]]) * 1e-3) + 0.4
    cloud.begin(poses, 0.2 + 10 * (poses[:, 0] - 0.4), np.zeros((count, 2)))
    cloud.reweigh(np.exp(-0.5 * ((poses[:, 0] - 0.401) / 2e-3) ** 2))
    before = pose_moments(poses, cloud.weights)
    for _ in range(3):
        cloud.resample(0.3, (0.0, 2.0), rng)
    mean, covariance = pose_moments(cloud.head.poses, cloud.weights)
    std = np.sqrt(np.diag(before[1]))
    assert np.all(np.abs(mean - before[0]) < 0.1 * std)
    np.testing.assert_allclose(covariance / np.outer(std, std), before[1] / np.outer(std, std), atol=0.1)
    # What belongs together stays together: friction went with x.
    assert np.corrcoef(cloud.head.poses[:, 0], cloud.friction)[0, 1] > 0.99
    assert len(np.unique(cloud.head.poses[:, 0])) == count


def test_no_particle_is_in_an_end_effector():
    for shape in (CAN, BOX):
        model = dynamics(shape)
        world, tracker = World(1, model, (0.5, 0.0, 0.3)), make(1, model=model)
        t = push(world, tracker)
        gaps = particle_contacts(model, tracker.belief(t).poses, world.point, np.zeros(2)).gaps
        assert gaps.min() > -2e-5


# Frames that are late, wrong or missing


def test_a_late_frame_counts_for_when_it_was_taken():
    """The same frames, in time and 80 ms late: the same belief, but for chance."""
    errors = {}
    for late in (0, 8):
        off = []
        for seed in range(10):
            world, tracker = World(seed, dynamics(), (0.5, 0.0, 0.0)), make(seed)
            t = push(world, tracker, late=late, speed=0.15, seconds=1.2)
            off.append((tracker.state(t).pose - world.truth.poses[0])[:2])
        errors[late] = np.array(off)
    # Taken for a present one, a frame would drag the object 12 mm behind.
    assert np.abs(errors[8].mean(axis=0)).max() < 1.5e-3
    assert np.sqrt((errors[8] ** 2).mean()) < 2.0 * np.sqrt((errors[0] ** 2).mean()) + 5e-4


def test_a_frame_may_be_late_but_not_older_than_the_past_that_is_kept():
    tracker = started(limits=MeasurementLimits(max_age=0.3))
    for k in range(1, 101):
        tracker.predict(0.01 * k, AWAY)
    pose = np.array([0.5, 0.0, 0.0])
    assert tracker.update(0.5, pose, CAMERA) == "stale"
    assert tracker.update(0.8, pose, CAMERA) == "accepted"
    assert tracker.update(0.8, pose, CAMERA) == "stale"
    outcome = tracker.update(1.2, pose, CAMERA)
    assert outcome.kind == "invalid" and "ahead" in outcome.reason
    assert "ahead" in tracker.status(1.0).reason


def test_outliers_do_not_move_the_belief():
    rng, tracker = np.random.default_rng(2), started()
    for k in range(1, 101):
        tracker.predict(0.02 * k, AWAY)
        stray = k % 4 == 0
        pose = np.array([0.5, 0.0, 0.0]) + np.sqrt(np.diag(CAMERA)) * rng.standard_normal(3)
        pose[:2] += rng.uniform(0.05, 0.2, 2) * rng.choice([-1, 1], 2) if stray else 0.0
        assert tracker.update(0.02 * k, pose, CAMERA) == ("outlier" if stray else "accepted")
        assert np.hypot(*(tracker.state(0.02 * k).pose[:2] - [0.5, 0.0])) < 3e-3
    assert tracker.status(2.0).kind == "tracking"


@pytest.mark.parametrize("shape", [CAN, BOX])
def test_an_object_that_was_carried_away_is_found_within_four_frames(shape):
    rng, tracker = np.random.default_rng(4), started(model=dynamics(shape))
    kinds, states = [], []
    for k in range(1, 31):
        there = np.array([0.5, 0.0, 0.0]) if k < 10 else np.array([0.42, 0.15, 1.0])
        tracker.predict(0.02 * k, AWAY)
        pose = there + np.sqrt(np.diag(CAMERA)) * rng.standard_normal(3)
        kinds.append(str(tracker.update(0.02 * k, pose, CAMERA)))
        states.append(tracker.status(0.02 * k).kind)
    assert kinds[9:13] == ["outlier", "outlier", "reinitialized", "accepted"]
    assert states[8] == "tracking" and states[10:12] == ["recovering"] * 2 and states[-1] == "tracking"
    assert np.hypot(*(tracker.state(0.6).pose - there)[:2]) < 2e-3


def test_strays_that_contradict_each_other_never_restart():
    tracker = started()
    for k in range(1, 20):
        tracker.predict(0.02 * k, AWAY)
        pose = np.array([0.5 + (0.2 if k % 2 else -0.2), 0.1, 0.0])
        assert tracker.update(0.02 * k, pose, CAMERA) == "outlier"
    np.testing.assert_allclose(tracker.state(0.4).pose[:2], [0.5, 0.0], atol=6e-3)


def test_an_object_is_lost_when_it_is_unseen_and_uncertain_and_found_again():
    tracker = started(drift=(0.03, 0.1))
    for k in range(1, 300):
        tracker.predict(0.01 * k, AWAY)
    status = tracker.status(2.99)
    assert status.kind == "lost" and "not seen for 3 s" in status.reason
    for k in range(5):
        tracker.predict(3.0 + 0.02 * k, AWAY)
        assert tracker.update(3.0 + 0.02 * k, np.array([0.53, 0.02, 0.0]), CAMERA) == "accepted"
    assert tracker.status(3.1).kind == "tracking"
    np.testing.assert_allclose(tracker.state(3.1).pose[:2], [0.53, 0.02], atol=0.01)
    # Unseen, but nothing can have moved it: not lost.
    still = started(confirmations=1)
    for k in range(1, 300):
        still.predict(0.01 * k, AWAY)
    assert still.status(2.99).kind == "tracking" and "not seen" in still.status(2.99).reason


# What contact tells


def test_a_push_is_predicted_through_a_drop_out():
    """A filter that knows the finger stays near the object; one that does not stops where it saw it last."""
    errors = []
    for seed in range(12):
        world, tracker, kalman = World(seed, dynamics(), (0.5, 0.0, 0.0)), make(seed), PlanarKalman()
        t = push(world, tracker, blind=(0.8, 1.6), seconds=1.6, kalman=kalman)
        truth = world.truth.poses[0, :2]
        errors.append([np.hypot(*(f.pose[:2] - truth)) for f in (tracker.state(t), kalman.predict(t))])
    mine, without = np.median(errors, axis=0)
    assert mine < 0.01 < 0.04 < without


def test_the_twist_is_that_of_the_push():
    world, tracker = (
        World(0, dynamics(effectors=EndEffectors.discs(0.03, 2)), (0.5, 0.0, 0.0)),
        make(0, model=dynamics(effectors=EndEffectors.discs(0.03, 2))),
    )
    for k in range(100):
        x = 0.42 + 0.001 * k
        world.move([x, 0.04, x, -0.04])
        tracker.predict(0.01 * k, [x, 0.04, x, -0.04])
        if k % 2 == 0:
            tracker.update(0.01 * k, world.picture(), CAMERA)
    np.testing.assert_allclose(tracker.state(0.99).twist[:2], [0.1, 0.0], atol=5e-3)
    # On from the last plane point, the balls go on for a moment; a path says it better.
    ahead = tracker.belief(1.03).mean[0] - tracker.belief(0.99).mean[0]
    assert ahead == pytest.approx(0.004, abs=5e-4)
    path = np.array([[0.519, 0.04, 0.519, -0.04], [0.519, 0.04, 0.519, -0.04]])
    assert tracker.belief(1.03, path=path).mean[0] == pytest.approx(tracker.belief(0.99).mean[0], abs=5e-4)


def test_asking_changes_nothing():
    one, other = started(seed=3), started(seed=3)
    for k in range(1, 40):
        for tracker in (one, other):
            tracker.predict(0.01 * k, [0.3 + 0.003 * k, 0.0])
            tracker.update(0.01 * k, np.array([0.5, 0.0, 0.0]), CAMERA)
        one.belief(0.01 * k + 0.03, 20), one.state(0.01 * k + 0.01), one.status(0.0)
    np.testing.assert_array_equal(one.belief(0.39).poses, other.belief(0.39).poses)


# What touch tells


def feel(tracker, world, t, point, velocity):
    """Contact of the true object with the ball, as a clean force on the robot."""
    here = particle_contacts(world.model, world.truth.poses[:1], point, velocity)
    touching = here.gaps[0, 0] < 1e-4 and here.approach[0, 0] > 1e-3
    return tracker.touch(t, -1.5 * here.normals[0, 0] if touching else np.zeros(2), 0.1)


def approach(seed, with_touch, std=0.02, shape=CAN):
    """The camera has seen the object once, badly; then the ball comes and pushes it for 2 cm."""
    model = dynamics(shape)
    world = World(seed, model, (0.5, 0.0, 0.2))
    tracker = make(seed, model=model)
    noise = np.diag([std, std, 0.02]) ** 2
    tracker.predict(0.0, [0.38, 0.0])
    tracker.update(0.0, world.picture((std, std, 0.02)), noise)
    for k in range(1, 121):
        point = np.array([min(0.38 + 0.0005 * k, 0.44), 0.0])
        world.move(point)
        tracker.predict(0.01 * k, point)
        if with_touch and k % 2 == 0:
            feel(tracker, world, 0.01 * k, point, np.array([0.05, 0.0]))
    state = tracker.state(1.2)
    off = state.pose[:2] - world.truth.poses[0, :2]
    return np.trace(state.covariance[:2, :2]), off


@pytest.mark.parametrize("shape", [CAN, BOX])
def test_touch_narrows_the_belief_while_the_camera_is_off(shape):
    """In contact, a ball tells where the object's near side is, though hardly where along it."""
    runs = {touch: [approach(seed, touch, shape=shape) for seed in range(15)] for touch in (False, True)}
    along = {touch: np.sqrt(np.mean([off[0] ** 2 for _, off in runs[touch]])) for touch in runs}
    variance = {touch: np.mean([value for value, _ in runs[touch]]) for touch in runs}
    assert along[True] < 0.5 * along[False]
    assert variance[True] < 0.5 * variance[False]


def test_no_contact_rules_out_what_would_have_been_pushed():
    tracker = started(std=0.02, point=[0.40, 0.0])
    for k in range(1, 41):
        tracker.predict(0.01 * k, [0.40 + 0.0005 * k, 0.0])
        assert tracker.touch(0.01 * k, [0.0, 0.0], 0.1) in ("accepted", "stale")
    gaps = particle_contacts(tracker.dynamics, tracker.belief(0.4).poses, [0.42, 0.0], np.zeros(2)).gaps
    blind = started(std=0.02, point=[0.40, 0.0])
    for k in range(1, 41):
        blind.predict(0.01 * k, [0.40 + 0.0005 * k, 0.0])
    same = particle_contacts(blind.dynamics, blind.belief(0.4).poses, [0.42, 0.0], np.zeros(2)).gaps
    assert np.mean(gaps < 1e-3) < 0.5 * np.mean(same < 1e-3)


def test_contact_draws_particles_to_the_manifold_even_if_none_was_there():
    tracker = started(std=0.004, point=[0.412, 0.0])  # the gap is 8 mm, two standard deviations
    tracker.predict(0.01, [0.4125, 0.0])
    assert tracker.touch(0.01, [-1.5, 0.0], 0.1) == "accepted"
    gaps = particle_contacts(tracker.dynamics, tracker.belief(0.01).poses, [0.4125, 0.0], np.zeros(2)).gaps
    assert np.mean(gaps < 6e-3) > 0.9
    # Ten times as far it is no contact with this object.
    far = started(std=0.004, point=[0.3, 0.0])
    outcome = far.touch(0.0, [-1.5, 0.0], 0.1)
    assert outcome == "outlier" and "no particle" in outcome.reason


def test_the_direction_of_the_force_tells_the_side():
    tracker = started(std=0.01, point=[0.42, 0.0])
    before = tracker.state(0.0).pose[1]
    for k in range(1, 6):
        tracker.predict(0.1 * k, [0.42, 0.0])
        force = -1.5 * np.array([math.cos(0.5), math.sin(0.5)])  # the object is pushed to the left
        tracker.touch(0.1 * k, force, 0.1)
    assert tracker.state(0.5).pose[1] > before + 3e-3


def test_likelihoods_of_a_touch_are_densities():
    """Over all directions of a felt force, plus not feeling any, they sum to one."""
    model = dynamics(effectors=EndEffectors.discs(0.03, 2))
    poses = np.array([[0.5, 0.0, 0.0], [0.51, 0.01, 0.0], [0.7, 0.0, 0.0]])
    point = np.array([0.5 - math.sqrt(0.08**2 - 0.04**2), 0.04, 0.5 - math.sqrt(0.08**2 - 0.04**2), -0.04])
    contacts = particle_contacts(model, poses, point, np.array([0.1, 0.0, 0.1, 0.0]))
    friction, config = np.array([0.0, 0.3, 0.3]), TouchConfig()
    angles = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    ring = 2.0 * np.column_stack([np.cos(angles), np.sin(angles)])

    def value(forces):
        return likelihoods(config, read(config, np.atleast_2d(forces), 0.05), contacts, friction)

    quiet = np.zeros(2)
    summed = value(quiet) + 2 * np.pi * np.mean([value(f) for f in ring], axis=0)
    np.testing.assert_allclose(summed, 1.0, atol=0.02)
    some = angles[::12]
    ring = 2.0 * np.column_stack([np.cos(some), np.sin(some)])
    left = value([quiet, quiet]) + 2 * np.pi * np.mean([value([f, quiet]) for f in ring], axis=0)
    right = 2 * np.pi * np.mean([value([quiet, f]) for f in ring], axis=0)
    both = (2 * np.pi) ** 2 * np.mean([value([f, g]) for f in ring for g in ring], axis=0)
    np.testing.assert_allclose(left + right + both, 1.0, atol=0.02)


# What comes from outside


@pytest.mark.parametrize(
    ("stamp", "pose", "covariance", "reason"),
    [
        (0.1, [np.nan, 0.0, 0.0], CAMERA, "finite"),
        (np.inf, [0.5, 0.0, 0.0], CAMERA, "finite"),
        (0.1, [0.5, 0.0], CAMERA, "expected pose"),
        (0.1, "here", CAMERA, "not numbers"),
        (0.1, [0.5, 0.0, 0.0], -CAMERA, "positive definite"),
        (0.1, [0.5, 0.0, 0.0], np.zeros((3, 3)), "positive definite"),
        (0.1, [0.5, 0.0, 0.0], CAMERA + np.triu(np.full((3, 3), 1e-5), 1), "symmetric"),
        (0.1, [0.5, 2.0, 0.0], CAMERA, "outside the table"),
        (0.3, [0.5, 0.0, 0.0], CAMERA, "ahead"),
        (0.1, [0.5, 0.0, 0.0], 1e200 * CAMERA, "tells nothing"),
    ],
)
def test_a_bad_pose_is_refused_with_a_reason_and_changes_nothing(stamp, pose, covariance, reason):
    tracker = started()
    tracker.predict(0.1, AWAY)
    before = tracker.belief(0.1).poses
    outcome = tracker.update(stamp, pose, covariance)
    assert outcome.kind == "invalid" and reason in outcome.reason
    np.testing.assert_array_equal(tracker.belief(0.1).poses, before)
    assert tracker.update(0.1, np.array([0.5, 0.0, 0.0]), CAMERA) == "accepted"


@pytest.mark.parametrize("time, point", [(np.nan, AWAY), (0.1, [0.1]), (0.1, [0.1, np.inf]), ("now", AWAY)])
def test_a_bad_plane_point_is_refused(time, point):
    tracker = started()
    assert tracker.predict(time, point).kind == "invalid"
    assert tracker.predict(0.0, AWAY) == "stale" and tracker.predict(-5.0, AWAY) == "stale"
    assert tracker.predict(0.01, AWAY) == "accepted"


@pytest.mark.parametrize(
    ("stamp", "force", "noise", "kind"),
    [
        (0.0, [1.0, 0.0, 0.0], 0.1, "invalid"), (0.0, [np.nan, 0.0], 0.1, "invalid"),
        (0.0, [1.0, 0.0], -0.1, "invalid"), (np.nan, [1.0, 0.0], 0.1, "invalid"),
        (9.0, [1.0, 0.0], 0.1, "invalid"), (-9.0, [1.0, 0.0], 0.1, "stale"),
    ],
)  # fmt: skip
def test_a_bad_force_is_refused(stamp, force, noise, kind):
    assert started().touch(stamp, force, noise).kind == kind
    assert make().touch(0.0, [0.0, 0.0], 0.1).kind == "invalid"


def test_before_the_first_pose_there_is_no_belief():
    tracker = make()
    assert tracker.status(0.0).kind == "uninitialised"
    assert tracker.state(0.0) is None and tracker.belief(0.0) is None
    outcome = tracker.update(0.0, np.array([0.5, 0.0, 0.0]), CAMERA)
    assert outcome.kind == "invalid" and "plane point" in outcome.reason
    assert tracker.status(0.0).reason == outcome.reason
    with pytest.raises(InvalidInputError):
        started().state(np.nan)
    with pytest.raises(InvalidInputError):
        started().belief(1.0, path=[[0.0, 0.0]])
    with pytest.raises(InvalidInputError):
        started().belief(1.0, 1)


def test_a_gap_of_plane_points_does_not_sweep_the_object_away():
    tracker = started(point=[0.3, 0.0])
    outcome = tracker.predict(2.0, [0.7, 0.0])  # it went round
    assert outcome == "accepted" and "unknown" in outcome.reason
    np.testing.assert_allclose(tracker.state(2.0).pose[:2], [0.5, 0.0], atol=6e-3)
    # Nor does a posture that jumps.
    assert "unknown" in tracker.predict(2.01, [0.3, 0.0]).reason
    np.testing.assert_allclose(tracker.state(2.01).pose[:2], [0.5, 0.0], atol=6e-3)
    # Where the end effector is now the object is not.
    tracker.predict(4.0, [0.5, 0.01])
    gaps = particle_contacts(tracker.dynamics, tracker.belief(4.0).poses, [0.5, 0.01], np.zeros(2)).gaps
    assert gaps.min() > -1e-6


def test_reset_forgets_and_time_may_start_again():
    tracker = started()
    tracker.predict(50.0, AWAY)
    tracker.reset()
    assert tracker.status(0.0).kind == "uninitialised"
    assert tracker.predict(1.0, AWAY) == "accepted"
    assert tracker.update(1.0, np.array([0.5, 0.0, 0.0]), CAMERA) == "accepted"


def test_a_yaw_beyond_half_a_turn_is_the_same_yaw():
    tracker = started((0.5, 0.0, math.pi - 0.01), model=dynamics(BOX))
    rng = np.random.default_rng(8)
    for k in range(1, 30):
        tracker.predict(0.02 * k, AWAY)
        yaw = wrap_angle(math.pi + 0.02 * rng.standard_normal())
        assert tracker.update(0.02 * k, np.array([0.5, 0.0, yaw]), CAMERA) == "accepted"
    assert abs(wrap_angle(tracker.state(0.58).pose[2] - math.pi)) < 0.02
    assert deviations(tracker, 0.58)[2] < 0.02


def test_the_yaw_of_a_disc_is_not_looked_at():
    tracker = started()
    for k in range(1, 20):
        tracker.predict(0.02 * k, AWAY)
        assert tracker.update(0.02 * k, np.array([0.5, 0.0, 2.0 * (-1) ** k]), CAMERA) == "accepted"


def test_limits_are_those_that_were_given():
    """What each limit of its own refuses, a wider one lets through."""
    narrow, wide = MeasurementLimits((0.45, 0.55), (-0.05, 0.05), 0.05, 0.0), MeasurementLimits()
    for stamp, x, y in ((0.1, 0.6, 0.0), (0.1, 0.5, 0.1), (0.04, 0.5, 0.0), (0.11, 0.5, 0.0)):
        outcomes = {}
        for limits in (narrow, wide):
            tracker = started(limits=limits, std=0.1)
            for k in range(1, 11):
                tracker.predict(0.01 * k, AWAY)
            outcomes[limits] = tracker.update(stamp, [x, y, 0.0], 1e-2 * np.eye(3)).kind
        assert outcomes[narrow] in ("invalid", "stale") and outcomes[wide] == "accepted", (stamp, x, y)


@pytest.mark.parametrize(
    ("config", "fields"),
    [
        (ParticleFilterConfig, {"particles": 1}), (ParticleFilterConfig, {"friction": (0.5, 0.1)}),
        (ParticleFilterConfig, {"outlier_share": 0.0}), (MeasurementLimits, {"table_x": (1.0, 0.0)}),
        (MeasurementLimits, {"max_age": 0.0}),
    ],
)  # fmt: skip
def test_a_bad_option_is_named(config, fields):
    with pytest.raises(ConfigurationError, match=next(iter(fields))):
        config(**fields)


def test_moments_are_numpys():
    rng = np.random.default_rng(1)
    rows, weights = rng.standard_normal((30, 4)), rng.dirichlet(np.ones(30))
    mean, covariance = moments(rows, weights)
    np.testing.assert_allclose(mean, np.average(rows, axis=0, weights=weights))
    np.testing.assert_allclose(covariance, np.cov(rows.T, aweights=weights, ddof=0))
