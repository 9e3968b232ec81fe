"""Configuration as frozen dataclasses whose fields know their meaning, unit and range.

A field is declared with :func:`option`; :func:`validate`, called from ``__post_init__``, refuses what is out
of range. The ROS nodes declare their parameters from the same fields, so that a description and a range are
written down once.
"""

import dataclasses
import math
from typing import Any, TypeVar

from vpsto_ros.exceptions import ConfigurationError

Config = TypeVar("Config")


def option(
    default: Any,
    description: str,
    *,
    unit: str = "",
    minimum: float | None = None,
    maximum: float | None = None,
    choices: tuple[str, ...] | None = None,
) -> Any:
    """A dataclass field that carries its description, unit and allowed values.

    Args:
        default: default value; its type is the type that is accepted (int, float, bool, str or a tuple of one
            of them).
        description: one line that says what the option does.
        unit: physical unit, empty if there is none.
        minimum: smallest allowed number (also for every entry of a tuple), inclusive.
        maximum: largest allowed number, inclusive.
        choices: allowed strings.
    """
    metadata = {
        "description": description,
        "unit": unit,
        "minimum": minimum,
        "maximum": maximum,
        "choices": choices,
    }
    return dataclasses.field(default=default, metadata=metadata)


def documented(config: type[Config]) -> type[Config]:
    """Class decorator: add what every option means, its default and its range to the docstring."""
    lines = ["    Options:"]
    for field in dataclasses.fields(config):  # type: ignore[arg-type]
        if field.metadata:
            description, limits = field.metadata["description"], allowed(field)
            lines.append(f"        {field.name}: {description} ({field.default!r}; {limits}).")
    config.__doc__ = "\n\n".join([(config.__doc__ or "").rstrip(), "\n".join(lines)])
    return config


def allowed(field: dataclasses.Field) -> str:
    """What a field accepts, in words, for error messages and parameter descriptors."""
    meta = field.metadata
    kind = type(field.default).__name__
    if isinstance(field.default, tuple):
        kind = f"{len(field.default)} numbers"
    if meta.get("choices"):
        return "one of " + ", ".join(repr(choice) for choice in meta["choices"])
    low, high, unit = meta.get("minimum"), meta.get("maximum"), meta.get("unit") or ""
    if low is None and high is None:
        return " ".join(part for part in (kind, unit and f"in {unit}") if part)
    bounds = f"{'-inf' if low is None else low:} to {'inf' if high is None else high:}"
    return " ".join(part for part in (kind, f"from {bounds}", unit) if part)


def validate(config: Any) -> None:
    """Check every field of a configuration made with :func:`option`.

    Raises:
        ConfigurationError: naming the field, its value and what is allowed.
    """
    for field in dataclasses.fields(config):
        if field.metadata:
            _validate_field(type(config).__name__, field, getattr(config, field.name))


def _validate_field(owner: str, field: dataclasses.Field, value: Any) -> None:
    if not _type_fits(field.default, value) or not _value_fits(field.metadata, value):
        raise ConfigurationError(
            f"{owner}.{field.name} = {value!r} is not allowed; expected {allowed(field)}"
        )


def _type_fits(default: Any, value: Any) -> bool:
    if isinstance(default, tuple):
        if not isinstance(value, tuple) or len(value) != len(default):
            return False
        return all(map(_type_fits, default, value))
    if isinstance(default, bool):
        return isinstance(value, bool)
    if isinstance(default, float):
        return isinstance(value, (int, float)) and not isinstance(value, bool)
    if isinstance(default, int):
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, type(default))


def _value_fits(meta: Any, value: Any) -> bool:
    if isinstance(value, tuple):
        return all(_value_fits(meta, entry) for entry in value)
    if isinstance(value, bool):
        return True
    if isinstance(value, (int, float)):
        low, high = meta.get("minimum"), meta.get("maximum")
        return math.isfinite(value) and (low is None or value >= low) and (high is None or value <= high)
    return not meta.get("choices") or value in meta["choices"]
