"""The robot cell in three dimensions in a browser: live from a server, or as a replay inside an HTML file."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim_bridge.report.overlay import Overlay
from sim_bridge.report.stage import Stage

FloatArray = NDArray[np.float64]

# Geometry groups that are drawn; the higher ones hold what only collides.
VISIBLE_GROUPS = range(3)
BACKGROUND = "/background"


@dataclass(frozen=True)
class Frame:
    """What is seen at one instant.

    Attributes:
        joints: joint positions (n,) [rad].
        object_pose: x, y [m] and yaw [rad] of the object, (3,); None leaves it where it is.
        target: x, y [m] of the target (2,), hidden when None or not finite.
        overlays: what the nodes draw.
    """

    joints: FloatArray
    object_pose: FloatArray | None = None
    target: FloatArray | None = None
    overlays: tuple[Overlay, ...] = ()


class ModelState:
    """The cell's model, posed for drawing; used by the browser's views and by the video alike."""

    def __init__(self, stage: Stage) -> None:
        """Build the model and look up the robot's joints."""
        self._stage, self.model = stage, stage.build()
        self.data = mujoco.MjData(self.model)
        self._joints = [self.model.joint(name).qposadr[0] for name in stage.joint_names]

    def pose(self, frame: Frame) -> None:
        """Put everything where it is in a frame and update the poses of all bodies."""
        self.data.qpos[self._joints] = frame.joints
        self._stage.place(self.model, self.data, frame)
        mujoco.mj_kinematics(self.model, self.data)


class CellView:
    """Draws the cell with viser and moves it."""

    def __init__(self, server: Any, stage: Stage) -> None:
        """Build the scene.

        Args:
            server: a running ``viser.ViserServer``.
            stage: robot, table and object.
        """
        self._server = server
        self._state = ModelState(stage)
        scene, model, view = server.scene, self._state.model, stage.viewpoint
        scene.set_up_direction("+z")
        scene.configure_environment_map(None)
        scene.configure_default_lights(enabled=True, cast_shadow=False)
        scene.add_light_ambient("/light", intensity=0.9)
        camera = server.initial_camera
        camera.position, camera.look_at, camera.up = view.eye, view.target, (0.0, 0.0, 1.0)
        camera.fov = view.field
        mujoco.mj_kinematics(model, self._state.data)
        self._bodies = {body: self._add_body(body) for body in range(model.nbody)}
        self._overlays: dict[str, Any] = {}
        self._drawn: dict[str, Overlay] = {}

    def _add_body(self, body: int) -> Any:
        """A frame with one mesh per colour below it."""
        model, data = self._state.model, self._state.data
        path = f"/{model.body(body).name}" if body else BACKGROUND
        frame = self._server.scene.add_frame(
            path, show_axes=False, position=data.xpos[body], wxyz=data.xquat[body]
        )
        for number, ((red, green, blue, alpha), mesh) in enumerate(_meshes(model, body).items()):
            self._server.scene.add_mesh_simple(
                f"{path}/{number}", mesh.vertices, mesh.faces, color=(red, green, blue),
                opacity=None if alpha == 255 else alpha / 255,
            )  # fmt: skip
        return frame

    def show(self, frame: Frame) -> None:
        """Move everything to where it is in a frame."""
        self._state.pose(frame)
        data = self._state.data
        with self._server.atomic():
            for body, handle in self._bodies.items():
                _move(handle, data.xpos[body], data.xquat[body])
            self._show_overlays({overlay.name: overlay for overlay in frame.overlays})

    def _show_overlays(self, wanted: dict[str, Overlay]) -> None:
        """Draw what is new, hide what is gone; what stays the same is not sent again."""
        for name in self._overlays:
            if (name in wanted) != self._overlays[name].visible:
                self._overlays[name].visible = name in wanted
        for name, overlay in wanted.items():
            if overlay is self._drawn.get(name):
                continue
            self._drawn[name] = overlay
            if name in self._overlays and overlay.text:
                self._overlays[name].text = overlay.text
            elif name in self._overlays:
                self._overlays[name].points = overlay.points
            else:
                self._overlays[name] = self._add_overlay(overlay)

    def _add_overlay(self, overlay: Overlay) -> Any:
        scene, path = self._server.scene, f"/overlay/{overlay.name}"
        colour = tuple(round(255 * value) for value in overlay.colour)
        if overlay.text:
            return scene.add_label(path, overlay.text, position=tuple(overlay.points[0]))
        if overlay.lines:
            return scene.add_line_segments(path, overlay.points, colour, thickness=overlay.width)
        return scene.add_point_cloud(
            path, overlay.points, colour, point_size=overlay.width, point_shape="circle", precision="float32"
        )


