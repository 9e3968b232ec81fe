"""Gaussian factors on single key points: where the robot should be in contact (6.4.2)."""

import numpy as np
from numpy.typing import ArrayLike

from vpsto_ros.exceptions import InvalidInputError

Factor = tuple[np.ndarray, np.ndarray]
"""Precision (D, D) and information vector (precision times mean) (D,) of a Gaussian factor."""


def contact_factor(
    n_points: int, dof: int, point_index: int, mean: np.ndarray, covariance: np.ndarray
) -> Factor:
    """A Gaussian on one key point as a factor over all of them.

    In eq. (6.39) this is written with a covariance that says nothing about the other points, which has no
    inverse. The precision form exists: it is zero outside the block of the point, and multiplying densities
    adds precisions and information vectors.

    Args:
        n_points: number of key points P.
        dof: degrees of freedom n of a point.
        point_index: which point, in -P..P-1.
        mean: where it should be, shape (n,).
        covariance: how exactly, shape (n, n), symmetric positive definite.

    Returns:
        Precision (D, D) and information vector (precision times mean) (D,) with D = P n, for
        :meth:`vpsto_ros.priors.gaussian.GaussianPrior.times`.

    Raises:
        InvalidInputError: index out of range, wrong shape, not finite or not positive definite.
    """
    target = np.asarray(mean, dtype=float)
    if target.shape != (dof,) or np.shape(covariance) != (dof, dof):
        raise InvalidInputError(
            f"expected mean ({dof},) and covariance ({dof}, {dof}), got {target.shape}, "
            f"{np.shape(covariance)}"
        )
    block = _precision(covariance, dof)
    if not np.isfinite(target).all():
        raise InvalidInputError("the mean of a contact must be finite")
    return _embedded(n_points, dof, point_index, block, block @ target)


def joint_contact_factor(
    n_points: int,
    point_index: int,
    joints: np.ndarray,
    jacobian: np.ndarray,
    mean: np.ndarray,
    reached: np.ndarray,
    covariance: np.ndarray,
) -> Factor:
    """The same for a Gaussian over end-effector coordinates x when the key points are joint positions q.

    Eq. (6.42) linearises the forward kinematics at q_c, which inverse kinematics found for the mean: x = x_c
    + J (q - q_c). The precision on q is then J^T Sigma^-1 J, eq. (6.43), singular where the arm has more
    joints than x has coordinates: the smoothness prior, which it is multiplied with, decides about those.

    Args:
        n_points: number of key points P.
        point_index: which point, in -P..P-1.
        joints: q_c, shape (n,) [rad].
        jacobian: J at q_c, shape (m, n).
        mean: mean of x, shape (m,).
        reached: x_c, the coordinates at q_c, shape (m,); the mean itself where inverse kinematics are exact.
        covariance: of x, shape (m, m).

    Raises:
        InvalidInputError: as :func:`contact_factor`.
    """
    joints, jacobian = np.asarray(joints, dtype=float), np.asarray(jacobian, dtype=float)
    target, reached = np.asarray(mean, dtype=float), np.asarray(reached, dtype=float)
    size = target.size
    if jacobian.shape != (size, joints.size) or not target.shape == reached.shape == (size,):
        raise InvalidInputError(
            f"expected a Jacobian ({size}, {joints.size}) and coordinates ({size},), got {jacobian.shape}, "
            f"{target.shape} and {reached.shape}"
        )
    if not all(np.isfinite(array).all() for array in (joints, jacobian, target, reached)):
        raise InvalidInputError("joints, Jacobian and coordinates of a contact must be finite")
    precision = _precision(covariance, size)
    block = jacobian.T @ precision @ jacobian
    information = block @ joints + jacobian.T @ precision @ (target - reached)
    return _embedded(n_points, joints.size, point_index, block, information)


def contact_distribution(
    contact: ArrayLike, jacobian: ArrayLike, object_covariance: ArrayLike, contact_covariance: ArrayLike
) -> tuple[np.ndarray, np.ndarray]:
    """Where to touch an object whose place is uncertain, eq. (6.38), from the conditional (6.37).

    Args:
        contact: f_c(mu_o), the best configuration for the mean of the object, shape (m,).
        jacobian: A, derivative of f_c by the object's coordinates, shape (m, o).
        object_covariance: shape (o, o).
        contact_covariance: Sigma^{r|o}, how exactly to touch a known object, shape (m, m).

    Returns:
        mean (m,) and covariance Sigma^{r|o} + A Sigma^o A^T (m, m).

    Raises:
        InvalidInputError: the shapes do not fit.
    """
    mean, a = np.asarray(contact, dtype=float), np.asarray(jacobian, dtype=float)
    given, spread = np.asarray(contact_covariance, dtype=float), np.asarray(object_covariance, dtype=float)
    shapes = (a.shape, given.shape, spread.shape)
    if mean.ndim != 1 or a.ndim != 2 or shapes != (
        (mean.size, a.shape[1]), (mean.size, mean.size), (a.shape[1], a.shape[1]),
    ):  # fmt: skip
        raise InvalidInputError(
            f"expected a contact (m,), a Jacobian (m, o) and covariances (o, o) and (m, m), got "
            f"{mean.shape}, {a.shape}, {spread.shape} and {given.shape}"
        )
    return mean, given + a @ spread @ a.T


def _precision(covariance: np.ndarray, size: int) -> np.ndarray:
    spread = np.asarray(covariance, dtype=float)
    if spread.shape != (size, size):
        raise InvalidInputError(f"expected a covariance ({size}, {size}), got {spread.shape}")
    if not np.isfinite(spread).all() or np.abs(spread - spread.T).max() > 1e-6 * np.abs(spread).max():
        raise InvalidInputError("the covariance of a contact must be finite and symmetric")
    try:
        np.linalg.cholesky(spread)
    except np.linalg.LinAlgError as error:
        raise InvalidInputError("the covariance of a contact must be positive definite") from error
    inverse = np.linalg.inv(spread)
    return 0.5 * (inverse + inverse.T)


def _embedded(
    n_points: int, dof: int, point_index: int, block: np.ndarray, information: np.ndarray
) -> Factor:
    """A factor on one point, zero for all others: eq. (6.39) in precision form."""
    if not -n_points <= point_index < n_points:
        raise InvalidInputError(f"point_index = {point_index} is out of range for {n_points} points")
    begin = (point_index % n_points) * dof
    precision, vector = np.zeros((n_points * dof, n_points * dof)), np.zeros(n_points * dof)
    precision[begin : begin + dof, begin : begin + dof] = block
    vector[begin : begin + dof] = information
    return precision, vector
