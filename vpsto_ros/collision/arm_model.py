"""The arm as capsules, read from its MJCF: the geoms whose name ends in ``_envelope``.

They are the only source of numbers; Pinocchio reads them. Which capsules are checked against each other
follows three rules:

1. not those of one body, nor of two bodies that the MJCF excludes from contact (neighbours in the chain and
   their neighbours, whose joints keep them apart);
2. not those that touch in every one of 20 000 random postures within the joint limits (they always do);
3. not those that stay at least 6 cm apart in all of these postures: a centimetre more than the largest
   margin, because there are closer postures than those drawn.
"""

import dataclasses
import functools
import pathlib
import xml.etree.ElementTree

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.collision.arm_distance_kernels import self_distance_range
from vpsto_ros.collision.arm_kernels import ArmArrays
from vpsto_ros.collision.shapes import Capsule, Sphere
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.robot.kinematics import FLANGE_OFFSET, MODEL_PATH, TOOL_LENGTH, dh_table, fr3_pusher

SUFFIX = "_envelope"
NEVER = 0.06  # rule 3 [m]
MARGIN_LIMIT = 0.05  # margins are smaller [m]
_POSTURES = 20_000
_LAST_LINK = 7


@dataclasses.dataclass(frozen=True, eq=False)
class ArmModel:
    """An arm of capsules.

    Attributes:
        names: of the capsules, sorted by link, such as "fr3_link5_wrist" or "tool_rod".
        lower: least joint positions, shape (7,) [rad].
        upper: greatest joint positions, shape (7,) [rad].
        arrays: what the kernels read.
    """

    names: tuple[str, ...]
    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    arrays: ArmArrays

    def with_attached(self, shapes: "tuple[Capsule | Sphere, ...]") -> "ArmModel":
        """The arm with shapes fixed to its tool, in axes of the last link with the origin at the tool's tip.

        They are checked against obstacles and against all links but the last two, by the same rules.

        Raises:
            InvalidInputError: a shape is neither a capsule nor a sphere, or its name is taken.
        """
        if not shapes:
            return self
        tip = np.array([0.0, 0.0, FLANGE_OFFSET + TOOL_LENGTH])
        rows, radii = [], []
        for shape in shapes:
            if not isinstance(shape, Capsule | Sphere):
                raise InvalidInputError(f"only capsules and spheres can be attached, got {shape!r}")
            a, b = (shape.a, shape.b) if isinstance(shape, Capsule) else (shape.centre, shape.centre)
            rows.append(np.concatenate([a + tip, b - a]))
            radii.append(shape.radius)
        names = self.names + tuple(shape.name for shape in shapes)
        if len(set(names)) < len(names):
            raise InvalidInputError(f"two parts of the arm have the same name: {', '.join(names)}")
        old = self.arrays
        link = np.concatenate([old.link, np.full(len(rows), _LAST_LINK)])
        new = [
            (k, len(old.link) + i)
            for i in range(len(rows))
            for k in np.flatnonzero(old.link < _LAST_LINK - 1)
        ]
        local, radius = np.vstack([old.local, rows]), np.concatenate([old.radius, radii])
        candidates = np.array(new, dtype=np.int64).reshape(-1, 2)
        fresh = _arrays(old.dh, local, radius, link, candidates, self.lower, self.upper)
        arrays = fresh._replace(pairs=np.ascontiguousarray(np.vstack([old.pairs, fresh.pairs])))
        return ArmModel(names, self.lower, self.upper, arrays)


@functools.lru_cache(maxsize=1)
def fr3_capsules() -> ArmModel:
    """The FR3 with the pushing rod."""
    return read_capsules(MODEL_PATH)


