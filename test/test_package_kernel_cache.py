"""Machine code in the cache is used exactly as long as all that it was made from is the same."""

import importlib
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

import vpsto_ros
from vpsto_ros import sources

ROOT = Path(vpsto_ros.__file__).resolve().parents[1]
FILES = {
    "__init__.py": "__version__ = '1'\n",
    "room/__init__.py": "import vpsto_ros.kernel_cache\n",
    "room/constants.py": "SHIFT = 0.0\n",
    "room/callee.py": "from numba import njit\n\n@njit(cache=True)\ndef twice(x):\n    return 2.0 * x\n",
    "room/caller.py": (
        "from numba import njit\n"
        "from vpsto_ros.room.callee import twice\n"
        "from vpsto_ros.room.constants import SHIFT\n\n"
        "@njit(cache=True)\ndef f(x):\n    return twice(x) + SHIFT\n"
    ),
    "room/other.py": "",
}
RUN = "from vpsto_ros.room.caller import f; print(f(1.0), sum(f.stats.cache_hits.values()))"


@pytest.fixture
def package(tmp_path):
    """A package of the same name with two kernels, one calling the other from its own file."""
    folder = tmp_path / "vpsto_ros"
    (folder / "room").mkdir(parents=True)
    for name, text in FILES.items():
        (folder / name).write_text(text)
    for name in ("sources.py", "kernel_cache.py"):
        shutil.copy(ROOT / "vpsto_ros" / name, folder / name)
    return folder


def run(package, **environment):
    """The caller's value in a process of its own, and whether it was in the cache."""
    inherited = {name: value for name, value in os.environ.items() if not name.startswith("NUMBA_")}
    result = subprocess.run(
        [sys.executable, "-c", RUN], cwd=package.parent, check=True, capture_output=True, text=True,
        env={**inherited, "PYTHONPATH": str(package.parent), **environment},
    )  # fmt: skip
    value, hits = result.stdout.split()
    return float(value), int(hits)


def test_edits_of_a_callee_or_a_constant_reach_the_caller(package):
    assert run(package) == (2.0, 0)
    assert run(package) == (2.0, 1)
    callee = package / "room" / "callee.py"
    callee.write_text(callee.read_text().replace("2.0", "3.0"))
    assert run(package) == (3.0, 0)
    (package / "room" / "constants.py").write_text("SHIFT = 0.5\n")
    assert run(package) == (3.5, 0)
    (package / "room" / "other.py").write_text("# of no concern\n")
    assert run(package) == (3.5, 1)
    entries = list((package / "room" / "__pycache__").glob("caller.f-*.nbc"))
    assert len(entries) == 1, "old code does not pile up"


def test_a_folder_of_the_users_choice_is_respected(package, tmp_path):
    cache = tmp_path / "cache"
    assert run(package, NUMBA_CACHE_DIR=str(cache)) == (2.0, 0)
    assert run(package, NUMBA_CACHE_DIR=str(cache)) == (2.0, 1)
    assert list(cache.rglob("*.nbc")) and not list(package.rglob("*.nbc"))


def modules_with_kernels():
    for file in sources.package_files():
        if file.suffix == ".py" and "njit(" in file.read_text():
            yield ".".join(file.relative_to(ROOT).with_suffix("").parts)


def test_every_kernel_is_cached_like_that():
    modules = [importlib.import_module(name) for name in modules_with_kernels()]
    values = [value for module in modules for value in vars(module).values()]
    kernels = {value for value in values if isinstance(value, Dispatcher)}
    assert len(kernels) > 30
    assert {kernel.__qualname__ for kernel in kernels if not kernel._cache._impl.locator.noticing} == set()


def test_a_kernel_depends_on_what_its_file_imports_and_these_import():
    file = ROOT / "vpsto_ros" / "robot" / "radial_arm.py"
    names = {path.relative_to(ROOT / "vpsto_ros").as_posix() for path in sources.dependencies(file)}
    assert {"robot/kinematics.py", "robot/models/fr3_pusher.xml", "trajectory/kernels.py"} <= names
    assert not any(name.startswith(("contact/", "planning/")) for name in names)


def test_the_command_line_starts_without_numba():
    code = "import sys, sim_bridge.cli; sim_bridge.cli.build_parser(); sys.exit('numba' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
