import dataclasses
from pathlib import Path

import numpy as np
import pytest
import yaml

from sim_bridge.cli import DEMOS
from sim_bridge.demo import settings as module
from sim_bridge.demo.bimanual_push import KNOCK_AREA, TABLE_CENTRE
from sim_bridge.demo.settings import Settings, _parameters, config_file, configured
from vpsto_ros.exceptions import ConfigurationError
from vpsto_ros.nodes.contact_planner_config import ContactPlannerNodeConfig
from vpsto_ros.nodes.mpc_planner_config import MpcPlannerConfig
from vpsto_ros.nodes.state_estimator_config import StateEstimatorConfig


@dataclasses.dataclass(frozen=True)
class Inner:
    gain: float = 1.0
    pair: tuple[float, float] = (0.0, 0.0)


@dataclasses.dataclass(frozen=True)
class Outer:
    rate: float = 20.0
    inner: Inner = dataclasses.field(default_factory=Inner)


def test_values_reach_their_fields_nested_or_dotted():
    expected = Outer(rate=5.0, inner=Inner(2.0, (1.0, 2.0)))
    assert configured(Outer(), {"rate": 5.0, "inner": {"gain": 2.0, "pair": [1.0, 2.0]}}) == expected
    assert configured(Outer(), {"rate": 5.0, "inner.gain": 2.0, "inner.pair": [1.0, 2.0]}) == expected


def test_an_unknown_name_is_refused_with_those_that_exist():
    with pytest.raises(ConfigurationError, match="'gian'; there are gain, pair"):
        configured(Outer(), {"inner": {"gian": 2.0}})


def test_the_demo_s_file_fits_the_nodes_and_says_what_is_drawn():
    settings = Settings.load("push_box", seed=3, real_time_factor=0.5)
    assert settings.scene.plant.shape.bounding_radius == pytest.approx(0.5 * 0.12 * 2**0.5)
    assert settings.scene.tool_height == settings.planner.planner.tool_height
    assert settings.planner_rate == 20.0


def test_the_bimanual_demo_s_file_fits_all_nodes_and_they_agree():
    settings = Settings.load("bimanual_push", seed=3, real_time_factor=1.0)
    content = yaml.safe_load(settings.file.read_text())
    nodes = {
        "state_estimator": StateEstimatorConfig(),
        "contact_planner": ContactPlannerNodeConfig(),
        "mpc_planner": MpcPlannerConfig(),
    }
    configs = {name: configured(default, _parameters(content, name)) for name, default in nodes.items()}
    assert {config.robot.kind for config in configs.values()} == {settings.scene.robot} == {"two_balls"}
    assert len({config.model.object for config in configs.values()}) == 1
    assert configs["mpc_planner"].model.object.shape() == settings.scene.plant.shape
    assert configs["mpc_planner"].robot.plane().height == settings.tools.height == settings.scene.height
    assert configs["mpc_planner"].kind == configs["contact_planner"].kind == "robust_pushing"
    space = configs["mpc_planner"].robust
    corners = [np.array([x, y]) for x in KNOCK_AREA.x for y in KNOCK_AREA.y]
    assert all(space.contains(np.array(point)) for point in (TABLE_CENTRE, *corners))


@pytest.mark.parametrize("name", DEMOS)
def test_every_demo_has_parameters_and_a_launch_file_that_names_them(name):
    root = Path(__file__).resolve().parents[1]
    assert (root / "config" / f"{name}.yaml").exists()
    assert f"{name}.yaml" in (root / "launch" / f"{name}.launch.py").read_text()


def test_nodes_get_file_seed_and_clock():
    settings = Settings.load("push_box", seed=3, real_time_factor=2.0)
    driver, estimator = settings.ros_arguments("franka_driver"), settings.ros_arguments("state_estimator")
    assert str(config_file("push_box.yaml")) in driver
    assert "franka_driver:seed:=3" in driver and "state_estimator:seed:=3" in estimator
    assert "franka_driver:real_time_factor:=2.000000" in driver
    assert "state_estimator:use_sim_time:=true" in estimator
    assert not any("use_sim_time" in argument for argument in driver)
    assert not any("seed" in argument for argument in settings.ros_arguments("contact_planner"))


def test_a_missing_file_says_where_it_was_looked_for():
    with pytest.raises(ConfigurationError, match="config"):
        config_file("nowhere.yaml")


def test_parameters_for_all_nodes_count_for_each(tmp_path, monkeypatch):
    file = tmp_path / "push_box.yaml"
    file.write_text(
        "/**:\n  ros__parameters: {base_frame: table}\n"
        "mpc_planner:\n  ros__parameters: {rate: 30.0, use_sim_time: true}\n"
    )
    monkeypatch.setattr(module, "config_file", lambda name: file)
    settings = Settings.load("push_box", 0, 1.0)
    assert (settings.planner.rate, settings.planner.base_frame, settings.driver.base_frame) == (
        30.0,
        "table",
        "table",
    )


@pytest.mark.parametrize("demo", list(DEMOS))
def test_what_the_command_line_says_wins_over_the_file(demo):
    rclpy = pytest.importorskip("rclpy")
    from sim_bridge.franka_driver import FrankaDriver
    from vpsto_ros.nodes.state_estimator import StateEstimator

    settings = Settings.load(demo, seed=7, real_time_factor=0.5)
    for node_class, name in ((FrankaDriver, "franka_driver"), (StateEstimator, "state_estimator")):
        rclpy.init(args=["demo", *settings.ros_arguments(name)])
        try:
            node = node_class(name)
            assert node.get_parameter("seed").value == 7
            if name == "franka_driver":
                assert node.get_parameter("real_time_factor").value == 0.5
            else:
                assert node.get_parameter("use_sim_time").value is True
            node.destroy_node()
        finally:
            rclpy.shutdown()