def read_capsules(path: str | pathlib.Path) -> ArmModel:
    """The capsules of an FR3 whose links may have been changed in the MJCF.

    Raises:
        ConfigurationError: a geom of the envelope is no capsule, or there is none.
    """
    import pinocchio

    model = pinocchio.buildModelFromMJCF(str(path))
    geometry = pinocchio.buildGeomFromMJCF(model, str(path), pinocchio.GeometryType.VISUAL)
    parts = [part for part in geometry.geometryObjects if part.name.endswith(SUFFIX)]
    if not parts:
        raise ConfigurationError(f"'{path}' has no geom whose name ends in {SUFFIX}")
    parts.sort(key=lambda part: part.parentJoint)
    local, radius = np.empty((len(parts), 6)), np.empty(len(parts))
    for k, part in enumerate(parts):
        if not hasattr(part.geometry, "halfLength") or "Capsule" not in type(part.geometry).__name__:
            raise ConfigurationError(f"geom '{part.name}' must be a capsule")
        half = part.placement.rotation[:, 2] * part.geometry.halfLength
        local[k, :3], local[k, 3:] = part.placement.translation - half, 2.0 * half
        radius[k] = part.geometry.radius
    bodies = [model.frames[part.parentFrame].name for part in parts]
    link = np.array([part.parentJoint for part in parts], dtype=np.int64)
    limits = fr3_pusher().limits
    assert limits.lower is not None and limits.upper is not None
    candidates = _candidate_pairs(bodies, _excluded(path))
    arrays = _arrays(dh_table(), local, radius, link, candidates, limits.lower, limits.upper)
    names = tuple(part.name.removesuffix(SUFFIX) for part in parts)
    return ArmModel(names, limits.lower, limits.upper, arrays)


def _excluded(path: str | pathlib.Path) -> set[frozenset[str]]:
    root = xml.etree.ElementTree.parse(path).getroot()
    return {frozenset((pair.get("body1", ""), pair.get("body2", ""))) for pair in root.iter("exclude")}


def _candidate_pairs(bodies: list[str], excluded: set[frozenset[str]]) -> NDArray[np.int64]:
    """Rule 1."""
    pairs = [
        (i, j)
        for i in range(len(bodies))
        for j in range(i + 1, len(bodies))
        if bodies[i] != bodies[j] and frozenset((bodies[i], bodies[j])) not in excluded
    ]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _arrays(dh, local, radius, link, candidates, lower, upper) -> ArmArrays:
    first = np.searchsorted(link, np.arange(9)).astype(np.int64)
    half_length = 0.5 * np.linalg.norm(local[:, 3:], axis=1)
    arm = ArmArrays(dh, first, local, radius, half_length, _swing(dh, local, link), link, candidates)
    return arm._replace(pairs=_touching_sometimes(arm, lower, upper))


def _touching_sometimes(arm: ArmArrays, lower: NDArray, upper: NDArray) -> NDArray[np.int64]:
    """Rules 2 and 3."""
    if not len(arm.pairs):
        return arm.pairs
    postures = np.random.default_rng(0).uniform(lower, upper, (_POSTURES, len(lower)))
    nearest, farthest = self_distance_range(arm, postures)
    return np.ascontiguousarray(arm.pairs[(nearest < NEVER) & (farthest > 0.0)])


def _swing(dh: NDArray, local: NDArray, link: NDArray) -> NDArray[np.float64]:
    """Largest distance (C, 7) of each segment's points from each joint's axis, in any posture.

    In the frame of a capsule's own joint that is exact, and so is the first step down the chain, which only
    shifts the point along the axis it turns about. From there on the distance from a frame's origin, and with
    it the one from the axis, grows by at most the offset to the frame before.
    """
    swing = np.zeros((len(local), 7))
    for k, row in enumerate(local):
        ends = np.array([row[:3], row[:3] + row[3:]])
        joint = int(link[k]) - 1
        if joint < 0:
            continue
        across = np.hypot(ends[:, 0], ends[:, 1])
        swing[k, joint] = across.max()
        reach = np.hypot(across, ends[:, 2] + dh[joint, 1]).max() + abs(dh[joint, 0])
        for before in range(joint - 1, -1, -1):
            swing[k, before] = reach
            reach += np.hypot(dh[before, 0], dh[before, 1])
    return swing
