"""ROS parameters from configuration dataclasses: declared, described, checked and read in one place.

The fields made with :func:`vpsto_ros.configuration.option` become parameters; a field that holds another
configuration becomes a group, so that ``config.filter.gate`` is the parameter ``filter.gate``.
"""

import dataclasses
import difflib
import math
import sys
from collections.abc import Iterator
from typing import Any, NamedTuple, TypeVar

from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor, SetParametersResult
from rclpy.node import Node
from rclpy.parameter import Parameter

from vpsto_ros.configuration import allowed
from vpsto_ros.exceptions import ConfigurationError

Config = TypeVar("Config")

# Declared by rclpy itself on every node.
_FOREIGN = ("use_sim_time", "start_type_description_service")
_FOREIGN_PREFIXES = ("qos_overrides.",)
_LARGEST_INTEGER = 2**63 - 1


class _Option(NamedTuple):
    """One parameter: its dotted name, the field it comes from and the default in force."""

    name: str
    field: dataclasses.Field
    default: Any


def declare_parameters(node: Node, default: Any) -> None:
    """Declare every option of a configuration on a node, with description, unit and range.

    The node must have been created with ``automatically_declare_parameters_from_overrides=True``: that is how
    names that somebody set but that do not exist come to light.

    Args:
        node: the node that shall own the parameters.
        default: configuration (dataclass instance) with the default values.

    Raises:
        ConfigurationError: for a name that does not exist, a value of the wrong type or one out of range.
    """
    options = {option.name: option for option in _options(default)}
    present: dict[str, Any] = node.get_parameters_by_prefix("")
    overrides = {
        name: parameter.value
        for name, parameter in present.items()
        if name not in _FOREIGN and not name.startswith(_FOREIGN_PREFIXES)
    }
    for name in overrides:
        if name not in options:
            raise ConfigurationError(_unknown(node.get_name(), name, list(options)))
    for name, option in options.items():
        value = option.default
        if name in overrides:
            value = _checked(option, overrides[name])
            node.undeclare_parameter(name)
        # The override is applied and converted already; rclpy would apply the raw one (25 for 25.0) again.
        node.declare_parameter(name, _plain(value), _descriptor(option), ignore_override=True)


def read_parameters(node: Node, default: Config) -> Config:
    """The configuration that the node's parameters describe.

    Args:
        node: a node on which :func:`declare_parameters` was called with the same configuration.
        default: configuration whose structure and type to follow.

    Raises:
        ConfigurationError: when a value is refused by a check of the configuration, also one across fields.
    """
    return _build(node, default, "")


def check_change(default: Any, parameters: list[Parameter]) -> SetParametersResult:
    """Whether parameters may take new values: the answer to a request to set them."""
    options = {option.name: option for option in _options(default)}
    for parameter in parameters:
        if parameter.name in options:
            try:
                _checked(options[parameter.name], parameter.value)
            except ConfigurationError as error:
                return SetParametersResult(successful=False, reason=str(error))
    return SetParametersResult(successful=True)


def help_text(node_name: str, default: Any) -> str:
    """What ``--help`` prints: every parameter with its default, its meaning and what is allowed."""
    lines = [
        f"usage: {node_name} --ros-args [-p name:=value ...] [--params-file FILE] [-r topic:=other ...]",
        f"example: {node_name} --ros-args --params-file config/push_box.yaml -p use_sim_time:=true",
        "parameters:",
    ]
    for option in _options(default):
        described = f"{option.field.metadata['description']}; {allowed(option.field)}"
        lines.append(f"  {option.name} (default {option.default!r})\n      {described}")
    return "\n".join(lines)


def _options(config: Any, prefix: str = "") -> Iterator[_Option]:
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(value):
            yield from _options(value, f"{prefix}{field.name}.")
        elif field.metadata:
            yield _Option(prefix + field.name, field, value)


def _build(node: Node, default: Any, prefix: str) -> Any:
    changes = {}
    for field in dataclasses.fields(default):
        value = getattr(default, field.name)
        if dataclasses.is_dataclass(value):
            changes[field.name] = _build(node, value, f"{prefix}{field.name}.")
        elif field.metadata:
            option = _Option(prefix + field.name, field, value)
            changes[field.name] = _checked(option, node.get_parameter(option.name).value)
    return dataclasses.replace(default, **changes)


def _unknown(node_name: str, name: str, known: list[str]) -> str:
    leaf = {option.rsplit(".", 1)[-1]: option for option in known}
    close = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    close += [
        leaf[match] for match in difflib.get_close_matches(name.rsplit(".", 1)[-1], leaf, n=2, cutoff=0.75)
    ]
    close = list(dict.fromkeys(close))
    hint = f"did you mean {' or '.join(close)}?" if close else f"known parameters: {', '.join(sorted(known))}"
    return f"{node_name} has no parameter '{name}'; {hint}"


def _checked(option: _Option, value: Any) -> Any:
    """The value in the type of the option (an integer is taken for a float, a list for a tuple)."""
    converted = _converted(option.default, value)
    if converted is None or not _in_range(option.field.metadata, converted):
        raise ConfigurationError(
            f"parameter '{option.name}' = {_shown(value)} is not allowed; expected {allowed(option.field)}"
        )
    return converted


def _converted(default: Any, value: Any) -> Any:
    """The value in the type of the default, or None where it does not fit."""
    if isinstance(default, tuple):
        if isinstance(value, (str, bytes)) or not hasattr(value, "__len__") or len(value) != len(default):
            return None
        entries = tuple(map(_converted, default, value))
        return None if None in entries else entries
    if isinstance(default, float) and isinstance(value, (int, float)) and not isinstance(value, bool):
        return float(value)
    fits = isinstance(value, type(default)) and isinstance(value, bool) == isinstance(default, bool)
    return value if fits else None


def _in_range(meta: Any, value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_in_range(meta, entry) for entry in value)
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        low, high = meta.get("minimum"), meta.get("maximum")
        return math.isfinite(value) and (low is None or value >= low) and (high is None or value <= high)
    return not meta.get("choices") or value in meta["choices"]


def _shown(value: Any) -> str:
    if value is not None and hasattr(value, "__len__") and not isinstance(value, (str, bytes)):
        return f"{list(value)} ({len(value)} values)"
    return f"{value!r} ({type(value).__name__})"


def _plain(value: Any) -> Any:
    return list(value) if isinstance(value, tuple) else value


def _descriptor(option: _Option) -> ParameterDescriptor:
    meta = option.field.metadata
    unit = f" [{meta['unit']}]" if meta.get("unit") else ""
    descriptor = ParameterDescriptor(
        description=f"{meta['description']}{unit}", additional_constraints=allowed(option.field)
    )
    low, high = meta.get("minimum"), meta.get("maximum")
    if low is None and high is None:
        return descriptor
    if isinstance(option.default, float):
        largest = sys.float_info.max
        bounds = (-largest if low is None else float(low), largest if high is None else float(high))
        descriptor.floating_point_range = [FloatingPointRange(from_value=bounds[0], to_value=bounds[1])]
    elif isinstance(option.default, int):
        bounds = (
            -_LARGEST_INTEGER if low is None else int(low),
            _LARGEST_INTEGER if high is None else int(high),
        )
        descriptor.integer_range = [IntegerRange(from_value=bounds[0], to_value=bounds[1])]
    return descriptor
