"""Parameters of the node between a camera and the planners."""

import dataclasses

from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.estimation.measurement import MeasurementLimits
from vpsto_ros.estimation.particle_filter_config import ParticleFilterConfig
from vpsto_ros.estimation.planar_kalman import PlanarKalmanConfig
from vpsto_ros.estimation.puck_filter import PuckFilterConfig
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.nodes.lifecycle import NodeConfig
from vpsto_ros.nodes.robots import RobotConfig
from vpsto_ros.nodes.scene import ModelConfig, TableConfig
from vpsto_ros.nodes.table_frame import HockeyTableConfig
from vpsto_ros.robot.mallet_tilt import MalletTilt

KALMAN, PARTICLES, PUCK = "kalman", "particles", "puck"


@documented
@dataclasses.dataclass(frozen=True)
class StateEstimatorConfig(NodeConfig):
    """Parameters of the state estimator."""

    kind: str = option(
        KALMAN,
        "which filter: kalman, which knows the camera only (filter.*); particles that the robot's tools push "
        "(particles.*, robot.*, model.*, way_variance, touch), which need joint_states; or that of an "
        "air-hockey puck (puck.*, puck_model, mallet.*, hockey.*), which the mallet of an iiwa hits: "
        "joint_states",
        choices=(KALMAN, PARTICLES, PUCK),
    )
    rate: float = option(50.0, "rate at which object_state is kept up", unit="Hz", minimum=1.0, maximum=200.0)
    belief_rate: float = option(20.0, "rate of object_belief", unit="Hz", minimum=0.1, maximum=100.0)
    marker_rate: float = option(10.0, "rate of ~/markers", unit="Hz", minimum=0.1, maximum=50.0)
    belief_samples: int = option(50, "poses in object_belief", minimum=1, maximum=2000)
    fresh: float = option(
        0.15,
        "age of the last frame up to which its state goes out as it is",
        unit="s",
        minimum=0.0,
        maximum=5.0,
    )
    prediction: float = option(
        0.3,
        "time for which frames that stay away are bridged by prediction",
        unit="s",
        minimum=0.0,
        maximum=5.0,
    )
    max_age: float = option(
        1.0,
        "older frames and forces are refused; particles remember their way for so long",
        unit="s",
        minimum=0.01,
        maximum=5.0,
    )
    max_ahead: float = option(
        0.1,
        "frames and forces farther in the future are refused; with particles, also those so far ahead of the "
        "last joint_states",
        unit="s",
        minimum=0.0,
        maximum=10.0,
    )
    position_std: float = option(
        0.005,
        "standard deviation of x and y where a frame gives none; for a puck puck.position_std counts",
        unit="m",
        minimum=1e-5,
        maximum=1.0,
    )
    yaw_std: float = option(
        0.05, "standard deviation of yaw where a frame gives none", unit="rad", minimum=1e-5, maximum=3.0
    )
    seed: int = option(0, "seed of the belief's samples, and of the particles", minimum=0)
    touch: bool = option(
        False,
        "whether particles are weighed by external_wrench as well, the sum of the forces on all tools; which "
        "of several tools touches, only a sensor in each could tell",
    )
    force_noise: float = option(
        0.2, "standard deviation of a component of external_wrench", unit="N", minimum=0.0, maximum=100.0
    )
    way_variance: float = option(
        1e-4,
        "variance that the place of a particle gains per metre pushed",
        unit="m",
        minimum=0.0,
        maximum=0.1,
    )
    puck_model: str = option("", "file with the learned model of the puck; empty takes the package's")
    table: TableConfig = dataclasses.field(default_factory=TableConfig)
    filter: PlanarKalmanConfig = dataclasses.field(default_factory=PlanarKalmanConfig)
    particles: ParticleFilterConfig = dataclasses.field(default_factory=ParticleFilterConfig)
    robot: RobotConfig = dataclasses.field(default_factory=RobotConfig)
    model: ModelConfig = dataclasses.field(default_factory=ModelConfig)
    puck: PuckFilterConfig = dataclasses.field(default_factory=PuckFilterConfig)
    mallet: MalletTilt = dataclasses.field(default_factory=MalletTilt)
    hockey: HockeyTableConfig = dataclasses.field(default_factory=HockeyTableConfig)

    @property
    def surface(self) -> float:
        """Height of the table that the object lies on, base frame [m]."""
        return self.hockey.surface if self.kind == PUCK else 0.0

    @property
    def limits(self) -> MeasurementLimits:
        """Where the object can be and how old what is measured may be, for the node and its particles."""
        return MeasurementLimits(self.table.x, self.table.y, self.max_age, self.max_ahead)

    def __post_init__(self) -> None:
        validate(self)
        if self.touch and self.kind != PARTICLES:
            raise ConfigurationError(
                f"touch = True needs kind = '{PARTICLES}'; the other filters know nothing of forces"
            )
        if self.puck.velocity_std != PuckFilterConfig().velocity_std:
            raise ConfigurationError(
                f"puck.velocity_std = {self.puck.velocity_std:g} would change nothing: object_pose brings no "
                "velocities; leave it out"
            )
        if self.kind == PUCK and self.position_std != StateEstimatorConfig.position_std:
            raise ConfigurationError(
                f"position_std = {self.position_std:g} would change nothing with kind = '{PUCK}'; set "
                "puck.position_std"
            )
        if self.kind == PARTICLES and self.belief_samples < 2:
            raise ConfigurationError(
                f"belief_samples = {self.belief_samples} must be 2 or more with kind = '{PARTICLES}': one "
                "particle says nothing about what is uncertain"
            )
