"""Parameters of the simulated driver."""

import dataclasses

from sim_bridge.arm_world import ArmWorld
from sim_bridge.camera import CameraConfig
from sim_bridge.hockey.mallet import MalletConfig
from sim_bridge.hockey.puck_places import PuckPlaces
from sim_bridge.hockey.scene import AirHockeyScene
from sim_bridge.hockey.world import CAMERA, AirHockeyWorld, ArmGains
from sim_bridge.impedance import ImpedanceConfig
from sim_bridge.scene import Scene
from sim_bridge.simulation import Simulation
from sim_bridge.trajectory_follower import FollowerConfig
from vpsto_ros.configuration import documented, option, validate
from vpsto_ros.nodes.lifecycle import NodeConfig
from vpsto_ros.nodes.scene import ShapeConfig

PUSHING, AIR_HOCKEY = "pushing", "air_hockey"


@dataclasses.dataclass(frozen=True)
class AirHockeyConfig:
    """An air-hockey table with its robot, camera and pucks."""

    scene: AirHockeyScene = dataclasses.field(default_factory=AirHockeyScene)
    camera: CameraConfig = CAMERA
    gains: ArmGains = dataclasses.field(default_factory=ArmGains)
    mallet: MalletConfig = dataclasses.field(default_factory=MalletConfig)
    pucks: PuckPlaces = dataclasses.field(default_factory=PuckPlaces)


@documented
@dataclasses.dataclass(frozen=True)
class FrankaDriverConfig(NodeConfig):
    """Parameters of the simulated driver."""

    world: str = option(
        PUSHING,
        "what is simulated: pushing, an FR3 and an object (object.*, scene.*, camera.*, impedance.*), or "
        "air_hockey, an iiwa 14 at its table (hockey.*)",
        choices=(PUSHING, AIR_HOCKEY),
    )
    real_time_factor: float = option(
        1.0, "simulated seconds per real second", unit="s/s", minimum=0.01, maximum=100.0
    )
    seed: int = option(0, "seed of camera noise and drop-outs, and of where pucks are put", minimum=0)
    clock_rate: float = option(100.0, "rate of /clock", unit="Hz", minimum=10.0, maximum=200.0)
    joint_state_rate: float = option(100.0, "rate of joint_states", unit="Hz", minimum=10.0, maximum=200.0)
    report_rate: float = option(
        50.0, "rate of external_wrench and ground truth", unit="Hz", minimum=1.0, maximum=200.0
    )
    marker_rate: float = option(10.0, "rate of ~/markers", unit="Hz", minimum=0.1, maximum=50.0)
    disturbance_hold: float = option(
        0.1,
        "how long a message on disturbance acts unless a new one comes",
        unit="s",
        minimum=0.01,
        maximum=5.0,
    )
    object: ShapeConfig = dataclasses.field(default_factory=ShapeConfig)
    scene: Scene = dataclasses.field(default_factory=Scene)
    camera: CameraConfig = dataclasses.field(default_factory=CameraConfig)
    impedance: ImpedanceConfig = dataclasses.field(default_factory=ImpedanceConfig)
    hockey: AirHockeyConfig = dataclasses.field(default_factory=AirHockeyConfig)
    # A planner never plans that far ahead; whoever does has another clock, and would keep the arm to himself.
    follower: FollowerConfig = dataclasses.field(default_factory=lambda: FollowerConfig(horizon=1.0))

    def __post_init__(self) -> None:
        validate(self)

    def simulation(self) -> ArmWorld:
        """The world of this configuration, at time 0."""
        return self.air_hockey() if self.world == AIR_HOCKEY else self.pushing()

    def pushing(self) -> Simulation:
        """A robot that pushes an object, at time 0."""
        plant = dataclasses.replace(self.scene.plant, shape=self.object.shape())
        scene = dataclasses.replace(self.scene, plant=plant)
        return Simulation(
            scene, seed=self.seed, camera=self.camera, impedance=self.impedance, follower=self.follower
        )

    def air_hockey(self) -> AirHockeyWorld:
        """A robot that plays air hockey, at time 0."""
        given = self.hockey
        return AirHockeyWorld(
            given.scene, seed=self.seed, camera=given.camera, gains=given.gains, mallet=given.mallet,
            follower=self.follower,
        )  # fmt: skip
