"""Options of planning in belief space."""

import dataclasses
from typing import Any

from numpy.typing import NDArray

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.optimization.vpsto import VpstoConfig


@documented
@dataclasses.dataclass(frozen=True)
class RobustContactConfig:
    """Where end effectors touch."""

    contact_angle: float = option(
        0.6,
        "half the angle between two end effectors behind the object, seen from its centre",
        unit="rad",
        minimum=0.0,
        maximum=1.5,
    )
    contact_advance: float = option(
        0.03, "how far the contact prior lies ahead of touching", unit="m", minimum=-0.2, maximum=0.2
    )
    contact_std: float = option(
        0.03, "standard deviation of the contact prior", unit="m", minimum=1e-3, maximum=1.0
    )
    contact_yaw_std: float = option(
        0.3, "the same for the yaw of a rectangular end effector", unit="rad", minimum=1e-3, maximum=10.0
    )
    separation: float = option(
        0.005, "smallest gap between end effectors", unit="m", minimum=0.0, maximum=0.5
    )
    speed: float = option(
        0.12, "largest speed of a tool in x and in y", unit="m/s", minimum=0.005, maximum=2.0
    )

    def __post_init__(self) -> None:
        validate(self)


@documented
@dataclasses.dataclass(frozen=True)
class RobustPushingConfig(RobustContactConfig):
    """Options of BS-VP-STO; the deterministic baseline is ``robust = False``: no variance terms at all."""

    robust: bool = option(True, "whether the variance gain is a cost and a constraint")
    contact_prior: bool = option(True, "whether candidates are drawn around likely contacts (Q_q of 6.39)")
    points: int = option(2, "points per horizon N: via-points and the free end", minimum=1, maximum=10)
    steps: int = option(40, "steps of a horizon K", minimum=2, maximum=1000)
    perturbation: float = option(
        1e-6, "variance of the perturbation in a step V_w", unit="m^2", minimum=1e-12, maximum=1e-2
    )
    largest_gain: float = option(
        1.0,
        "largest variance gain of a valid plan (6.31); particles with friction spread in any push with one "
        "side, which needs more than 1",
        minimum=1.0,
        maximum=10.0,
    )
    progress_weight: float = option(
        30.0, "lambda of the progress cost (6.54)", unit="1/m", minimum=0.1, maximum=1e4
    )
    distance_weight: float = option(
        0.0,
        "cost of a metre that is left at the end: a single horizon needs it, (6.54) being flat there",
        unit="1/m",
        minimum=0.0,
        maximum=1e4,
    )
    variance_weight: float = option(
        4.0,
        "w of the distance sqrt(|mean - goal|^2 + w V) whose decrease is the progress; 0 is the thesis's",
        minimum=0.0,
        maximum=1e3,
    )
    aside_weight: float = option(
        2.0, "how much more a metre beside a path counts than one along it", minimum=1.0, maximum=100.0
    )
    duration_weight: float = option(0.0, "cost of a second of motion", unit="1/s", minimum=0.0, maximum=1e3)
    wedge: float = option(
        -0.5,
        "a plan is invalid when the normals of two contacts have a smaller product: it squeezes the object, "
        "which friction mu holds fast below -(1 - mu^2) / (1 + mu^2), -0.47 for 0.6",
        minimum=-1.0,
        maximum=1.0,
    )
    longest_step: float = option(
        0.02, "a plan is invalid when the object jumps farther in a step", unit="m", minimum=1e-4, maximum=1.0
    )
    smoothness_spread: float = option(
        0.06, "mean standard deviation of the smoothness prior", unit="m", minimum=1e-4, maximum=10.0
    )
    jitter: float = option(
        0.002,
        "standard deviation added to the particles at each horizon: a gathered belief says nothing",
        unit="m",
        minimum=0.0,
        maximum=0.1,
    )
    particles: int = option(20, "particles of a rollout N_p", minimum=2, maximum=10_000)
    acceleration: float = option(
        0.6, "largest acceleration of a tool in x and in y", unit="m/s^2", minimum=0.01, maximum=20.0
    )
    turn_speed: float = option(
        0.8, "largest yaw rate of a rectangular tool", unit="rad/s", minimum=0.01, maximum=10.0
    )
    turn_acceleration: float = option(
        4.0, "largest yaw acceleration of a rectangular tool", unit="rad/s^2", minimum=0.01, maximum=100.0
    )
    search: VpstoConfig = dataclasses.field(
        default_factory=lambda: VpstoConfig(population=30, iterations=10, strategy="cma")
    )


