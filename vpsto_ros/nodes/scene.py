"""What the nodes are told about the scene: the outline of the object, the tool, the table."""

import dataclasses
import math

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.contact.pushing import PushingModel
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError
from vpsto_ros.nodes.conversions import PoseReading


@documented
@dataclasses.dataclass(frozen=True)
class ShapeConfig:
    """The outline of the object seen from above; its frame is at the centre of its area."""

    kind: str = option("box", "outline of the object", choices=("box", "tee", "ell", "disc"))
    size: tuple[float, float] = option(
        (0.12, 0.12),
        "box: sides along x and y; tee, ell: length and width of the bars; disc: diameter, twice",
        unit="m",
        minimum=0.01,
        maximum=1.0,
    )

    def __post_init__(self) -> None:
        validate(self)
        if self.kind in ("tee", "ell") and self.size[1] >= self.size[0]:
            raise ConfigurationError(
                f"size = {self.size}: the bars of a {self.kind} must be longer than wide"
            )

    def shape(self) -> PlanarShape:
        """The outline."""
        if self.kind == "disc":
            return PlanarShape.disc(0.5 * self.size[0])
        return getattr(PlanarShape, self.kind)(*self.size)


@documented
@dataclasses.dataclass(frozen=True)
class ModelConfig:
    """What the planners believe about object and tool."""

    object: ShapeConfig = dataclasses.field(default_factory=ShapeConfig)
    tool_radius: float = option(0.015, "radius of the pushing rod", unit="m", minimum=0.001, maximum=0.2)
    friction: float = option(
        0.3,
        "friction coefficient between tool and object, for kind = pushing and kalman; beliefs have ranges",
        minimum=0.0,
        maximum=2.0,
    )
    pressure_radius: float = option(
        0.0, "radius of the pressure distribution; 0 takes an even one", unit="m", minimum=0.0, maximum=1.0
    )

    def __post_init__(self) -> None:
        validate(self)

    def model(self) -> PushingModel:
        """The contact model."""
        radius = self.pressure_radius or None
        tool = PlanarShape.disc(self.tool_radius)
        return PushingModel(self.object.shape(), tool, pressure_radius=radius, friction=self.friction)


@documented
@dataclasses.dataclass(frozen=True)
class TableConfig:
    """Where a seen object can be; a pose outside is a wrong detection."""

    x: tuple[float, float] = option((0.1, 1.0), "range of poses in x", unit="m", minimum=-3.0, maximum=3.0)
    y: tuple[float, float] = option((-0.7, 0.7), "range of poses in y", unit="m", minimum=-3.0, maximum=3.0)
    height: float = option(0.1, "largest |z| of a pose", unit="m", minimum=0.0, maximum=1.0)
    tilt: float = option(
        0.3, "largest angle between the object's z axis and the vertical", unit="rad", maximum=math.pi
    )

    def __post_init__(self) -> None:
        validate(self)
        for name in ("x", "y"):
            low, high = getattr(self, name)
            if low >= high:
                raise ConfigurationError(f"{name} = [{low}, {high}]: the first must be below the second")

    def check(self, reading: PoseReading) -> None:
        """Raise InvalidInputError for a pose that is not on the table, saying why."""
        x, y, _ = reading.pose
        if not (self.x[0] <= x <= self.x[1] and self.y[0] <= y <= self.y[1]):
            raise InvalidInputError(
                f"the pose ({x:.3f}, {y:.3f}) m is off the table: x from {self.x[0]} to {self.x[1]}, "
                f"y from {self.y[0]} to {self.y[1]} m"
            )
        if abs(reading.height) > self.height:
            raise InvalidInputError(
                f"the pose is {reading.height:.3f} m above the table (allowed {self.height})"
            )
        if reading.tilt > self.tilt:
            raise InvalidInputError(f"the object is tilted by {reading.tilt:.2f} rad (allowed {self.tilt})")
