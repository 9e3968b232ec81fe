"""Pushing a can along a scripted path in MuJoCo, and what camera, joints and wrists measure meanwhile."""

import dataclasses
import math

import numpy as np
from numpy.typing import NDArray

from sim_bridge.camera import CameraConfig
from sim_bridge.scene import BallsStart, ObjectPlant, Scene
from sim_bridge.simulation import Simulation
from sim_bridge.trajectory_follower import TrajectoryCommand
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.planning.plane_path import follow_plane
from vpsto_ros.robot.tip_kinematics import BALL_RADIUS
from vpsto_ros.trajectory import Trajectory

CAN_RADIUS = 0.05
FORCE_NOISE = 0.2
"""Standard deviation of a component of a measured force [N]; pushing the cans takes 0.4 to 4 N."""
OUTLIERS = 0.05
"""Share of the pictures that show something else, up to 20 cm away."""
DROPOUT = 1.0
"""How long the camera sees nothing at a time [s]."""
BLIND_STD = 0.015
"""How well the only picture of a blind push shows the can [m]."""

_REACH = CAN_RADIUS + BALL_RADIUS
_PARKED = (0.42, -0.28)
_WAIT, _DURATION = 0.4, 4.0
_SPREAD = 0.6  # angle between the balls and the direction that they push to, seen from the can [rad]


@dataclasses.dataclass(frozen=True)
class Episode:
    """What happens; its randomness comes from the seed.

    Attributes:
        kind: "two_balls", "one_ball", or "blind": two balls, and only one bad picture.
        seed: of everything random.
    """

    kind: str
    seed: int


@dataclasses.dataclass(frozen=True)
class Picture:
    """A pose that arrives.

    Attributes:
        arrival: when [s].
        stamp: when it was taken [s].
        pose: (x, y, yaw) [m, rad].
        covariance: that the camera claims (3, 3).
    """

    arrival: float
    stamp: float
    pose: NDArray[np.float64]
    covariance: NDArray[np.float64]


@dataclasses.dataclass(frozen=True)
class Log:
    """An episode as measured, in steps of 10 ms.

    Attributes:
        times: [s], shape (K,).
        points: plane coordinates of the balls as the joints say, shape (K, 4) [m].
        forces: on the two balls, mean of the last step, with noise, shape (K, 2, 2) [N].
        truth: poses of the can, shape (K, 3).
        pictures: in the order of arrival.
        dropouts: times from and to which the camera sees nothing, shape (D, 2) [s].
        touched: when a ball first touched the can [s], inf if never.
    """

    times: NDArray[np.float64]
    points: NDArray[np.float64]
    forces: NDArray[np.float64]
    truth: NDArray[np.float64]
    pictures: list[Picture]
    dropouts: NDArray[np.float64]
    touched: float


def record(episode: Episode) -> Log:
    """Run an episode in the simulation."""
    rng = np.random.default_rng([episode.seed, 23])
    start = np.array([0.44, 0.0]) + rng.uniform(-0.015, 0.015, 2)
    path = _path(episode, rng)
    plant = _can(rng)
    scene = Scene(
        robot="two_balls", plant=plant, balls=BallsStart(tuple(path(0.0).tolist())),
        object_pose=(*start.tolist(), rng.uniform(-3.0, 3.0)),
    )  # fmt: skip
    simulation = Simulation(scene, seed=episode.seed, camera=CameraConfig())
    joints = follow_plane(path, simulation.plane).trajectory
    simulation.follower.accept(TrajectoryCommand.of(joints, simulation.robot.joint_names), 0.0)
    dropouts = _dropouts(episode, rng)
    rows, pictures = [], []
    for _ in range(round((joints.duration + 0.2) * 100)):
        force = np.zeros((2, 3))
        for _ in range(5):
            simulation.advance(0.002)
            force += [simulation.tool_contact_force(tool) / 5.0 for tool in range(2)]
        now = simulation.time
        rows.append((now, simulation.plane.tool(simulation.joint_position), force, simulation.object_pose()))
        pictures += [Picture(now, f.stamp, f.pose, f.covariance) for f in simulation.camera_frames()]
    times, points, forces, truth = (np.array(column) for column in zip(*rows, strict=True))
    felt = np.flatnonzero(np.linalg.norm(forces, axis=2).max(axis=1) > 0.05)
    noisy = -forces[..., :2] + FORCE_NOISE * rng.standard_normal((len(times), 2, 2))
    seen = _seen(episode, pictures, dropouts, rng)
    return Log(times, points, noisy, truth, seen, dropouts, float(times[felt[0]]) if len(felt) else math.inf)


