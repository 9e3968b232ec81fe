"""The warm-up uses every kernel, so that processes that start together find them in the disk cache."""

import ast
import importlib
import inspect
from pathlib import Path

import pytest
from numba.core.dispatcher import Dispatcher

from sim_bridge import cli

ROOT = Path(__file__).resolve().parents[1]


def modules_with_kernels():
    for room in ("vpsto_ros", "sim_bridge"):
        for file in sorted((ROOT / room).glob("**/*.py")):
            if "njit" in file.read_text() or "kernel" in file.read_text():
                yield ".".join(file.relative_to(ROOT).with_suffix("").parts)


def kernels_called_from_python(name):
    """Kernels that functions of a module call by name, apart from calls within kernels."""
    module = importlib.import_module(name)
    for node in ast.walk(ast.parse(inspect.getsource(module))):
        if not isinstance(node, ast.FunctionDef) or "njit" in "".join(map(ast.dump, node.decorator_list)):
            continue
        for call in (child for child in ast.walk(node) if isinstance(child, ast.Call)):
            target = call.func
            if isinstance(target, ast.Name):
                found = getattr(module, target.id, None)
            elif isinstance(target, ast.Attribute) and isinstance(target.value, ast.Name):
                found = getattr(getattr(module, target.value.id, None), target.attr, None)
            else:
                continue
            if isinstance(found, Dispatcher):
                yield found


@pytest.fixture(scope="module")
def warmed():
    assert cli.main(["warm-up"]) == 0


@pytest.mark.parametrize("name", list(modules_with_kernels()))
def test_every_kernel_is_there_after_the_warm_up(warmed, name):
    missing = {kernel.__qualname__ for kernel in kernels_called_from_python(name) if not kernel.signatures}
    assert not missing


def test_the_search_for_kernels_finds_them():
    found = {kernel.__name__ for kernel in kernels_called_from_python("vpsto_ros.trajectory.timing")}
    assert {"durations_kernel", "synthesis_kernel"} <= found
