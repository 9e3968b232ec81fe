"""Who touches whom: forces of the tools on the object, and contacts that the robot should not have."""

from dataclasses import dataclass

import mujoco
import numpy as np
from numba import njit
from numpy.typing import NDArray

from sim_bridge.robots import RobotKind

# What a geom belongs to; 0 is of no interest.
_TABLE, _OBJECT, _CUBE, _LINK, _TOOL = 1, 2, 3, 4, 5


@dataclass(frozen=True)
class RobotContacts:
    """Steps during which the robot touched what it should not.

    Attributes:
        arms: two arms, or an arm and itself.
        table: an arm or a tool and the table.
        object: an arm and the object, other than by its tool.
    """

    arms: int
    table: int
    object: int

    @property
    def any(self) -> bool:
        """Whether there was any."""
        return bool(self.arms or self.table or self.object)


class Contacts:
    """Reads MuJoCo's contacts of one model."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, kind: RobotKind):
        """Sort the geoms."""
        self._model, self._data = model, data
        self._tools = [model.geom(arm.tool).id for arm in kind.arms]
        self._kinds = np.array([_kind(model, geom, self._tools) for geom in range(model.ngeom)])
        self._counts = np.zeros(3, dtype=np.int64)

    def count(self) -> None:
        """Take in the contacts of this step."""
        _count(self._data.contact.geom, self._kinds, self._counts)

    def counts(self) -> RobotContacts:
        """Steps with contacts that should not be, so far."""
        return RobotContacts(*self._counts.tolist())

    def tool_force(self, tool: int) -> NDArray[np.float64]:
        """Force of one tool on the object during the last step [N], base frame, shape (3,)."""
        total, wrench, geom = np.zeros(3), np.zeros(6), self._tools[tool]
        for index in range(self._data.ncon):
            contact = self._data.contact[index]
            pair = (contact.geom1, contact.geom2)
            if geom in pair and any(self._kinds[g] == _OBJECT for g in pair):
                mujoco.mj_contactForce(self._model, self._data, index, wrench)
                # The frame's first axis points from geom 1 to geom 2.
                sign = 1.0 if contact.geom1 == geom else -1.0
                total += sign * (contact.frame.reshape(3, 3).T @ wrench[:3])
        return total


def _kind(model: mujoco.MjModel, geom: int, tools: list[int]) -> int:
    if geom in tools:
        return _TOOL
    if model.geom(geom).name == "table":
        return _TABLE
    body = model.body(model.body_rootid[model.geom_bodyid[geom]]).name
    kinds = {"object": _OBJECT, "fr3_root": _LINK}
    return kinds.get(body, _CUBE if body.startswith("cube") else 0)


@njit(cache=True, nogil=True)
def _count(pairs, kinds, counts):
    """Raise counts (3,) of arms, table and object by one for each that some contact is of."""
    arms, table, thing = 0, 0, 0
    for k in range(pairs.shape[0]):
        a, b = kinds[pairs[k, 0]], kinds[pairs[k, 1]]
        if a > b:
            a, b = b, a
        if a >= _LINK:
            arms = 1
        elif b >= _LINK and a == _TABLE:
            table = 1
        elif b == _LINK and a == _OBJECT:
            thing = 1
    counts[0] += arms
    counts[1] += table
    counts[2] += thing