def open_server(port: int = 0) -> Any:
    """A viser server on 127.0.0.1 without its greeting.

    Args:
        port: where it listens; 0 chooses a free port.
    """
    import viser

    # It prints a banner whatever `verbose` says.
    with contextlib.redirect_stdout(io.StringIO()):
        return viser.ViserServer(host="127.0.0.1", port=port, verbose=False)


def close_server(server: Any) -> None:
    """Stop a server without its farewell."""
    with contextlib.redirect_stdout(io.StringIO()):
        server.stop()


def replay_page(stage: Stage, frames: Iterable[Frame], rate: float) -> str:
    """A self-contained HTML page that plays a run and lets one look at it from all sides.

    Args:
        stage: robot, table and object.
        frames: at least one.
        rate: frames per second.
    """
    server = open_server()
    try:
        view = CellView(server, stage)
        iterator = iter(frames)
        view.show(next(iterator))
        serializer = server.get_scene_serializer()
        for frame in iterator:
            serializer.insert_sleep(1.0 / rate)
            view.show(frame)
        return serializer.as_html()
    finally:
        close_server(server)


def _move(handle: Any, position: FloatArray, wxyz: FloatArray) -> None:
    """Set a pose, but only where it changed: a replay stores every assignment."""
    if not np.allclose(handle.position, position, atol=1e-5):
        handle.position = position
    if not np.allclose(handle.wxyz, wxyz, atol=1e-5):
        handle.wxyz = wxyz


def _meshes(model: mujoco.MjModel, body: int) -> dict[tuple[int, int, int, int], Any]:
    """The visible geometry of a body in the body's frame, joined by colour (red, green, blue, alpha)."""
    import trimesh

    parts: dict[tuple[int, int, int, int], list[Any]] = {}
    first, number = model.body_geomadr[body], model.body_geomnum[body]
    for geom in range(first, first + number):
        mesh = _primitive(model, geom) if model.geom_group[geom] in VISIBLE_GROUPS else None
        if mesh is not None:
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, model.geom_quat[geom])
            transform = np.eye(4)
            transform[:3, :3], transform[:3, 3] = rotation.reshape(3, 3), model.geom_pos[geom]
            mesh.apply_transform(transform)
            # Vertices are split along sharp edges, else the ends of a cylinder look rounded.
            parts.setdefault(_color(model, geom), []).append(trimesh.graph.smooth_shade(mesh, angle=0.6))
    return {color: trimesh.util.concatenate(meshes) for color, meshes in parts.items()}


def _primitive(model: mujoco.MjModel, geom: int) -> Any:
    from trimesh import creation

    kind, size = model.geom_type[geom], model.geom_size[geom]
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return creation.box(extents=2.0 * size)
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        return creation.cylinder(radius=size[0], height=2.0 * size[1], sections=40)
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        mesh = creation.capsule(height=2.0 * size[1], radius=size[0], count=(16, 32))
        mesh.apply_translation((0.0, 0.0, -mesh.bounds.mean(axis=0)[2]))
        return mesh
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return creation.icosphere(subdivisions=3, radius=size[0])
    return None


def _color(model: mujoco.MjModel, geom: int) -> tuple[int, int, int, int]:
    material = model.geom_matid[geom]
    rgba = model.geom_rgba[geom] if material < 0 else model.mat_rgba[material]
    red, green, blue, alpha = (round(255 * float(value)) for value in rgba)
    return red, green, blue, alpha
