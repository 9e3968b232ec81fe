"""The planar filter over a hundred thousand poses, which at 50 Hz is half an hour."""

import math

import numpy as np

from vpsto_ros.estimation.planar_kalman import PlanarKalman

STD = np.array([0.002, 0.002, math.radians(1.0)])
NOISE = np.diag(STD**2)


def test_the_covariance_stays_positive_definite_over_a_hundred_thousand_steps():
    kalman, rng = PlanarKalman(), np.random.default_rng(0)
    noise = rng.standard_normal((100_000, 3)) * STD
    gaps = rng.choice([1e-4, 0.02, 0.05, 0.39], 100_000, p=[0.05, 0.85, 0.07, 0.03])
    stamp = 0.0
    for k in range(100_000):
        stamp += gaps[k]
        moving = 0.1 * math.sin(0.5 * stamp)
        kalman.update(stamp, noise[k] + [moving, 0.0, 2.0 * stamp], NOISE)
        if k % 500 == 0:
            covariance = kalman.state.covariance
            assert np.linalg.eigvalsh(covariance).min() > 0
            np.testing.assert_array_equal(covariance, covariance.T)
    assert abs(kalman.state.pose[0] - moving) < 0.02
