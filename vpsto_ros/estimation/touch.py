"""What touch tells about an object: contact, or none, and the direction of the force (outlook 7.2.3).

A force that is felt on an end effector says that the object is on the contact manifold of that one: where
the gap is zero, a set without measure that particles hit only by being pushed. So before weighing, a share of
them is moved onto it along the normals, with importance weights that make up for it. No force says that
nothing is being pushed; an object may well be touched at rest without any.

To know the force on each of several end effectors takes a sensor in each. The sum of the forces says less:
that one of them is in contact, but not which (particles are moved to the one that is most likely near), and a
direction within the hull of all cones that may share in it; forces that cancel are not felt at all.
"""

import dataclasses
import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from vpsto_ros.belief.dynamics import BeliefDynamics
from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.contact.narrow_phase import COMPILED
from vpsto_ros.estimation.contact_queries import ParticleContacts, particle_contacts
from vpsto_ros.estimation.particle_cloud import ParticleCloud, Snapshot, pose_moments

_ANY_FRICTION = 0.5
_ROUNDS = 6  # alternating projections onto the manifolds of two end effectors; each halves the distance


@documented
@dataclasses.dataclass(frozen=True)
class TouchConfig:
    """How forces are read."""

    threshold: float = option(0.3, "least force that is felt", unit="N", minimum=0.0, maximum=100.0)
    threshold_sigmas: float = option(
        3.0, "and how many standard deviations of its noise", minimum=0.0, maximum=20.0
    )
    gap_scale: float = option(
        0.001, "standard deviation of the gap at which there is contact", unit="m", minimum=1e-5, maximum=0.05
    )
    pushing_speed: float = option(
        0.01, "speed towards the object above which contact means force", unit="m/s", minimum=1e-4,
        maximum=1.0,
    )  # fmt: skip
    resting: float = option(
        0.5, "probability that contact is felt when nothing is pushed", minimum=1e-3, maximum=0.999
    )
    missed: float = option(0.3, "probability that a push is not felt", minimum=1e-3, maximum=0.999)
    false_alarm: float = option(
        0.005, "probability that a force is felt without contact", minimum=1e-6, maximum=0.5
    )
    direction_std: float = option(
        0.1, "error of the force's direction beside its noise", unit="rad", minimum=0.01, maximum=3.0
    )
    share: float = option(
        0.5, "share of the particles moved onto the contact manifold", minimum=0.0, maximum=0.95
    )
    enough: float = option(0.5, "probability of contact above which none is moved", minimum=0.0, maximum=1.0)
    interval: float = option(
        0.1, "forces that tell the same are used at most so often: their errors repeat", unit="s",
        minimum=0.0, maximum=10.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        validate(self)


@dataclasses.dataclass(frozen=True)
class Touch:
    """Forces on the object, read.

    Attributes:
        forces: of each end effector on the object, shape (E, 2), or their sum, shape (1, 2) [N].
        noise: standard deviation of a component [N].
        felt: which of them are felt, shape (E,) or (1,).
    """

    forces: NDArray[np.float64]
    noise: float
    felt: NDArray[np.bool_]


def read(config: TouchConfig, forces: NDArray, noise: float) -> Touch:
    """Decide which forces are felt."""
    least = max(config.threshold, config.threshold_sigmas * noise)
    return Touch(forces, noise, np.hypot(forces[:, 0], forces[:, 1]) > least)


def weigh(
    cloud: ParticleCloud,
    touch: Touch,
    stamp: float,
    config: TouchConfig,
    dynamics: BeliefDynamics,
    rng: np.random.Generator,
) -> bool:
    """Weigh the particles by a touch, after a share of them was moved to where it can have happened.

    Args:
        cloud: the particles; where they were at the stamp counts.
        touch: what was measured.
        stamp: when [s].
        config: how forces are read.
        dynamics: shape of the object and end effectors; where that has no friction, cones are
            nevertheless as wide as for a coefficient of 0.5.
        rng: source of randomness.

    Returns:
        False if a force is felt where no particle can be; the cloud is then as it was.
    """
    then, velocity = cloud.at(stamp), cloud.velocity(stamp)
    contacts = particle_contacts(dynamics, then.poses, then.point, velocity)
    if touch.felt.any():
        moves, factors = onto_manifold(config, touch, dynamics, then, cloud.weights, contacts, rng)
        weights = cloud.weights * factors
        contacts = particle_contacts(dynamics, then.poses + moves, then.point, velocity)
        near = weights @ (contacts.gaps.min(axis=1) < 2.0 * config.gap_scale)
        if near < 1e-3 * config.false_alarm * weights.sum():
            return False
        cloud.shift(moves)
        cloud.reweigh(factors)
    friction = cloud.friction if dynamics.friction else np.full(len(cloud.friction), _ANY_FRICTION)
    cloud.reweigh(likelihoods(config, touch, contacts, friction))
    return True


def likelihoods(
    config: TouchConfig, touch: Touch, contacts: ParticleContacts, friction: NDArray
) -> NDArray[np.float64]:
    """Likelihood of a touch for each particle, shape (P,), up to a common factor.

    Args:
        config: how forces are read.
        touch: what was measured.
        contacts: of the particles.
        friction: coefficient of friction of each, shape (P,).
    """
    near = np.exp(-0.5 * (np.maximum(contacts.gaps, 0.0) / config.gap_scale) ** 2)
    pushed = np.clip(contacts.approach / config.pushing_speed, 0.0, 1.0)
    felt_in_contact = config.resting + (1.0 - config.missed - config.resting) * pushed
    angles = np.arctan2(contacts.normals[..., 1], contacts.normals[..., 0])
    forces = np.arctan2(touch.forces[:, 1], touch.forces[:, 0])
    errors = np.hypot(config.direction_std, touch.noise / np.hypot(*np.maximum(np.abs(touch.forces.T), 1e-9)))
    out = np.ones(len(friction))
    summed = len(touch.forces) < contacts.gaps.shape[1]
    _weigh(summed, near, felt_in_contact, config.false_alarm, angles, touch.felt, forces, errors,
           np.arctan(friction), out)  # fmt: skip
    return out


@njit(**COMPILED)
def _weigh(summed, near, feels, false_alarm, angles, felt, forces, errors, cones, out):
    count, effectors = near.shape
    for i in range(count):
        cone = cones[i] + 0.02  # even a frictionless surface is not perfectly smooth
        if not summed:
            for e in range(effectors):
                p, q = near[i, e], (1.0 - near[i, e]) * false_alarm
                if felt[e]:
                    offset = forces[e] - angles[i, e]
                    out[i] *= p * feels[i, e] * _spread_cone(offset, cone, cone, errors[e]) + q / math.tau
                else:
                    out[i] *= 1.0 - p * feels[i, e] - q
            continue
        none, low, high, first = 1.0, 0.0, 0.0, -1
        for e in range(effectors):
            none *= 1.0 - near[i, e] * feels[i, e]
            if near[i, e] > 0.5 or (first < 0 and e == effectors - 1):
                if first < 0:
                    first = e
                turn = _wrapped(angles[i, e] - angles[i, first])
                low, high = min(low, turn), max(high, turn)
        if felt[0]:
            # The sum of forces in several cones is in the hull of these cones.
            offset = forces[0] - angles[i, first]
            density = _spread_cone(offset, cone - low, cone + high, errors[0])
            out[i] = (1.0 - none) * density + none * false_alarm / math.tau
        else:
            out[i] = none * (1.0 - false_alarm)


@njit(**COMPILED)
def _wrapped(angle):
    return angle - math.tau * math.floor((angle + math.pi) / math.tau)


@njit(**COMPILED)
def _spread_cone(offset, below, above, error):
    """Density of a direction that is uniform from -below to above, with a Gaussian error."""
    offset = _wrapped(offset)
    scale = 1.0 / (math.sqrt(2.0) * error)
    return 0.5 * (math.erf((offset + below) * scale) - math.erf((offset - above) * scale)) / (below + above)


def onto_manifold(
    config: TouchConfig,
    touch: Touch,
    dynamics: BeliefDynamics,
    then: Snapshot,
    weights: NDArray,
    contacts: ParticleContacts,
    rng: np.random.Generator,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Moves (P, 3) of a share of the particles to where the end effectors that feel something touch them.

    A moved particle stands for the density of the belief on the manifold, taken from its Gaussian
    approximation: how dense it is there along the normal, times the width over which a contact is felt.
    Returned with the moves are these factors of the weights (P,).
    """
    poses, point = then.poses, then.point
    moves, factors = np.zeros_like(poses), np.ones(len(poses))
    felt = _felt_by(touch, contacts)
    near = contacts.gaps[:, felt] < 2.0 * config.gap_scale
    if not felt.any() or weights @ near.all(axis=1) > config.enough:
        return moves, factors
    chosen = np.flatnonzero(~near.all(axis=1) & (rng.random(len(poses)) < config.share))
    if not len(chosen):
        return moves, factors
    moved = poses[chosen]
    rounds = 1 if felt.sum() == 1 else _ROUNDS
    still = np.zeros_like(point)
    for _ in range(rounds):
        for e in np.flatnonzero(felt):
            here = particle_contacts(dynamics, moved, point, still)
            moved[:, :2] -= here.gaps[:, e, None] * here.normals[:, e]
    moves[chosen] = moved - poses[chosen]
    normals = particle_contacts(dynamics, moved, point, still).normals[:, felt]
    factors[chosen] = _density(poses, weights, moved, normals, config.gap_scale)
    return moves, factors


def _felt_by(touch: Touch, contacts: ParticleContacts) -> NDArray[np.bool_]:
    """Which end effectors feel something; of a sum of forces, the one most likely to be near is taken."""
    effectors = contacts.gaps.shape[1]
    if len(touch.felt) == effectors:
        return touch.felt
    nearest = np.argmin(np.median(contacts.gaps, axis=0))
    return (np.arange(effectors) == nearest) & touch.felt[0]


def _density(
    poses: NDArray, weights: NDArray, moved: NDArray, normals: NDArray, scale: float
) -> NDArray[np.float64]:
    mean, covariance = pose_moments(poses, weights)
    precision = np.linalg.inv(covariance[:2, :2] + 1e-8 * np.eye(2))
    offset, width = moved[:, :2] - mean[:2], 0.5 * scale
    if normals.shape[1] > 1:  # two contacts fix the position
        exponent = np.einsum("pi,ij,pj->p", offset, precision, offset)
        return width**2 * math.sqrt(np.linalg.det(precision)) * np.exp(-0.5 * exponent)
    normal = normals[:, 0]
    stiffness = np.einsum("pi,ij,pj->p", normal, precision, normal)
    force = np.einsum("pi,ij,pj->p", normal, precision, offset)
    return width * np.sqrt(stiffness) * np.exp(-0.5 * force**2 / stiffness)
