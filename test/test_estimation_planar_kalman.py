"""The planar filter: accuracy, consistency, knocks, outliers and bad input."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.stats import chi2

from vpsto_ros.estimation.motion_modes import ModeBelief, MotionModes
from vpsto_ros.estimation.object_state import ObjectState, wrap_angle
from vpsto_ros.estimation.planar_kalman import Outcome, PlanarKalman, PlanarKalmanConfig
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError

STD = np.array([0.002, 0.002, math.radians(1.0)])
NOISE = np.diag(STD**2)


@dataclasses.dataclass
class Run:
    """Errors of a filter along a true motion at the frames and 40 ms ahead, and of its twist, each (K, 3)."""

    times: np.ndarray
    error: np.ndarray
    ahead: np.ndarray
    twist: np.ndarray
    outcomes: list

    def between(self, begin, end):
        chosen = (self.times >= begin) & (self.times < end)
        return dataclasses.replace(
            self,
            times=self.times[chosen],
            error=self.error[chosen],
            ahead=self.ahead[chosen],
            twist=self.twist[chosen],
        )


def follow(velocity, *, duration, seed=0, rate=50, dropout=0.05, latency=0.04):
    """Filter noisy poses of a motion with velocity(t (K,)) -> (K, 3)."""
    rng = np.random.default_rng(seed)
    fine = np.arange(0, duration + 0.2, 1e-3)
    twist = velocity(fine)
    pose = np.cumsum(twist, axis=0) * 1e-3
    kalman, rows, outcomes = PlanarKalman(), [], []
    for k in range(0, int(duration * 1000), 1000 // rate):
        stamp = fine[k]
        if rng.random() >= dropout:
            outcomes.append((stamp, kalman.update(stamp, pose[k] + STD * rng.standard_normal(3), NOISE)))
        state, later = kalman.predict(stamp), kalman.predict(stamp + latency)
        if state is not None:
            ahead = later.pose - pose[k + int(1000 * latency)]
            rows.append((stamp, state.pose - pose[k], ahead, state.twist - twist[k]))
    times, error, ahead, speed = (np.array(column) for column in zip(*rows, strict=True))
    error[:, 2], ahead[:, 2] = wrap_angle(error[:, 2]), wrap_angle(ahead[:, 2])
    return Run(times, error, ahead, speed, outcomes)


def rms(values):
    return np.sqrt(np.square(values).mean(axis=0))


def standing(t):
    return np.zeros((t.size, 3))


def pushed(t):
    """Accelerated at 3 m/s^2 to 0.3 m/s, kept there for 2 s, stopped; turning a little."""
    speed = np.clip(np.minimum(3.0 * (t - 1.0), 3.0 * (3.1 - t)), 0.0, 0.3)
    return np.stack([speed, np.zeros_like(t), speed], axis=1)


def knocked(t):
    """10 cm by hand within 0.25 s, peak speed 0.75 m/s."""
    s = np.clip((t - 1.0) / 0.25, 0, 1)
    return np.stack([np.zeros_like(t), 0.1 * 30 * s**2 * (1 - s) ** 2 / 0.25, np.zeros_like(t)], axis=1)


@pytest.mark.parametrize("rate", [20, 30, 50])
def test_a_standing_object_is_known_better_than_the_camera_sees_it(rate):
    run = follow(standing, duration=12.0, rate=rate).between(0.5, 12.0)
    assert np.all(rms(run.error)[:2] < 0.001)
    assert rms(run.error)[2] < math.radians(0.5)
    assert np.all(rms(run.twist)[:2] < 0.015)
    assert np.all(rms(run.ahead)[:2] < 0.0015)


def test_pushing_is_followed_without_lag():
    runs = [follow(pushed, duration=4.0, seed=seed) for seed in range(10)]
    steady = [run.between(1.3, 3.0) for run in runs]
    assert abs(np.mean([run.error[:, 0].mean() for run in steady])) < 0.0005
    assert rms(np.concatenate([run.error for run in steady]))[0] < 0.002
    assert rms(np.concatenate([run.ahead for run in steady]))[0] < 0.003
    assert abs(np.mean([run.twist[:, 0].mean() for run in steady])) < 0.01
    worst = max(np.abs(run.between(1.0, 1.3).error[:, 0]).mean() for run in runs)
    assert worst < 0.003


def test_the_object_stops_when_it_stops():
    for seed in range(5):
        rest = follow(pushed, duration=4.5, seed=seed).between(3.4, 4.5)
        assert np.abs(rest.twist[:, 0]).mean() < 0.02
        assert rms(rest.error)[0] < 0.0015


@pytest.mark.parametrize("rate", [20, 50])
def test_a_knock_is_followed(rate):
    for seed in range(10):
        run = follow(knocked, duration=2.0, seed=seed, rate=rate, dropout=0.0)
        assert np.abs(run.between(1.0, 2.0).error[:, 1]).max() < (0.012 if rate == 50 else 0.04)
        assert np.abs(run.between(1.35, 2.0).error[:, 1]).max() < 0.008
        assert np.count_nonzero([outcome == "outlier" for _, outcome in run.outcomes]) <= 2


def settled(poses=60, position=(0.5, 0.1, 0.3), rate=50.0):
    """A filter that has watched a standing object."""
    kalman, rng = PlanarKalman(), np.random.default_rng(1)
    for k in range(poses):
        assert kalman.update(k / rate, position + STD * rng.standard_normal(3), NOISE) == "accepted"
    return kalman, poses / rate


def test_an_object_put_elsewhere_is_found_within_a_tenth_of_a_second():
    kalman, now = settled()
    elsewhere = np.array([0.58, 0.1, 0.9])
    outcomes = [kalman.update(now + 0.02 * k, elsewhere, NOISE) for k in range(3)]
    assert outcomes == ["outlier", "outlier", "reinitialized"]
    assert "agree" in outcomes[-1].reason and "Mahalanobis" in outcomes[0].reason
    np.testing.assert_allclose(kalman.state.pose, elsewhere, atol=0.003)
    assert np.linalg.norm(kalman.state.twist[:2]) < 0.1


def test_a_moving_object_is_found_with_its_velocity():
    kalman, now = settled()
    for k in range(4):
        kalman.update(now + 0.02 * k, np.array([0.7 + 0.6 * 0.02 * k, 0.1, 0.3]), NOISE)
    assert kalman.state.twist[0] == pytest.approx(0.6, abs=0.1)


@pytest.mark.parametrize("wild", [[0.8, 0.1, 0.3], [0.5, 0.1, 0.3 + math.pi], [0.5, 0.1, 0.3 + math.pi / 2]])
def test_a_single_wild_pose_changes_nothing(wild):
    kalman, now = settled()
    before = kalman.state
    assert kalman.update(now, np.array(wild), NOISE) == "outlier"
    np.testing.assert_array_equal(kalman.state.pose, before.pose)
    assert kalman.update(now + 0.02, np.array([0.5, 0.1, 0.3]), NOISE) == "accepted"


def test_wild_poses_that_contradict_each_other_never_take_over():
    kalman, now = settled()
    rng = np.random.default_rng(0)
    for k in range(20):
        wild = np.array([0.5, 0.1, 0.3]) + rng.choice([-1, 1], 3) * rng.uniform(0.2, 0.5, 3)
        assert kalman.update(now + 0.015 * k, wild, NOISE) == "outlier"
    np.testing.assert_allclose(kalman.state.pose, [0.5, 0.1, 0.3], atol=0.01)


def test_frequent_wild_poses_are_survived():
    kalman, rng = PlanarKalman(), np.random.default_rng(2)
    truth = np.array([0.5, 0.1, 0.3])
    kalman.update(0.0, truth, NOISE)
    for k in range(1, 1000):
        wild = rng.random() < 0.1
        pose = truth + STD * rng.standard_normal(3) + (rng.uniform(-0.4, 0.4, 3) if wild else 0.0)
        kalman.update(0.02 * k, pose, NOISE)
        assert np.linalg.norm(kalman.state.pose[:2] - truth[:2]) < 0.01


def white_noise_motion(rng, noise, steps, gap):
    """Truth of the filter's own moving model."""
    density = np.array([noise[0], noise[0], noise[1]]) ** 2
    block = np.array([[gap**3 / 3, gap**2 / 2], [gap**2 / 2, gap]])
    kicks = np.einsum("ij,ksj->ksi", np.linalg.cholesky(block), rng.standard_normal((steps, 3, 2)))
    kicks *= np.sqrt(density)[:, None]
    pose, twist = np.zeros(3), np.zeros(3)
    for kick in kicks:
        pose = pose + gap * twist + kick[:, 0]
        twist = twist + kick[:, 1]
        yield np.concatenate([pose, twist])


