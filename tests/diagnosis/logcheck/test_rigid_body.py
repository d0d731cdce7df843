"""The regressor of inverse dynamics against MuJoCo's own, on a tree with every kind of joint."""

import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.logcheck import rigid_body

TREE = """<mujoco><option gravity="1 2 -9"/><worldbody><body pos="0 0 1"><freejoint/>
  <geom size=".1 .05 .03" type="box" pos=".1 0 0"/>
  <body pos=".2 0 0" euler="10 20 30"><joint type="ball"/>
    <geom size=".1 .05" type="capsule" euler="20 0 0" pos="0 .1 .1"/>
    <body pos=".1 0 0" euler="0 40 0"><geom size=".05"/>
      <body pos=".1 .1 0"><joint type="slide" axis="1 1 0"/>
        <geom size=".05 .02 .04" type="box" pos=".01 .02 .03"/></body>
      <body pos="0 .1 0"><joint axis="0 1 1" armature=".1"/><geom size=".03" pos=".1 0 0"/></body>
</body></body></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def moved():
    model = mujoco.MjModel.from_xml_string(TREE)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    rng, rows = np.random.default_rng(0), 20
    qpos = np.tile(model.qpos0, (rows, 1))
    for row in qpos:
        mujoco.mj_integratePos(model, row, rng.normal(size=model.nv), 1.0)
    return model, (qpos, rng.normal(size=(rows, model.nv)), rng.normal(size=(rows, model.nv)))


def test_columns_times_parameters_are_the_inverse_dynamics(moved):
    model, motion = moved
    found, data, own = rigid_body.rigid(model, *motion), mujoco.MjData(model), rigid_body.nominal(model)
    assert found.nominal == pytest.approx(found.columns @ own.ravel(), abs=1e-9)
    assert found.nominal == pytest.approx(rigid_body.recursive(model, *motion), abs=1e-9)
    for k, (qpos, qvel, qacc) in enumerate(zip(*motion, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos, qvel, qacc
        mujoco.mj_inverse(model, data)
        assert found.nominal[k] == pytest.approx(data.qfrc_inverse - model.dof_armature * qacc, abs=1e-9)


def test_sets_of_parameters_are_columns_of_their_own_and_long_motions_are_made_in_blocks(moved):
    model, motion = moved
    own = rigid_body.nominal(model)
    sets = np.eye(len(own))[:, :, None] * own
    whole = rigid_body.rigid(model, *motion, sets)
    assert whole.columns.sum(-1) == pytest.approx(whole.nominal, abs=1e-9)
    first = rigid_body.rigid(model, *(x[:1] for x in motion), sets)
    for name, x in vars(first).items():
        assert x == pytest.approx(getattr(whole, name)[:1], abs=1e-12)


def test_gravity_alone_is_what_rest_asks_for(moved):
    model, motion = moved
    frames = rigid_body.Frames.of(model, motion[0], *np.zeros_like(motion[1:]))
    assert frames.weight(model.opt.gravity) == pytest.approx(frames.columns(), abs=1e-12)


def test_what_the_model_compensates_needs_no_drive(moved):
    model, motion = mujoco.MjModel.from_xml_string(TREE.replace("<body ", '<body gravcomp=".7" ')), moved[1]
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    found, data = rigid_body.rigid(model, *motion), mujoco.MjData(model)
    assert found.nominal == pytest.approx(found.columns @ rigid_body.nominal(model).ravel(), abs=1e-9)
    assert found.nominal == pytest.approx(rigid_body.recursive(model, *motion), abs=1e-9)
    for k, (qpos, qvel, qacc) in enumerate(zip(*motion, strict=True)):
        data.qpos[:], data.qvel[:], data.qacc[:] = qpos, qvel, qacc
        mujoco.mj_inverse(model, data)
        assert found.nominal[k] == pytest.approx(data.qfrc_inverse - model.dof_armature * qacc, abs=1e-9)


def test_a_point_mass_is_its_own_parameters():
    place = np.array([0.1, -0.2, 0.3])
    found = rigid_body.inertial(2.0, place, np.zeros((3, 3)))
    assert found[:4] == pytest.approx([2.0, 0.2, -0.4, 0.6])
    assert found[4:] == pytest.approx([2 * 0.13, 2 * 0.1, 2 * 0.05, 2 * 0.02, -2 * 0.03, 2 * 0.06])
