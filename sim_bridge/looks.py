"""How a scene looks: table, floor, light, cameras and rendering quality. Nothing here touches the physics."""

import math

import mujoco
import numpy as np

_TABLE_COLOUR = (0.86, 0.81, 0.74, 1.0)
_LEG_COLOUR = (0.35, 0.36, 0.38, 1.0)
_FLOOR_COLOUR = (0.72, 0.75, 0.78, 1.0)


def add_looks(spec: mujoco.MjSpec) -> None:
    """Add furniture, light and the cameras ``overview``, ``side`` and ``top``; the table is at z = 0."""
    set_quality(spec, (0.4, 0.0, 0.25), 1.2)
    add_light(spec)
    _add_furniture(spec)
    world = spec.worldbody
    add_camera(world, "overview", eye=(1.50, -1.00, 0.95), target=(0.34, 0.0, 0.24), fovy=40.0)
    add_camera(world, "side", eye=(0.45, -1.75, 0.45), target=(0.35, 0.0, 0.30), fovy=38.0)
    half = math.sqrt(0.5)
    world.add_camera(name="top", pos=[0.45, 0.0, 1.75], quat=[half, 0, 0, -half], fovy=40.0)


def set_quality(spec: mujoco.MjSpec, center: tuple[float, float, float], extent: float) -> None:
    """Good pictures of what is around a point [m], at most an extent [m] away, without a graphics card."""
    # Large shadow maps and multisampling cut the frame rate of software rendering to a tenth.
    visual = spec.visual
    visual.quality.shadowsize = 1024
    visual.quality.offsamples = 0
    getattr(visual, "global").offwidth = 1920
    getattr(visual, "global").offheight = 1080
    spec.stat.center = list(center)
    spec.stat.extent = extent


def add_light(spec: mujoco.MjSpec) -> None:
    """Two lamps, and a sky."""
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = [0.34, 0.34, 0.36], [0.16] * 3, [0.1] * 3
    lamps = (([0.9, -0.9, 1.9], [-0.5, 0.6, -1.0], 0.48), ([-0.3, 1.2, 1.6], [0.7, -0.9, -0.8], 0.22))
    for pos, direction, strength in lamps:
        spec.worldbody.add_light(
            pos=pos,
            dir=direction,
            diffuse=[strength] * 3,
            specular=[0.12] * 3,
            castshadow=False,
            type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        )
    spec.add_texture(
        name="sky",
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.95, 0.97],
        rgb2=[0.62, 0.68, 0.75],
        width=256,
        height=256,
    )


def _add_furniture(spec: mujoco.MjSpec) -> None:
    world = spec.worldbody
    spec.add_material(name="table", rgba=_TABLE_COLOUR, specular=0.15, shininess=0.2)
    # Half a millimetre below the plane that collides, so that feet and marker are never drawn inside it.
    _decorate(world, [0.42, 0.0, -0.0205], [0.72, 0.75, 0.02], material="table")
    for x in (-0.24, 1.08):
        for y in (-0.69, 0.69):
            _decorate(world, [x, y, -0.395], [0.03, 0.03, 0.355], rgba=_LEG_COLOUR)
    _decorate(world, [0.42, 0.0, -0.77], [4.0, 4.0, 0.01], rgba=_FLOOR_COLOUR)


def add_camera(world, name: str, eye, target, fovy: float) -> None:
    """A camera at eye that looks at target, upright; MuJoCo's cameras look along their negative z axis."""
    backward = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
    right = np.cross([0.0, 0.0, 1.0], backward)
    right /= np.linalg.norm(right)
    frame = np.column_stack([right, np.cross(backward, right), backward])
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, frame.ravel())
    world.add_camera(name=name, pos=eye, quat=quat, fovy=fovy)


def _decorate(body, pos, size, **looks) -> None:
    """A box that is only seen."""
    kind = mujoco.mjtGeom.mjGEOM_BOX
    body.add_geom(type=kind, pos=pos, size=size, group=2, contype=0, conaffinity=0, mass=0.0, **looks)