def test_one_mode_is_statistically_consistent():
    """Normalised innovations and errors of the matching model are chi-square."""
    noise = (0.8, 8.0)
    modes = MotionModes(np.ones(1), np.zeros((1, 3)), np.array([[0.8, 0.8, 8.0]]), np.ones(1))
    rng = np.random.default_rng(0)
    innovations, errors = [], []
    for _ in range(100):
        belief = ModeBelief(np.ones(1), np.zeros((1, 6)), np.diag([1e-6] * 3 + [1e-6] * 3)[None])
        for truth in white_noise_motion(rng, noise, 40, 0.02):
            measured = truth[:3] + STD * rng.standard_normal(3)
            predicted = belief.mixed(modes, 0.02).propagated(modes, 0.02)
            innovation = predicted.innovation(measured, NOISE)
            innovations.append(innovation.distance[0])
            belief = predicted.updated(innovation, NOISE)
        mean, covariance = belief.moments()
        error = mean - truth
        error[2] = wrap_angle(error[2])
        errors.append(error @ np.linalg.solve(covariance, error))
    for values, freedom in ((innovations, 3), (errors, 6)):
        low, high = chi2.ppf([0.0005, 0.9995], freedom * len(values)) / len(values)
        assert low < np.mean(values) < high


def switching_motion(config, rng, steps, gap):
    """Truth of the filter's own model: it rests, moves evenly or is accelerated, and changes between them."""
    kalman = PlanarKalman(config)
    chances, mode = kalman._modes.switching(gap), 0
    matrices, noises = kalman._modes.transition(gap)
    roots, state = np.linalg.cholesky(noises), np.zeros(6)
    for _ in range(steps):
        mode = rng.choice(3, p=chances[mode])
        state = matrices[mode] @ state + roots[mode] @ rng.standard_normal(6)
        yield state


