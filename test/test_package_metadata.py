"""The package describes itself the same way everywhere, and its rooms import only what they may."""

import ast
import dataclasses
import re
import subprocess
import sys
import xml.etree.ElementTree as ElementTree
from pathlib import Path

import pytest

import vpsto_ros

ROOT = Path(__file__).resolve().parents[1]
SETUP = (ROOT / "setup.py").read_text()
PACKAGE = ElementTree.parse(ROOT / "package.xml").getroot()
HEAVY = {
    "rclpy", "mujoco", "sim_bridge", "cma", "matplotlib", "viser", "rosbags", "joblib", "dask", "distributed",
}  # fmt: skip
ROOMS = (
    "trajectory", "contact", "robot", "collision", "priors", "belief", "estimation", "optimization",
    "planning", "nodes",
)  # fmt: skip
"""A room may import those before it, and the modules that belong to no room."""
SHARED = {"configuration", "exceptions", "kernel_cache", "sources"}
SCRIPTS = dict(re.findall(r'"(\w+) = ([\w.]+:\w+)"', SETUP))


def test_versions_agree():
    assert PACKAGE.findtext("version") == vpsto_ros.__version__
    assert f'version="{vpsto_ros.__version__}"' in SETUP


def test_colcon_can_read_the_package():
    assert PACKAGE.findtext("name") == "vpsto_ros"
    assert PACKAGE.findtext("license") == "Apache-2.0"
    assert PACKAGE.findtext("export/build_type") == "ament_python"
    address = PACKAGE.find("maintainer").get("email")
    # Without a valid address colcon silently builds a plain Python package.
    assert re.fullmatch(r"[-\w%+.]+@[-\w.]+\.[a-zA-Z]{2,}", address)
    assert (ROOT / "resource" / "vpsto_ros").exists()


def test_executables_go_where_ros2_run_looks():
    text = (ROOT / "setup.cfg").read_text()
    assert "script_dir=$base/lib/vpsto_ros" in text and "install_scripts=$base/lib/vpsto_ros" in text
    assert set(SCRIPTS) == {"vpsto", "franka_driver", "state_estimator", "contact_planner", "mpc_planner"}


@pytest.mark.parametrize("target", sorted(SCRIPTS.values()))
def test_every_entry_point_exists(target):
    module, function = target.split(":")
    tree = ast.parse((ROOT / (module.replace(".", "/") + ".py")).read_text())
    assert function in {node.name for node in tree.body if isinstance(node, ast.FunctionDef)}


def imported_names(file):
    """Dotted names of what a file imports anywhere in it; for `from a import b`, a.b as b may be a module."""
    for node in ast.walk(ast.parse(file.read_text())):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{file}: a relative import"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def rooms_imported(file):
    """Names directly below vpsto_ros that a file imports."""
    return {name.split(".")[1] for name in imported_names(file) if name.startswith("vpsto_ros.")}


def test_the_rooms_are_all_that_there_is():
    folders = {file.parent.name for file in ROOT.glob("vpsto_ros/*/__init__.py")}
    assert folders == set(ROOMS)
    assert {file.stem for file in ROOT.glob("vpsto_ros/*.py")} == SHARED | {"__init__"}


@pytest.mark.parametrize("room", ROOMS)
def test_a_room_imports_only_the_rooms_before_it(room):
    allowed = SHARED | {"__version__", room} | set(ROOMS[: ROOMS.index(room)])
    files = list((ROOT / "vpsto_ros" / room).rglob("*.py"))
    wrong = {str(file.relative_to(ROOT)): rooms_imported(file) - allowed for file in files}
    assert files and not {file: names for file, names in wrong.items() if names}


def test_what_belongs_to_no_room_imports_no_room():
    for name in SHARED | {"__init__"}:
        assert rooms_imported(ROOT / "vpsto_ros" / f"{name}.py") <= SHARED | {"__version__"}


def test_the_library_never_imports_the_simulation():
    files = list(ROOT.glob("vpsto_ros/**/*.py"))
    tops = {str(file): {name.split(".")[0] for name in imported_names(file)} for file in files}
    assert not [file for file, names in tops.items() if "sim_bridge" in names]


def test_what_trains_needs_no_experiment():
    names = {name for file in ROOT.glob("sim_bridge/learn/*.py") for name in imported_names(file)}
    assert "vpsto_ros.planning.hockey.shooting_training.train" in names
    assert not [name for name in names if name.startswith("sim_bridge.experiments")]


def test_imports_are_found_wherever_they_are(tmp_path):
    (tmp_path / "a.py").write_text(
        "import vpsto_ros.robot.kinematics as k\nfrom vpsto_ros import nodes\n"
        "def f():\n    from sim_bridge.cli import main\n"
    )
    assert rooms_imported(tmp_path / "a.py") == {"robot", "nodes"}
    assert "sim_bridge.cli.main" in set(imported_names(tmp_path / "a.py"))


def test_every_message_package_that_is_imported_is_declared():
    declared = {element.text for element in PACKAGE.findall("exec_depend")}
    imported = set()
    for file in [
        *ROOT.glob("vpsto_ros/**/*.py"),
        *ROOT.glob("sim_bridge/**/*.py"),
        *ROOT.glob("launch/*.py"),
    ]:
        imported |= {name.split(".")[0] for name in imported_names(file)}
    ros = {
        name
        for name in imported
        if name.endswith(("_msgs", "_srvs", "_interfaces")) or name in ("rclpy", "launch", "launch_ros")
    }
    assert ros <= declared


def modules(room):
    for file in sorted((ROOT / room).glob("**/*.py")):
        name = ".".join(file.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")
        if not name.startswith("vpsto_ros.nodes"):
            yield name


def test_the_library_needs_neither_ros_nor_a_simulator():
    names = list(modules("vpsto_ros"))
    code = f"import importlib, sys\nfor name in {names!r}: importlib.import_module(name)\nprint(*sys.modules)"
    loaded = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout.split()
    assert {"vpsto_ros.trajectory", "vpsto_ros.planning.hockey.agent"} <= set(loaded)
    tops = {name.split(".")[0] for name in loaded}
    assert tops.isdisjoint(HEAVY)


def requirements(extra):
    """Names of the packages that an extra of setup.py asks for."""
    (entries,) = re.findall(rf'"{extra}": \[(.*?)\],\n', SETUP, re.DOTALL)
    return set(re.findall(r'"([\w-]+)', entries))


def test_many_runs_have_what_they_need():
    assert {"joblib", "tqdm"} <= requirements("sim"), "processes of this machine"
    assert {"dask", "distributed"} <= requirements("cluster")
    assert "distributed" in requirements("test"), "or the tests on a cluster would be skipped"


def test_models_are_installed_with_the_package():
    files = [file.relative_to(ROOT) for file in ROOT.glob("vpsto_ros/**/*.xml")]
    assert files
    assert {str(file.parent) for file in files} == {"vpsto_ros/robot/models"}
    assert '"vpsto_ros.robot": ["models/*.xml"]' in SETUP
    for file in ROOT.glob("vpsto_ros/*/models/*"):
        assert f'"vpsto_ros.{file.parts[-3]}": ["models/*{file.suffix}"]' in SETUP, file


def test_options_explain_themselves_in_help():
    from vpsto_ros.optimization.vpsto import VpstoConfig

    text = VpstoConfig.__doc__
    assert "Options:" in text
    assert "population: candidates per iteration and start (32; int from 4 to 100000)." in text
    assert all(f"    {field.name}: " in text for field in dataclasses.fields(VpstoConfig))