def _can(rng: np.random.Generator) -> ObjectPlant:
    angle, offset = rng.uniform(-np.pi, np.pi), 0.008 * math.sqrt(rng.random())
    return ObjectPlant(
        shape=PlanarShape.disc(CAN_RADIUS), height=0.12, mass=rng.uniform(0.2, 0.8),
        table_friction=rng.uniform(0.2, 0.5), tool_friction=rng.uniform(0.05, 0.5),
        com_offset=(offset * math.cos(angle), offset * math.sin(angle)),
        support="corners" if rng.random() < 0.5 else "spread",
    )  # fmt: skip


def _path(episode: Episode, rng: np.random.Generator) -> Trajectory:
    """From 3 cm before the can 20 cm forward, to one side and back; one ball alone goes less far."""
    alone = episode.kind == "one_ball"
    length, swing = (0.13, 0.02) if alone else (0.2, 0.05 * rng.choice([-1.0, 1.0]))
    angles = np.pi + (np.array([rng.uniform(-0.15, 0.15), 0.0]) if alone else np.array([-1, 1]) * _SPREAD)
    times = np.linspace(0.0, _DURATION, 41)
    s = np.clip((times - _WAIT) / (_DURATION - _WAIT), 0.0, 1.0)
    s = s**3 * (10.0 - 15.0 * s + 6.0 * s * s)
    ahead = np.clip((s - 0.15) / 0.85, 0.0, 1.0)
    side = swing * np.sin(2.0 * np.pi * ahead) ** 2 * np.sin(np.pi * ahead)
    centre = np.column_stack([0.44 - 0.035 + (length + 0.035) * s, side])
    points = np.concatenate([centre + _REACH * np.array([np.cos(a), np.sin(a)]) for a in angles], axis=1)
    if alone:
        points[:, 2:] = _PARKED
    rates = np.gradient(points, times, axis=0)
    rates[[0, -1]] = 0.0
    return Trajectory.from_points(times, points, rates)


def _dropouts(episode: Episode, rng: np.random.Generator) -> NDArray[np.float64]:
    """The first one about when the can is reached, the other one in the middle of the push."""
    if episode.kind == "blind":
        return np.array([[0.1, 1e3]])
    starts = np.array([rng.uniform(0.9, 1.3), rng.uniform(2.5, 2.8)])
    return np.column_stack([starts, starts + DROPOUT])


def _seen(
    episode: Episode, pictures: list[Picture], dropouts: NDArray, rng: np.random.Generator
) -> list[Picture]:
    """What gets through, outliers included."""
    out = []
    for picture in pictures:
        stray, shift = rng.random() < OUTLIERS, rng.uniform(-0.2, 0.2, 2)
        if ((dropouts[:, 0] <= picture.stamp) & (picture.stamp < dropouts[:, 1])).any():
            continue
        if stray and episode.kind != "blind":
            picture = dataclasses.replace(picture, pose=picture.pose + [*shift, 0.0])
        out.append(picture)
    if episode.kind != "blind":
        return out
    bad = np.array([*(BLIND_STD * rng.standard_normal(2)), 0.0])
    noise = out[0].covariance + np.diag([BLIND_STD**2, BLIND_STD**2, 0.0])
    return [dataclasses.replace(out[0], pose=out[0].pose + bad, covariance=noise)]
