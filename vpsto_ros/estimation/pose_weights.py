"""How a measured pose weighs the particles: a Gaussian among outliers."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.estimation.measurement import PoseMeasurement
from vpsto_ros.estimation.object_state import wrap_angle
from vpsto_ros.estimation.particle_cloud import ParticleCloud, pose_moments
from vpsto_ros.estimation.particle_filter_config import ParticleFilterConfig


def weigh(
    cloud: ParticleCloud,
    measurement: PoseMeasurement,
    config: ParticleFilterConfig,
    *,
    with_yaw: bool,
    rng: np.random.Generator,
) -> float:
    """Weigh the particles by a measured pose; returns the probability that it is an outlier.

    Where the particles are too sparse for a sharp measurement, new ones are drawn between them; these may
    stick in an end effector until they are moved out.

    Args:
        cloud: the particles; their poses at the measurement's stamp count.
        measurement: with all noise in its covariance.
        config: outliers, and what is sparse.
        with_yaw: whether the object has an orientation.
        rng: source of randomness.
    """
    stray = config.outlier_share * config.outlier_density / (2.0 * math.pi if with_yaw else 1.0)
    then = cloud.at(measurement.stamp).poses
    fits = (1.0 - config.outlier_share) * likelihoods(measurement, then, with_yaw=with_yaw)
    weights = cloud.weights * (fits + stray)
    if weights.sum() ** 2 < config.sparse * len(weights) * (weights @ weights):
        wide, moves = _between(cloud, measurement, then, with_yaw=with_yaw, rng=rng)
        fits = (1.0 - config.outlier_share) * likelihoods(wide, then, with_yaw=with_yaw)
        explained = rng.random(len(weights)) * (fits + stray) < fits
        cloud.shift(moves * explained[:, None])
    doubt = stray / (stray + float(cloud.weights @ fits))
    cloud.reweigh(fits + stray)
    return doubt


def likelihoods(measurement: PoseMeasurement, poses: NDArray, *, with_yaw: bool) -> NDArray[np.float64]:
    """Gaussian density of a measurement for objects at these poses (P, 3), shape (P,)."""
    n = 3 if with_yaw else 2
    off = measurement.pose[:n] - poses[:, :n]
    if with_yaw:
        off[:, 2] = wrap_angle(off[:, 2])
    noise = measurement.covariance[:n, :n]
    distance = np.einsum("pi,ij,pj->p", off, np.linalg.inv(noise), off)
    return np.exp(-0.5 * distance) / math.sqrt((2.0 * math.pi) ** n * float(np.linalg.det(noise)))


def _between(
    cloud: ParticleCloud,
    measurement: PoseMeasurement,
    then: NDArray,
    *,
    with_yaw: bool,
    rng: np.random.Generator,
) -> tuple[PoseMeasurement, NDArray[np.float64]]:
    """The measurement as particles with a width see it, and moves (P, 3) to draws from within these widths.

    Each particle stands for a Gaussian around it, of the width that suits their number (Silverman), which is
    multiplied by that of the measurement.
    """
    n, count = (3 if with_yaw else 2), len(then)
    width = (4.0 / (n + 2.0) / count) ** (1.0 / (n + 4.0))
    kernel = width**2 * pose_moments(then, cloud.weights)[1]
    wide = dataclasses.replace(measurement, covariance=measurement.covariance + kernel)
    off = measurement.pose - then
    off[:, 2] = wrap_angle(off[:, 2])
    gain = kernel[:, :n] @ np.linalg.inv(wide.covariance[:n, :n])
    values, vectors = np.linalg.eigh(kernel - gain @ kernel[:n])
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    return wide, off[:, :n] @ gain.T + rng.standard_normal((count, 3)) @ root.T