def test_the_covariance_tells_the_truth_about_an_object_that_changes_its_mode():
    config, rng = PlanarKalmanConfig(), np.random.default_rng(0)
    innovations, errors = [], []
    for _ in range(25):
        kalman = PlanarKalman(config)
        for k, truth in enumerate(switching_motion(config, rng, 200, 0.02)):
            measured, expected = truth[:3] + STD * rng.standard_normal(3), kalman.predict(0.02 * k)
            assert kalman.update(0.02 * k, measured, NOISE) == "accepted"
            if k < 10:
                continue
            surprise = measured - expected.pose
            surprise[2] = wrap_angle(surprise[2])
            innovations.append(surprise @ np.linalg.solve(expected.covariance[:3, :3] + NOISE, surprise))
            state = kalman.state
            error = np.concatenate([state.pose, state.twist]) - truth
            error[2] = wrap_angle(error[2])
            errors.append(error @ np.linalg.solve(state.covariance, error))
    assert np.mean(innovations) == pytest.approx(3.0, abs=0.2)
    assert np.mean(errors) == pytest.approx(6.0, abs=1.0)


def test_the_covariance_of_a_standing_object_is_not_too_small():
    errors = []
    for seed in range(40):
        rng, kalman = np.random.default_rng(seed), PlanarKalman()
        for k in range(100):
            kalman.update(0.02 * k, STD * rng.standard_normal(3), NOISE)
        error = kalman.state.pose
        errors.append(error @ np.linalg.solve(kalman.state.covariance[:3, :3], error))
    assert np.mean(errors) < 3.0 * 1.5


def test_yaw_goes_round_without_a_jump():
    kalman, rng, yaws = PlanarKalman(), np.random.default_rng(0), []
    errors = []
    for k in range(600):
        true = wrap_angle(1.5 * 0.02 * k)
        measured = np.array([0.0, 0.0, wrap_angle(true + STD[2] * rng.standard_normal())])
        assert kalman.update(0.02 * k, measured, NOISE) == "accepted"
        state = kalman.predict(0.02 * k + 0.04)
        yaws.append(state.pose[2])
        assert -math.pi <= state.pose[2] <= math.pi
        errors.append(wrap_angle(state.pose[2] - true - 0.06))
    assert rms(errors[20:]) < math.radians(1.5) and np.abs(errors).max() < 0.2
    assert max(yaws) > 3.0 and min(yaws) < -3.0
    # The same pose given with any number of full turns is the same pose.
    assert kalman.update(12.0, np.array([0.0, 0.0, true + 0.03 + 8 * math.pi]), NOISE) == "accepted"


