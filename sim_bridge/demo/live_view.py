"""The live 3-D view of a demo in the browser."""

from __future__ import annotations

import contextlib
import webbrowser
from collections.abc import Callable, Iterator
from typing import Any

from sim_bridge.demo.observer import Observer
from sim_bridge.report.stage import Stage


@contextlib.contextmanager
def live_view(wanted: bool, stage: Stage, target: Callable[[], Any]) -> Iterator[Any]:
    """A function that brings the live view up to date with an observer.

    Args:
        wanted: whether there is to be a view.
        stage: robot, table and object.
        target: gives the place where the object is to go, or None.
    """
    if not wanted:
        yield lambda observer: None
        return
    from sim_bridge.report.view import CellView, Frame, close_server, open_server

    server = open_server()
    address = f"http://127.0.0.1:{server.get_port()}"
    print(f"live view: {address}", flush=True)
    webbrowser.open(address)
    view = CellView(server, stage)

    def show(observer: Observer) -> None:
        joints = observer.joints()
        if joints is not None:
            overlays = observer.overlays(stage.height)
            view.show(Frame(joints, observer.object_pose(), target(), overlays))

    try:
        yield show
    finally:
        close_server(server)
