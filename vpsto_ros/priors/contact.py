"""Gaussian factors on single key points: where the robot should be in contact (6.4.2)."""

import numpy as np

from vpsto_ros.exceptions import InvalidInputError


def contact_factor(
    n_points: int, dof: int, point_index: int, mean: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
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
    if not -n_points <= point_index < n_points:
        raise InvalidInputError(f"point_index = {point_index} is out of range for {n_points} points")
    target, spread = np.asarray(mean, dtype=float), np.asarray(covariance, dtype=float)
    if target.shape != (dof,) or spread.shape != (dof, dof):
        raise InvalidInputError(
            f"expected mean ({dof},) and covariance ({dof}, {dof}), got {target.shape}, {spread.shape}"
        )
    if not (np.isfinite(target).all() and np.isfinite(spread).all() and np.allclose(spread, spread.T)):
        raise InvalidInputError("mean and covariance must be finite and the covariance symmetric")
    try:
        np.linalg.cholesky(spread)
    except np.linalg.LinAlgError as error:
        raise InvalidInputError("the covariance of a contact must be positive definite") from error
    block = np.linalg.inv(spread)
    begin = (point_index % n_points) * dof
    precision = np.zeros((n_points * dof, n_points * dof))
    information = np.zeros(n_points * dof)
    precision[begin : begin + dof, begin : begin + dof] = 0.5 * (block + block.T)
    information[begin : begin + dof] = block @ target
    return precision, information
