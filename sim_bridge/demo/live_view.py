"""The live 3-D view of a demo in the browser."""

from __future__ import annotations

import contextlib
import webbrowser
from collections.abc import Iterator
from typing import Any

from sim_bridge.demo.observer import Observer
from sim_bridge.demo.settings import Settings


@contextlib.contextmanager
def live_view(wanted: bool, settings: Settings) -> Iterator[Any]:
    """A function that brings the live view up to date with an observer."""
    if not wanted:
        yield lambda observer: None
        return
    from sim_bridge.report.view import CellView, Frame, close_server, open_server
    from sim_bridge.scene import build

    server = open_server()
    address = f"http://127.0.0.1:{server.get_port()}"
    print(f"live view: {address}", flush=True)
    webbrowser.open(address)
    scene = settings.scene
    view, height = CellView(server, build(scene), settings.tools.robot.joint_names), scene.plant.height

    def show(observer: Observer) -> None:
        joints = observer.joints()
        if joints is not None:
            overlays = observer.overlays(height)
            view.show(Frame(joints, observer.object_pose(), observer.goal(), overlays))

    try:
        yield show
    finally:
        close_server(server)
