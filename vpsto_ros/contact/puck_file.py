"""The file of a puck model: readable JSON."""

import dataclasses
import json
import pathlib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from vpsto_ros.contact.hockey_table import HockeyTable
from vpsto_ros.contact.linear_gaussian import LinearGaussian
from vpsto_ros.exceptions import ConfigurationError, InvalidInputError

if TYPE_CHECKING:
    from vpsto_ros.contact.puck import PuckModel

FORMAT = "vpsto_ros puck model 2"
_MODES = ("floating", "wall", "mallet")


def write(model: "PuckModel", path: str | pathlib.Path, origin: Mapping[str, Any]) -> None:
    """Write a model and where it comes from."""
    content: dict[str, Any] = {
        "format": FORMAT, "origin": dict(origin), "period": model.period, "hit_delay": model.hit_delay,
        "table": dataclasses.asdict(model.table), **{name: getattr(model, name).as_dict() for name in _MODES},
    }  # fmt: skip
    if model.lively is not None:
        content |= {"lively_share": model.lively_share, "lively": model.lively.as_dict()}
    pathlib.Path(path).write_text(json.dumps(content, indent=1) + "\n")


def read(path: str | pathlib.Path) -> dict[str, Any]:
    """The arguments of the model in a file.

    Raises:
        ConfigurationError: there is no such file, it is of another format, or its numbers are no model.
    """
    try:
        content = json.loads(pathlib.Path(path).read_text())
    except FileNotFoundError:
        raise ConfigurationError(
            f"there is no puck model {path}; `vpsto learn puck_model` makes one"
        ) from None
    except (OSError, UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ConfigurationError(f"{path} is not a puck model: {error}") from None
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ConfigurationError(
            f"{path} is not of the format '{FORMAT}'; `vpsto learn puck_model` makes one that is"
        )
    try:
        names = (*_MODES, "lively") if "lively" in content else _MODES
        numbers = {
            "period": float(content["period"]), "hit_delay": float(content.get("hit_delay", 0.0)),
            "lively_share": float(content.get("lively_share", 0.0)),
        }  # fmt: skip
        modes = {name: LinearGaussian(**content[name]) for name in names}
        return {"table": HockeyTable(**content["table"]), **numbers, **modes}
    except (KeyError, TypeError, ValueError, InvalidInputError, ConfigurationError) as error:
        raise ConfigurationError(f"{path} is not a puck model: {error}") from None
