"""Effort that arrives at a neighbouring joint: who the neighbours are, and the motion of MuJoCo C."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.effects.effort_coupling import neighbours
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics, control_step

CHAIN = """<mujoco><option timestep=".002" integrator="{integrator}"/>
<default><geom type="capsule" size=".04" mass="1" contype="0" conaffinity="0"/></default>
<worldbody><body><joint name="rail" type="slide" axis="1 0 0" damping="2"/><geom type="sphere"/>
<body pos="0 0 -.1"><joint name="swing" axis="0 1 0" damping=".1"/><geom fromto="0 0 0 0 0 -.4"/>
<body pos="0 0 -.4"><joint name="wrist" axis="0 1 0" damping=".05" actuatorfrcrange="-.5 .5"/>
<geom fromto="0 0 0 .1 0 -.2"/></body></body></body></worldbody>
<actuator><motor name="a" joint="rail"/><motor name="b" joint="swing" gear="2"/><motor name="c" joint="wrist"/>
</actuator></mujoco>"""
TREE = """<mujoco><worldbody><body><freejoint/><geom size=".1"/>
<body><joint name="hip"/><joint name="yaw" axis="0 1 0"/><geom size=".1"/>
<body><geom size=".1"/><body><joint name="knee"/><geom size=".1"/></body></body>
<body><joint name="tail"/><geom size=".1"/></body></body>
<body><joint name="ball" type="ball"/><geom size=".1"/><body><joint name="end"/><geom size=".1"/></body></body>
</body></worldbody></mujoco>"""
SHARES = [[0.3, 0.9], [-0.2, 0.25], [0.4, -0.6]]  # to_next, to_previous of a, b, c; nothing is before a or behind c


def test_neighbours_are_the_nearest_single_joints_of_the_chain():
    model = mujoco.MjModel.from_xml_string(TREE)
    column = {model.joint(j).name: int(model.jnt_dofadr[j]) for j in range(1, model.njnt)}
    found = neighbours(model)
    assert found.shape == (model.nv, 2)
    expected = {"hip": ("yaw", ""), "yaw": ("knee", "hip"), "knee": ("", "yaw"), "tail": ("", "yaw"), "end": ("", "")}
    for name, near in expected.items():
        assert [*found[column[name]]] == [column.get(n, -1) for n in near], name
    assert (found[: column["hip"]] == -1).all()  # of the free joint


START = np.array([0.1, 0.4, -0.3], np.float32)


def by_mujoco(model, commands, coupled):
    """qpos `[rows, nv]`; coupled(data): the forces `[nv]` that arrive, from what acts at the sub-step's beginning."""
    data, rows = mujoco.MjData(model), []
    data.qpos[:] = START
    for row in commands:
        for _ in range(5):
            data.ctrl[:], data.qfrc_applied[:] = row, 0
            mujoco.mj_forward(model, data)
            data.qfrc_applied[:] = coupled(data)
            mujoco.mj_step(model, data)
        rows.append(data.qpos.copy())
    return np.array(rows)


def by_the_effect(model, commands, where, *values):
    physics = Physics(model, 0.01, ParameterSpace(), [make("effort_coupling", where=where)])

    @jax.jit
    def moved(theta):
        def step(world, row):
            world, _ = control_step(physics, world, row)
            return world, world.measurement["qpos"]

        return jax.lax.scan(step, physics.world(theta, jnp.asarray(START), jnp.zeros(3)), commands)[1]

    return [np.asarray(moved(jnp.asarray(v, jnp.float32).ravel())) for v in values]


@pytest.mark.parametrize("integrator", ["implicitfast", "Euler"])
def test_moves_as_mujoco_does_with_the_same_shares_applied(integrator):
    model = mujoco.MjModel.from_xml_string(CHAIN.format(integrator=integrator))
    commands = np.random.default_rng(0).uniform(-1, 1, (60, 3)).astype(np.float32)  # c's beyond its joint's limit

    def coupled(data):
        a, b, c = data.qfrc_actuator
        return [0.25 * b, 0.3 * a - 0.6 * c, -0.2 * b]

    expected = by_mujoco(model, commands, coupled)
    got, plain = by_the_effect(model, commands, ("a", "b", "c"), SHARES, np.zeros((3, 2)))
    np.testing.assert_allclose(got, expected, atol=2e-4)
    assert np.abs(plain - expected).max() > 0.05


LIMIT = (-1.0, 1.2)
SEVERAL = (
    CHAIN.format(integrator="implicitfast")
    .replace("<body pos", '<body gravcomp=".4" pos')
    .replace('name="swing"', 'name="swing" actuatorgravcomp="true" actuatorfrcrange="{} {}"'.format(*LIMIT))
    .replace("</actuator>", '<motor name="d" joint="swing" gear="-1.5"/></actuator>')
)


def test_of_several_actuators_at_a_joint_each_gives_a_share_of_its_own_effort():
    """Its gear times its force; at the joint's limit as much less as the sum, gravity compensation included, is cut."""
    model = mujoco.MjModel.from_xml_string(SEVERAL)
    commands = np.random.default_rng(1).uniform(-1, 1, (60, 4)).astype(np.float32)
    cases, cuts = [[[0.3, -0.5], [0, 0]], [[0, 0], [0.4, 0.2]], [[0.3, -0.5], [0.4, 0.2]]], []

    def coupled(shares, data):
        own = np.array([2 * data.ctrl[1], -1.5 * data.ctrl[3]])
        asked = own.sum() + data.qfrc_gravcomp[1]
        cuts.append(passed := np.clip(asked, *LIMIT) / asked)
        ahead, back = passed * own @ shares
        return [back, 0.0, ahead]

    plain, *got = by_the_effect(model, commands, ("b", "d"), np.zeros((2, 2)), *cases)
    for shares, moved in zip(cases, got, strict=True):
        expected = by_mujoco(model, commands, functools.partial(coupled, shares))
        np.testing.assert_allclose(moved, expected, atol=2e-4)
        assert np.abs(plain - expected).max() > 0.02
    assert 0.2 < np.mean(np.array(cuts) < 1) < 0.8


def test_drives_of_no_joint_couple_nothing():
    tendon = '<tendon><fixed name="t"><joint joint="swing" coef="1"/></fixed></tendon>'
    text = CHAIN.format(integrator="Euler").replace("<actuator>", f'{tendon}<actuator><motor name="d" tendon="t"/>')
    effect = make("effort_coupling", where="d")
    physics = Physics(mujoco.MjModel.from_xml_string(text), 0.01, ParameterSpace(), [effect])
    start, command = jnp.array([0.1, 0.4, -0.3]), jnp.array([0.8, 0.0, 0.0, 0.0])
    ends = [
        control_step(physics, physics.world(jnp.asarray(t), start, 0 * start), command)[0].measurement["qpos"]
        for t in ([0.5, 0.5], [0.0, 0.0])
    ]
    np.testing.assert_array_equal(*ends)
