"""A video of a run, drawn by MuJoCo without a display, in a process of its own."""

from __future__ import annotations

import concurrent.futures
import multiprocessing
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sim_bridge.report.stage import CAMERA, Stage
from sim_bridge.report.view import Frame, ModelState

WIDTH, HEIGHT = 960, 540
LINE_WIDTH = 3.0
"""Of what the nodes draw [pixels]."""
TEXT_HEIGHT = 26
"""Of a line of text [pixels]."""
REMEDY = "apt install libegl1 libgl1 (or libosmesa6, and set MUJOCO_GL=osmesa)"


def write_video(path: Path, stage: Stage, frames: Sequence[Frame], rate: float, camera: str = CAMERA) -> str:
    """Render frames into an mp4 file.

    OpenGL is chosen when MuJoCo is imported and may end a process that has no driver for it, hence a process
    of its own.

    Args:
        path: file to write.
        stage: robot, table and object.
        frames: what is seen.
        rate: frames per second.
        camera: name of the model's camera.

    Returns:
        An empty string, or why there is no video and how to get one.
    """
    before = os.environ.get("MUJOCO_GL")
    os.environ.setdefault("MUJOCO_GL", "egl")
    context = multiprocessing.get_context("spawn")
    try:
        with concurrent.futures.ProcessPoolExecutor(1, mp_context=context) as pool:
            pool.submit(_render, path, stage, list(frames), rate, camera).result()
    except (
        Exception
    ) as error:  # whatever a missing driver raises: AttributeError, ImportError, FatalError, a dead process
        path.unlink(missing_ok=True)
        reason = str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
        return f"no video: OpenGL is not available ({reason}); to get it: {REMEDY}"
    finally:
        if before is None:
            del os.environ["MUJOCO_GL"]
    return ""


def _render(path: Path, stage: Stage, frames: list[Frame], rate: float, camera: str) -> None:
    import imageio
    import mujoco

    state = ModelState(stage)
    model = state.model
    options: dict[str, Any] = {
        "codec": "libx264",
        "quality": 7,
        "macro_block_size": 2,
        "ffmpeg_log_level": "error",
    }
    movie: Any = imageio.get_writer(path, fps=rate, **options)
    with mujoco.Renderer(model, HEIGHT, WIDTH) as renderer, movie as writer:
        renderer.scene.flags[mujoco.mjtRndFlag.mjRND_SHADOW] = False
        for frame in frames:
            state.pose(frame)
            # Cameras and lights are not part of mj_kinematics.
            mujoco.mj_camlight(model, state.data)
            renderer.update_scene(state.data, camera)
            _draw_overlays(renderer.scene, frame)
            writer.append_data(_with_texts(renderer.render(), frame))


def _draw_overlays(scene: Any, frame: Frame) -> None:
    """Lines, which are cheap to draw, and small spheres."""
    import mujoco
    import numpy as np

    still, level = np.zeros(3), np.eye(3).ravel()
    for overlay in frame.overlays:
        rgba = np.array([*overlay.colour, 1.0], dtype=np.float32)
        size = np.full(3, 0.5 * overlay.width)
        for item in () if overlay.text else overlay.points:
            if scene.ngeom >= scene.maxgeom:
                return
            geom = scene.geoms[scene.ngeom]
            if overlay.lines:
                mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_LINE, still, still, level, rgba)
                mujoco.mjv_connector(geom, mujoco.mjtGeom.mjGEOM_LINE, LINE_WIDTH, *item)
            else:
                mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, size, item, level, rgba)
            scene.ngeom += 1


def _with_texts(picture: Any, frame: Frame) -> Any:
    """The picture (height, width, 3) with what nodes wrote at its foot."""
    import numpy as np
    from PIL import Image, ImageDraw, ImageFont

    lines = [overlay.text for overlay in frame.overlays if overlay.text]
    if not lines:
        return picture
    image = Image.fromarray(picture)
    place, font = (16, HEIGHT - 16 - TEXT_HEIGHT * len(lines)), ImageFont.load_default(TEXT_HEIGHT - 4)
    ImageDraw.Draw(image).multiline_text(place, "\n".join(lines), fill=(20, 24, 32), font=font)
    return np.asarray(image)
