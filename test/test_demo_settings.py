import dataclasses

import pytest

from sim_bridge.demo import settings as module
from sim_bridge.demo.settings import Settings, config_file, configured
from vpsto_ros.exceptions import ConfigurationError


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


def test_nodes_get_file_seed_and_clock():
    settings = Settings.load("push_box", seed=3, real_time_factor=2.0)
    driver, estimator = settings.ros_arguments("franka_driver"), settings.ros_arguments("state_estimator")
    assert str(config_file("push_box.yaml")) in driver
    assert "seed:=3" in driver and "seed:=3" in estimator
    assert "real_time_factor:=2.000000" in driver
    assert "use_sim_time:=true" in estimator and "use_sim_time:=true" not in driver
    assert "seed:=3" not in settings.ros_arguments("contact_planner")


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
