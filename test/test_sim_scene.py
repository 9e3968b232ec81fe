"""The plant: friction, support, mass and rest are what was asked for."""

import mujoco
import numpy as np
import pytest

from sim_bridge.scene import ObjectPlant, Scene, build
from sim_bridge.simulation import Simulation
from vpsto_ros.contact.geometry import PlanarShape
from vpsto_ros.exceptions import ConfigurationError

SHAPES = {
    "box": PlanarShape.box(0.12, 0.09),
    "tee": PlanarShape.tee(),
    "ell": PlanarShape.ell(),
    "disc": PlanarShape.disc(0.06),
}
GRAVITY = 9.81


def settled(plant):
    scene = Scene(plant=plant)
    model = build(scene)
    data = mujoco.MjData(model)
    data.qpos[:7] = scene.joints()
    for _ in range(300):
        mujoco.mj_step1(model, data)
        data.ctrl[:] = data.qfrc_bias[:7]
        mujoco.mj_step2(model, data)
    return model, data


@pytest.mark.parametrize("support", ["corners", "spread"])
@pytest.mark.parametrize("shape", SHAPES.values(), ids=SHAPES)
def test_object_stands_on_its_feet_with_exactly_the_plant_s_friction(shape, support):
    plant = ObjectPlant(shape=shape, table_friction=0.43, mass=0.7, support=support)
    model, data = settled(plant)
    assert data.ncon == len(plant.feet())
    load = np.zeros(6)
    total = 0.0
    for i in range(data.ncon):
        assert data.contact[i].friction[0] == pytest.approx(0.43)
        mujoco.mj_contactForce(model, data, i, load)
        total += load[0]
    assert total == pytest.approx(0.7 * GRAVITY, rel=1e-3)


@pytest.mark.parametrize("support", ["corners", "spread"])
def test_centre_of_pressure_is_below_the_centre_of_mass(support):
    plant = ObjectPlant(shape=PlanarShape.box(0.12, 0.12), com_offset=(0.02, -0.01), support=support)
    model, data = settled(plant)
    load, moment, total = np.zeros(6), np.zeros(2), 0.0
    for i in range(data.ncon):
        mujoco.mj_contactForce(model, data, i, load)
        moment += load[0] * data.contact[i].pos[:2]
        total += load[0]
    np.testing.assert_allclose(moment / total - [0.5, 0.0], [0.02, -0.01], atol=2e-4)


def test_inertia_is_that_of_the_filled_shape():
    plant = ObjectPlant(shape=SHAPES["tee"], mass=0.6, com_offset=(0.01, 0.0))
    body = build(Scene(plant=plant)).body("object")
    assert body.mass[0] == pytest.approx(0.6)
    assert body.inertia.max() == pytest.approx(0.6 * SHAPES["tee"].polar_radius ** 2)
    np.testing.assert_allclose(body.ipos, [0.01, 0.0, 0.03], atol=1e-9)


def test_feet_spread_like_an_even_pressure():
    box = ObjectPlant(shape=PlanarShape.box(0.12, 0.08), support="spread").feet()
    np.testing.assert_allclose((box**2).mean(axis=0), [0.12**2 / 12, 0.08**2 / 12])
    disc = ObjectPlant(shape=PlanarShape.disc(0.06), support="spread").feet()
    np.testing.assert_allclose((disc**2).sum(axis=1).mean(), 0.06**2 / 2)


def test_corner_feet_of_a_union_are_on_its_outline():
    for name in ("tee", "ell"):
        shape = SHAPES[name]
        np.testing.assert_allclose(shape.signed_distance(ObjectPlant(shape=shape).feet()), 0.0, atol=1e-9)
    assert len(ObjectPlant(shape=SHAPES["box"]).feet()) == 4


@pytest.mark.parametrize("support", ["corners", "spread"])
def test_a_box_at_rest_does_not_creep(support):
    simulation = Simulation(Scene(plant=ObjectPlant(support=support, com_offset=(0.01, 0.005))))
    before = simulation.object_pose()
    simulation.advance(10.0)
    assert np.abs(simulation.object_pose() - before)[:2].max() < 1e-5
    assert abs(simulation.object_pose()[2] - before[2]) < 1e-4


