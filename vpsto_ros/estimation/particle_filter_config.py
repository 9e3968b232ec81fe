"""Options of the particle filter, and the state that it reports."""

import dataclasses
import math

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.estimation.touch import TouchConfig
from vpsto_ros.exceptions import ConfigurationError


@documented
@dataclasses.dataclass(frozen=True)
class ParticleFilterConfig:
    """Options of the filter.

    Args:
        touch: how forces are read.

    Raises:
        ConfigurationError: a value is out of range; the message names what is allowed.
    """

    touch: TouchConfig = dataclasses.field(default_factory=TouchConfig)
    particles: int = option(200, "number of particles", minimum=10, maximum=100_000)
    drift: tuple[float, float] = option(
        (1e-3, 5e-3), "random walk of the object besides contact, linear and angular",
        unit="m, rad per sqrt(s)", minimum=1e-6, maximum=1.0,
    )  # fmt: skip
    friction: tuple[float, float] = option(
        (0.0, 0.5), "range of the friction against end effectors", minimum=0.0, maximum=2.0
    )
    center_std: float = option(
        0.005, "standard deviation of the centre of friction", unit="m", minimum=0.0, maximum=0.1
    )
    model_std: tuple[float, float] = option(
        (5e-4, 2e-3),
        "error of shapes and contacts that no particle shows: added to the noise of measured poses, and to"
        " the covariance of the state",
        unit="m, rad",
        minimum=1e-6,
        maximum=1.0,
    )
    outlier_share: float = option(
        0.05, "probability that a measured pose is an outlier", minimum=1e-6, maximum=0.5
    )
    outlier_density: float = option(
        4.0, "density of outliers: one over the area that they are spread over", unit="1/m^2", minimum=1e-6,
        maximum=1e6,
    )  # fmt: skip
    resampling: float = option(
        0.5, "share of effective particles below which they are drawn anew", minimum=0.0, maximum=1.0
    )
    sparse: float = option(
        0.1,
        "share of effective particles below which a pose draws new ones between those that there are",
        minimum=0.0,
        maximum=1.0,
    )
    jitter: float = option(
        0.15, "width of the kernel that spreads copies, in standard deviations of the belief", minimum=0.0,
        maximum=0.9,
    )  # fmt: skip
    confirmations: int = option(
        3, "consecutive unlikely poses that agree with each other and restart the filter", minimum=1,
        maximum=100,
    )  # fmt: skip
    max_speed: float = option(
        1.0, "speed up to which unlikely poses agree", unit="m/s", minimum=1e-3, maximum=100.0
    )
    longest_gap: float = option(
        0.2, "gap between plane points beyond which the way in between is taken to be unknown", unit="s",
        minimum=0.01, maximum=10.0,
    )  # fmt: skip
    longest_jump: float = option(
        0.1,
        "and likewise for the distance between two of them",
        unit="m or rad",
        minimum=1e-3,
        maximum=10.0,
    )
    longest_step: float = option(
        0.003, "plane points farther apart are interpolated", unit="m or rad", minimum=1e-4, maximum=0.1
    )
    extrapolation: float = option(
        0.05, "how long the end effectors are taken to move on beyond the last plane point", unit="s",
        minimum=0.0, maximum=1.0,
    )  # fmt: skip
    lost_after: float = option(
        1.0, "time unseen after which an uncertain object counts as lost", unit="s", minimum=0.01,
        maximum=1e4,
    )  # fmt: skip
    lost_spread: float = option(
        0.03, "standard deviation of the position above which it is uncertain", unit="m", minimum=1e-4,
        maximum=10.0,
    )  # fmt: skip

    def __post_init__(self) -> None:
        validate(self)
        if self.friction[0] > self.friction[1]:
            raise ConfigurationError(f"ParticleFilterConfig.friction = {self.friction} is not a range")


@dataclasses.dataclass(frozen=True)
class FilterStatus:
    """How a filter is doing.

    Attributes:
        kind: "tracking"; "recovering": poses contradict the belief, or it has just been restarted; "lost";
            or "uninitialised".
        reason: why, in words.
    """

    kind: str
    reason: str


def unseen(gap: float, spread: float) -> str:
    """For how long an object has not been seen, in words."""
    times = f"for {gap:.2g} s" if math.isfinite(gap) else "yet"
    return f"not seen {times}, standard deviation {1e3 * spread:.0f} mm"