@documented
@dataclasses.dataclass(frozen=True)
class JointSpaceConfig:
    """Options of searching in the joints of the arms instead of the plane of their tools."""

    speed: float = option(0.3, "largest speed of a joint", unit="rad/s", minimum=0.01, maximum=5.0)
    acceleration: float = option(
        1.5, "largest acceleration of a joint", unit="rad/s^2", minimum=0.01, maximum=20.0
    )
    spread: float = option(
        0.1, "mean standard deviation of the smoothness prior", unit="rad", minimum=1e-4, maximum=10.0
    )
    height_tolerance: float = option(
        0.004, "largest deviation of a tool from its height", unit="m", minimum=1e-4, maximum=0.2
    )

    def __post_init__(self) -> None:
        validate(self)


CLOSED_LOOP: dict[str, Any] = {"contact_advance": 0.02, "contact_std": 0.02, "speed": 0.2}
"""How robots that look at the object touch, where it differs from those that do not."""


@documented
@dataclasses.dataclass(frozen=True)
class PushedObjectRange:
    """Where goals and objects may be."""

    workspace_x: tuple[float, float] = option(
        (0.36, 0.64), "range of goals and objects in x", unit="m", minimum=-2.0, maximum=2.0
    )
    workspace_y: tuple[float, float] = option(
        (-0.25, 0.25), "range of goals and objects in y", unit="m", minimum=-2.0, maximum=2.0
    )

    def __post_init__(self) -> None:
        validate(self)
        for name in ("workspace_x", "workspace_y"):
            low, high = getattr(self, name)
            if low >= high:
                raise ConfigurationError(f"{name} = {low}, {high}: the first must be below the second")

    def contains(self, position: NDArray) -> bool:
        """Whether a position (2,) is where goals and objects may be."""
        (x_low, x_high), (y_low, y_high) = self.workspace_x, self.workspace_y
        return bool(x_low <= position[0] <= x_high and y_low <= position[1] <= y_high)


@documented
@dataclasses.dataclass(frozen=True)
class RobustContactPlannerConfig(PushedObjectRange):
    """Options of saying where to touch, in closed loop."""

    planning: RobustContactConfig = dataclasses.field(
        default_factory=lambda: RobustContactConfig(**CLOSED_LOOP)
    )


@documented
@dataclasses.dataclass(frozen=True)
class RobustMpcConfig(PushedObjectRange):
    """Options of robust pushing in closed loop."""

    lead: float = option(
        0.05,
        "time between the start of planning and the moment the plan takes over",
        unit="s",
        minimum=0.005,
        maximum=1.0,
    )
    hold_distance: float = option(
        0.008, "the goal counts as reached, and the arms rest, within", unit="m", minimum=1e-4, maximum=0.5
    )
    resume_distance: float = option(
        0.012,
        "resting arms resume when the expected object is farther off than",
        unit="m",
        minimum=1e-4,
        maximum=0.5,
    )
    hold_std: float = option(
        0.02,
        "and the belief's standard deviation is at most",
        unit="m",
        minimum=1e-4,
        maximum=1.0,
    )
    largest_std: float = option(
        0.06,
        "the arms stop when the belief's standard deviation is larger: the object is lost",
        unit="m",
        minimum=1e-3,
        maximum=1.0,
    )
    joint_tolerance: float = option(
        0.06,
        "the plan is begun anew when a joint is farther from its reference",
        unit="rad",
        minimum=1e-3,
        maximum=1.0,
    )
    largest_offset: float = option(
        0.01,
        "the arms let go when a tool is held farther off its reference: the object is squeezed or stuck",
        unit="m",
        minimum=1e-3,
        maximum=0.1,
    )
    patience: float = option(
        8.0,
        "a warning is given when the object has come no nearer to its goal for so long",
        unit="s",
        minimum=0.1,
        maximum=1e4,
    )
    object_timeout: float = option(
        0.5, "the arms stop when the belief is older", unit="s", minimum=0.02, maximum=10.0
    )
    planning: RobustPushingConfig = dataclasses.field(
        default_factory=lambda: RobustPushingConfig(
            perturbation=1e-5,
            largest_gain=1.02,
            progress_weight=90.0,
            duration_weight=0.15,
            acceleration=1.0,
            wedge=-0.3,
            **CLOSED_LOOP,
            search=VpstoConfig(population=30, iterations=10, strategy="cma"),
        )
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.resume_distance < self.hold_distance:
            raise ConfigurationError(
                f"resume_distance = {self.resume_distance} is below hold_distance = {self.hold_distance}"
            )