@pytest.mark.parametrize("friction", [0.2, 0.6])
def test_the_object_slides_above_its_friction_and_only_there(friction):
    plant = ObjectPlant(table_friction=friction, mass=0.4)
    limit = friction * 0.4 * GRAVITY
    held, slid = Simulation(Scene(plant=plant)), Simulation(Scene(plant=plant))
    held.push_object((0.9 * limit, 0, 0), (0, 0, 0), 2.0)
    held.advance(2.0)
    assert held.object_pose()[0] - 0.5 < 2e-4
    slid.push_object((1.5 * limit, 0, 0), (0, 0, 0), 0.5)
    slid.advance(0.5)
    assert slid.object_pose()[0] - 0.5 == pytest.approx(0.5 * 0.5 * limit / 0.4 * 0.5**2, rel=0.02)


def test_spread_support_resists_turning_less_than_corners():
    """One torque: below what the corners resist, above what spread feet do (closer to the centre)."""
    turned = {}
    for support in ("corners", "spread"):
        simulation = Simulation(Scene(plant=ObjectPlant(support=support, table_friction=0.4, mass=0.5)))
        simulation.push_object((0, 0, 0), (0, 0, 0.4 * 0.5 * GRAVITY * 0.072), 0.3)
        simulation.advance(0.3)
        turned[support] = simulation.object_pose()[2]
    assert turned["corners"] < 0.01
    assert turned["spread"] > 0.05


def test_shapes_are_compiled_as_their_primitives():
    model = build(Scene(plant=ObjectPlant(shape=SHAPES["tee"])))
    sizes = {tuple(np.round(model.geom(f"object{i}").size, 6)) for i in range(2)}
    assert sizes == {tuple(np.round([*p.half_size, 0.03], 6)) for p in SHAPES["tee"].primitives}
    assert (
        build(Scene(plant=ObjectPlant(shape=SHAPES["disc"]))).geom("object0").type[0]
        == mujoco.mjtGeom.mjGEOM_CYLINDER
    )


def test_rod_friction_is_exact_and_may_be_zero():
    rod = {f: build(Scene(plant=ObjectPlant(tool_friction=f))) for f in (0.0, 0.37)}
    pairs = {f: [i for i in range(m.npair) if m.pair_geom1[i] == m.geom("rod").id] for f, m in rod.items()}
    assert rod[0.0].pair_dim[pairs[0.0][0]] == 1
    assert rod[0.37].pair_dim[pairs[0.37][0]] == 3
    np.testing.assert_allclose(rod[0.37].pair_friction[pairs[0.37][0], :2], 0.37)


def test_what_videos_need_is_there():
    model = build(Scene())
    for camera in ("overview", "side", "top"):
        assert model.camera(camera).id >= 0
    assert model.vis.quality.offsamples == 0
    assert model.vis.quality.shadowsize == 1024
    assert model.nlight > 0


def test_joint_friction_scales():
    assert np.all(build(Scene(joint_friction=0.0, joint_damping=0.0)).dof_frictionloss == 0.0)
    twice, once = build(Scene(joint_friction=2.0)), build(Scene())
    np.testing.assert_allclose(twice.dof_frictionloss, 2.0 * once.dof_frictionloss)
    assert 0.1 <= once.dof_frictionloss[:7].min() <= once.dof_frictionloss.max() <= 0.3


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ObjectPlant(mass=-1.0), "mass"),
        (lambda: ObjectPlant(support="legs"), "'corners', 'spread'"),
        (lambda: ObjectPlant(com_offset=(0.08, 0.0)), "tip over"),
        (lambda: Scene(joint_friction=-1.0), "joint_friction"),
        (lambda: Scene(start_tool=(0.9, 0.0)).joints(), "out of reach"),
        (lambda: Scene(start_joints=(0.0,) * 7).joints(), "joint limits"),
    ],
)
def test_misuse_is_named(make, message):
    with pytest.raises(ConfigurationError, match=message):
        make()
