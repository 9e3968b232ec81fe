"""What the demo's nodes are started with, and what that says about the scene that is drawn afterwards."""

from __future__ import annotations

import dataclasses
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from sim_bridge.driver_config import FrankaDriverConfig
from sim_bridge.scene import Scene
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.nodes.mpc_planner_config import MpcPlannerConfig
from vpsto_ros.robot.tool_plane import ToolPlane

HAND_HOLD = 0.04
"""How long the hand presses on when nothing more is heard of it [s]: two of its periods."""
SEEDED = ("franka_driver", "state_estimator", "mpc_planner")


@dataclass(frozen=True)
class Settings:
    """One demo's parameters.

    Attributes:
        file: the YAML file that every node reads.
        seed: of camera noise, belief samples and search.
        real_time_factor: simulated seconds per real second.
        driver: the driver's configuration according to the file.
        planner: the planner's configuration according to the file.
    """

    file: Path
    seed: int
    real_time_factor: float
    driver: FrankaDriverConfig
    planner: MpcPlannerConfig

    @classmethod
    def load(cls, demo: str, seed: int, real_time_factor: float) -> Settings:
        """Read ``config/<demo>.yaml``.

        Raises:
            ConfigurationError: when the file is missing or holds what a node does not take.
        """
        file = config_file(f"{demo}.yaml")
        content = yaml.safe_load(file.read_text()) or {}
        driver = configured(FrankaDriverConfig(), _parameters(content, "franka_driver"))
        planner = configured(MpcPlannerConfig(), _parameters(content, "mpc_planner"))
        return cls(file, seed, real_time_factor, driver, planner)

    @property
    def base_frame(self) -> str:
        """Frame of all poses."""
        return self.driver.base_frame

    @property
    def scene(self) -> Scene:
        """The cell of a pushing demo as the driver builds it."""
        return self.driver.pushing().scene

    @property
    def tools(self) -> ToolPlane:
        """The plane of the tools of a pushing demo's robot."""
        return self.driver.scene.plane()

    @property
    def planner_rate(self) -> float:
        """How often the planner plans [Hz]."""
        return self.planner.rate

    def ros_arguments(self, node: str) -> list[str]:
        """Command line arguments of a node."""
        arguments = ["--ros-args", "--params-file", str(self.file)]
        if node in SEEDED:
            arguments += ["-p", f"{node}:seed:={self.seed}"]
        if node == "franka_driver":
            # A decimal point makes it a ROS double.
            arguments += ["-p", f"{node}:real_time_factor:={self.real_time_factor:.6f}"]
            return [*arguments, "-p", f"{node}:disturbance_hold:={HAND_HOLD}"]
        return [*arguments, "-p", f"{node}:use_sim_time:=true"]


def config_file(name: str) -> Path:
    """A file of the folder ``config``: beside the source, else where pip or colcon put it.

    Raises:
        ConfigurationError: naming the places that were searched.
    """
    source = Path(__file__).resolve().parents[2]
    # colcon installs the package below <prefix>/lib/pythonX.Y/site-packages, the data below <prefix>/share.
    prefixes = [Path(sys.prefix), *source.parents]
    places = [source / "config", *(prefix / "share" / "vpsto_ros" / "config" for prefix in prefixes)]
    for place in places:
        if (place / name).is_file():
            return place / name
    raise ConfigurationError(
        f"{name} is in none of {', '.join(map(str, places))}; was the package installed completely?"
    )


def configured(default: Any, values: dict[str, Any]) -> Any:
    """A configuration with some of its values replaced.

    Args:
        default: dataclass instance, possibly holding others.
        values: by field name, nested like the dataclass; names with dots reach into it, too.

    Raises:
        ConfigurationError: for a name that does not exist or a value that is not allowed.
    """
    changes: dict[str, Any] = {}
    nested: dict[str, dict[str, Any]] = {}
    fields = {field.name for field in dataclasses.fields(default)}
    for name, value in values.items():
        head, _, rest = name.partition(".")
        if head not in fields:
            raise ConfigurationError(
                f"{type(default).__name__} has no {head!r}; there are {', '.join(sorted(fields))}"
            )
        if dataclasses.is_dataclass(getattr(default, head)):
            nested.setdefault(head, {}).update({rest: value} if rest else value)
        else:
            changes[head] = tuple(value) if isinstance(value, list) else value
    for head, part in nested.items():
        changes[head] = configured(getattr(default, head), part)
    return dataclasses.replace(default, **changes)


def _parameters(content: dict[str, Any], node: str) -> dict[str, Any]:
    """The parameters of one node in a ROS parameter file, those for all nodes included."""
    found: dict[str, Any] = {}
    for name in ("/**", node, f"/{node}"):
        found.update(content.get(name, {}).get("ros__parameters", {}))
    return {key: value for key, value in found.items() if key != "use_sim_time"}
