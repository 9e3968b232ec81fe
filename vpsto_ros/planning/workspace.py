"""Where on the table the tool and the object may be."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import ConfigurationError


@documented
@dataclasses.dataclass(frozen=True)
class Workspace:
    """Where the tool and the object may be, base frame [m]."""

    radius_min: float = option(
        0.305, "smallest distance of the tool from the robot's axis", unit="m", minimum=0.0, maximum=2.0
    )
    radius_max: float = option(
        0.76, "largest distance of the tool from the robot's axis", unit="m", minimum=0.0, maximum=2.0
    )
    side: float = option(0.45, "the tool stays within +- side in y", unit="m", minimum=0.0, maximum=2.0)
    object_x: tuple[float, float] = option(
        (0.40, 0.64), "range of the object's origin in x", unit="m", minimum=-2.0, maximum=2.0
    )
    margin: float = option(
        0.035,
        "distance from the border that plans keep for objects that need not come nearer",
        unit="m",
        minimum=0.0,
        maximum=0.2,
    )
    object_y: tuple[float, float] = option(
        (-0.32, 0.32), "range of the object's origin in y", unit="m", minimum=-2.0, maximum=2.0
    )

    def __post_init__(self) -> None:
        validate(self)
        room = 2.0 * self.margin
        for name, (low, high) in {
            "radius_min, radius_max": (self.radius_min, self.radius_max),
            "object_x": self.object_x, "object_y": self.object_y,
        }.items():  # fmt: skip
            if high - low <= room:
                raise ConfigurationError(
                    f"Workspace.{name} = {low}, {high} leaves no room; "
                    f"the second must exceed the first by more than 2 margin = {room}"
                )

    def tool_excess(self, path: NDArray) -> NDArray:
        """How far tool paths (B, K, 2) leave their region, shape (B,) [m]; 0 inside."""
        radius = np.sqrt(np.einsum("bki,bki->bk", path, path))
        beyond = np.maximum(
            np.maximum(self.radius_min - radius, radius - self.radius_max), np.abs(path[..., 1]) - self.side
        )
        behind = 0.1 - path[..., 0]
        return np.maximum(np.maximum(beyond, behind).max(axis=1), 0.0)

    def object_excess(self, poses: NDArray, margin: float = 0.0) -> NDArray:
        """How far object paths (..., K, 3) leave their region less a margin, shape (...) [m]; 0 inside."""
        low = np.array([self.object_x[0], self.object_y[0]]) + margin
        high = np.array([self.object_x[1], self.object_y[1]]) - margin
        beyond = np.maximum(low - poses[..., :2], poses[..., :2] - high)
        return np.maximum(beyond.max(axis=(-2, -1)), 0.0)

    def contains_object(self, pose: NDArray) -> bool:
        """Whether an object pose (x, y, ...) is inside the region of objects."""
        return bool(self.object_excess(np.append(np.asarray(pose, dtype=float)[:2], 0.0)[None]) == 0.0)
