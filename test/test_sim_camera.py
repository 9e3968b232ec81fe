"""The camera's timing, noise and drop-outs."""

import numpy as np
import pytest

from sim_bridge.camera import Camera, CameraConfig
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError


def record(config, seed=0, duration=100.0, pose=(0.5, 0.1, 3.1)):
    camera = Camera(config, np.random.default_rng(seed))
    captured, frames = 0, []
    for step in range(round(duration * 1000)):
        t = step * 1e-3
        captured += camera.capture(t, pose)
        frames += [(t, frame) for frame in camera.poll(t)]
    return captured, frames


def test_statistics_are_the_configured_ones():
    captured, frames = record(CameraConfig())
    assert captured == 5000
    poses = np.array([frame.pose for _, frame in frames])
    assert abs(len(frames) / captured - 0.95) < 0.01
    np.testing.assert_allclose(poses[:, :2].mean(axis=0), [0.5, 0.1], atol=2e-4)
    np.testing.assert_allclose(poses[:, :2].std(axis=0), 0.002, rtol=0.05)
    yaw = (poses[:, 2] - 3.1 + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(yaw.std(), np.radians(1.0), rtol=0.05)
    assert abs(yaw.mean()) < 1e-3
    assert np.all(np.abs(poses[:, 2]) <= np.pi)
    np.testing.assert_allclose(np.sqrt(np.diag(frames[0][1].covariance)), [0.002, 0.002, np.radians(1.0)])


def test_results_come_late_in_order_and_once():
    _, frames = record(CameraConfig(dropout=0.0, latency=0.04), duration=2.0)
    times, stamps = np.array([t for t, _ in frames]), np.array([frame.stamp for _, frame in frames])
    np.testing.assert_allclose(times - stamps, 0.04, atol=1e-9)
    np.testing.assert_allclose(stamps, np.arange(len(stamps)) / 50.0, atol=1e-9)


def test_a_rate_that_does_not_divide_the_step_does_not_drift():
    captured, _ = record(CameraConfig(rate=30.0), duration=10.0)
    assert captured == 300


def test_a_late_caller_gets_one_picture_not_a_burst():
    camera = Camera(CameraConfig(dropout=0.0, latency=0.0), np.random.default_rng(0))
    assert camera.capture(0.0, (0, 0, 0))
    assert camera.capture(1.005, (0, 0, 0))
    assert not camera.capture(1.01, (0, 0, 0))
    assert camera.capture(1.02, (0, 0, 0))


def test_no_noise_and_all_lost():
    _, frames = record(CameraConfig(position_std=0.0, yaw_std=0.0, dropout=0.0), duration=1.0)
    np.testing.assert_allclose(frames[3][1].pose, [0.5, 0.1, 3.1])
    assert np.all(np.linalg.eigvalsh(frames[3][1].covariance) > 0.0)
    assert record(CameraConfig(dropout=1.0), duration=1.0)[1] == []


def test_same_seed_same_frames():
    first, second = record(CameraConfig(), duration=1.0)[1], record(CameraConfig(), duration=1.0)[1]
    assert [frame.pose.tolist() for _, frame in first] == [frame.pose.tolist() for _, frame in second]


def test_misuse_is_named():
    with pytest.raises(ConfigurationError, match="dropout"):
        CameraConfig(dropout=1.5)
    with pytest.raises(InvalidInputError, match="x, y, yaw"):
        Camera(CameraConfig(), np.random.default_rng(0)).capture(0.0, (1.0, 2.0))
