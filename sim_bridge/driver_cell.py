"""What the simulated driver asks of a world: its own topics and services, reports, drawings."""

from typing import Any, Protocol

from visualization_msgs.msg import MarkerArray

from sim_bridge.arm_world import ArmWorld


class DriverCell(Protocol):
    """One kind of world behind the driver; everything but the answers of services happens between slices."""

    @property
    def world(self) -> ArmWorld:
        """What is stepped."""

    @property
    def hardware(self) -> str:
        """What it stands for, in the diagnostics."""

    def before_slice(self, duration: float) -> None:
        """Let act what acts in the next slice [s]."""

    def after_slice(self) -> None:
        """Say what happened in the last slice."""

    def publish_reports(self) -> None:
        """Publish what only this world has to report."""

    def markers(self) -> MarkerArray:
        """What there is to see."""

    def figures(self) -> dict[str, Any]:
        """What the diagnostics show besides time, limits and torques."""

    def trouble(self) -> str:
        """What is an error beyond broken limits, empty if nothing is."""

    def reset(self) -> str:
        """Put everything back; says in words where it is."""