BAD = {
    "nan pose": (10.0, [math.nan, 0, 0], NOISE, "not finite"),
    "inf pose": (10.0, [0, math.inf, 0], NOISE, "not finite"),
    "nan stamp": (math.nan, [0.5, 0.1, 0.3], NOISE, "not finite"),
    "nan covariance": (10.0, [0.5, 0.1, 0.3], np.full((3, 3), math.nan), "not finite"),
    "zero covariance": (10.0, [0.5, 0.1, 0.3], np.zeros((3, 3)), "not positive definite"),
    "negative covariance": (10.0, [0.5, 0.1, 0.3], -NOISE, "not positive definite"),
    "asymmetric covariance": (10.0, [0.5, 0.1, 0.3], NOISE + np.triu(np.ones((3, 3)), 1), "not symmetric"),
    "wrong shape": (10.0, [0.5, 0.1], NOISE, "expected pose (3,)"),
    "wrong covariance shape": (10.0, [0.5, 0.1, 0.3], np.eye(6), "got (3,) and (6, 6)"),
    "text": (10.0, ["a", "b", "c"], NOISE, "not numbers"),
    "absurd": (10.0, [1e9, 0.0, 0.0], NOISE, "beyond"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_poses_are_refused_with_the_reason(name):
    stamp, pose, covariance, reason = BAD[name]
    kalman, _ = settled()
    before = kalman.state
    for _ in range(5):
        outcome = kalman.update(stamp, pose, covariance)
        assert outcome.startswith("invalid: ") and outcome.kind == "invalid" and reason in outcome.reason
    after = kalman.state
    assert after.stamp == before.stamp
    np.testing.assert_array_equal(after.pose, before.pose)
    np.testing.assert_array_equal(after.covariance, before.covariance)


def test_a_fresh_filter_refuses_bad_poses_too():
    kalman = PlanarKalman()
    assert kalman.state is None and kalman.predict(1.0) is None
    assert kalman.update(0.0, [math.nan] * 3, NOISE).kind == "invalid"
    assert kalman.state is None
    assert kalman.update(0.0, [0.1, 0.2, 0.3], NOISE) == "accepted"
    np.testing.assert_allclose(kalman.state.pose, [0.1, 0.2, 0.3])


def test_late_and_repeated_poses_are_stale():
    kalman, now = settled()
    before = kalman.state
    for stamp in (before.stamp, before.stamp - 0.02, before.stamp - 0.3):
        outcome = kalman.update(stamp, np.array([0.5, 0.1, 0.3]), NOISE)
        assert outcome == "stale" and "older" in outcome.reason
    np.testing.assert_array_equal(kalman.state.pose, before.pose)
    assert kalman.update(now, np.array([0.5, 0.1, 0.3]), NOISE) == "accepted"


@pytest.mark.parametrize("jump", [-1000.0, -1.0, 10.0, 1e6])
def test_one_wrong_stamp_is_refused_and_a_new_clock_is_followed(jump):
    kalman, now = settled()
    before, pose = kalman.state, np.array([0.5, 0.1, 0.3])
    outcome = kalman.update(now + jump, pose, NOISE)
    assert outcome.kind == "invalid" and "stamp jumps" in outcome.reason
    assert kalman.state.stamp == before.stamp
    assert kalman.update(now, pose, NOISE) == "accepted"
    outcomes = [kalman.update(now + jump + 0.02 * k, pose, NOISE).kind for k in range(1, 4)]
    assert outcomes == ["invalid", "invalid", "reinitialized"]
    assert kalman.state.stamp == pytest.approx(now + jump + 0.06)


def test_after_a_long_gap_the_first_pose_counts():
    kalman, now = settled()
    outcome = kalman.update(now + 1.0, np.array([0.9, 0.1, 0.3]), NOISE)
    assert outcome == "reinitialized" and "after" in outcome.reason
    np.testing.assert_allclose(kalman.state.pose, [0.9, 0.1, 0.3])


def test_a_short_drop_out_changes_nothing():
    kalman, now = settled()
    assert kalman.update(now + 0.3, np.array([0.5, 0.1, 0.3]), NOISE) == "accepted"


def test_predictions_move_on_and_stop():
    kalman = PlanarKalman()
    for k in range(100):
        kalman.update(0.02 * k, np.array([0.3 * 0.02 * k, 0.0, 0.0]), NOISE)
    state = kalman.state
    soon, later, much_later = (kalman.predict(state.stamp + gap) for gap in (0.04, 1.0, 10.0))
    assert soon.stamp == state.stamp + 0.04
    assert soon.pose[0] - state.pose[0] == pytest.approx(0.3 * 0.04, abs=0.001)
    assert later.pose[0] - state.pose[0] == pytest.approx(0.3 * 0.2, abs=0.005)
    np.testing.assert_array_equal(later.twist, 0.0)
    variances = [s.covariance[0, 0] for s in (state, soon, later, much_later)]
    assert variances == sorted(variances)
    assert kalman.predict(state.stamp - 1.0).stamp == state.stamp
    with pytest.raises(InvalidInputError, match="cannot predict"):
        kalman.predict(math.nan)


def test_predicting_does_not_change_the_filter():
    kalman, now = settled()
    before = kalman.state
    kalman.predict(now + 5.0)
    np.testing.assert_array_equal(kalman.state.pose, before.pose)
    np.testing.assert_array_equal(kalman.state.covariance, before.covariance)


def test_results_do_not_share_memory_with_the_filter():
    kalman, now = settled()
    pose = np.array([0.5, 0.1, 0.3])
    kalman.update(now, pose, NOISE)
    kept = kalman.state.pose.copy()
    state = kalman.state
    state.pose[:], state.covariance[:], pose[:] = 99.0, 99.0, 99.0
    np.testing.assert_array_equal(kalman.state.pose, kept)


def test_reset_forgets_everything():
    kalman, _ = settled()
    kalman.reset()
    assert kalman.state is None
    assert kalman.update(0.0, np.array([5.0, 5.0, 0.0]), NOISE) == "accepted"


def test_modes_tell_what_the_object_does():
    kalman, _ = settled(poses=100)
    assert kalman._belief.probability.sum() == pytest.approx(1.0)
    assert kalman._belief.probability[0] > 0.6
    for k in range(100, 160):
        kalman.update(0.02 * k, np.array([0.5 + 0.3 * 0.02 * (k - 100), 0.1, 0.3]), NOISE)
    assert kalman._belief.probability[0] < 0.05


def test_one_mode_alone_is_a_plain_kalman_filter():
    modes = MotionModes(np.ones(1), np.zeros((1, 3)), np.full((1, 3), 0.5), np.ones(1))
    belief = ModeBelief(np.ones(1), np.zeros((1, 6)), np.eye(6)[None])
    mean, covariance = np.zeros(6), np.eye(6)
    transition = np.eye(6) + 0.02 * np.eye(6, k=3)
    block = 0.25 * np.array([[0.02**3 / 3, 0.02**2 / 2], [0.02**2 / 2, 0.02]])
    process = np.kron(block, np.eye(3))
    measure = np.eye(3, 6)
    rng = np.random.default_rng(0)
    for _ in range(50):
        pose = 0.1 * rng.standard_normal(3)
        predicted = belief.mixed(modes, 0.02).propagated(modes, 0.02)
        belief = predicted.updated(predicted.innovation(pose, NOISE), NOISE)
        mean, covariance = transition @ mean, transition @ covariance @ transition.T + process
        gain = covariance @ measure.T @ np.linalg.inv(measure @ covariance @ measure.T + NOISE)
        mean = mean + gain @ (pose - measure @ mean)
        covariance = (np.eye(6) - gain @ measure) @ covariance
        np.testing.assert_allclose(belief.mean[0], mean, atol=1e-9)
        np.testing.assert_allclose(belief.covariance[0], covariance, atol=1e-9)


def test_configuration_errors_name_the_field():
    with pytest.raises(ConfigurationError, match=r"PlanarKalmanConfig\.gate = 0"):
        PlanarKalmanConfig(gate=0.0)
    with pytest.raises(ConfigurationError, match=r"max_jump = 0\.1 must not be smaller"):
        PlanarKalmanConfig(max_jump=0.1)


def test_an_object_state_is_checked():
    with pytest.raises(InvalidInputError, match=r"pose \(3,\)"):
        ObjectState(0.0, np.zeros(2), np.zeros(3), np.eye(6))
    with pytest.raises(InvalidInputError, match="finite"):
        ObjectState(0.0, np.zeros(3), np.full(3, np.nan), np.eye(6))


def test_outcomes_compare_as_text():
    assert Outcome("accepted") == "accepted" and Outcome("outlier", "far").reason == "far"
    assert Outcome("invalid", "why") == "invalid: why" and Outcome("invalid", "why").kind == "invalid"


def test_angles_are_wrapped_into_one_turn_and_kept_if_they_are_in_it():
    inside = np.concatenate([np.linspace(-3.14, np.pi, 101), [1e-300, -1e-300, 0.0]])
    np.testing.assert_array_equal(wrap_angle(inside), inside)
    assert wrap_angle(-np.pi) == wrap_angle(np.pi) == np.pi
    angles = np.random.default_rng(0).uniform(-50.0, 50.0, 1000)
    angles = np.concatenate(
        [angles, np.nextafter([-np.pi, np.pi], 0.0), np.nextafter([-np.pi, np.pi], [-9, 9])]
    )
    wrapped = wrap_angle(angles)
    assert np.all((wrapped > -np.pi) & (wrapped <= np.pi))
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angles), atol=1e-13)
