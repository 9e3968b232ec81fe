"""What a demo makes happen while the nodes run, and how it is told."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from sim_bridge.demo.observer import Observer


class Script(Protocol):
    """Acts through the demo's own node, whenever that hears of the object; the simulation's time counts."""

    @property
    def start(self) -> float:
        """When it began [s], NaN before."""

    @property
    def end(self) -> float:
        """When it was over [s], NaN before."""

    @property
    def finished(self) -> bool:
        """Whether everything is over."""

    @property
    def progress(self) -> float:
        """Share that is over, between 0 and 1."""

    def connect(self, observer: Observer) -> None:
        """Make what it publishes and asks with."""

    def ready(self) -> bool:
        """Whether those that it speaks to listen."""

    def act(self, now: float) -> None:
        """Go on, at a simulated time [s]."""

    def asked(self) -> bool:
        """Whether the robot has been given something to do."""

    def label(self) -> str:
        """What happens now, in a few words."""

    def news(self) -> list[str]:
        """Sentences about what is over, each once."""
