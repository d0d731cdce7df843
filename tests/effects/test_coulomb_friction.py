"""Dry friction by hand: it brakes with Fc / m, stops, stays, and lets go only above Fc."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics, control_step

MASS, DT = 2.0, 0.01
XML = """
<mujoco>
  <option timestep="0.002" gravity="0 0 -9.81" integrator="{integrator}"/>
  <worldbody>
    <body><joint name="x" type="slide" axis="1 0 0" damping="{damping}"/><geom size=".1" mass="2" contype="0"/></body>
  </worldbody>
  <actuator><motor name="x" joint="x"/></actuator>
</mujoco>
"""
ARM = """
<mujoco>
  <option timestep="0.002"/>
  <worldbody>
    <body>
      <joint name="shoulder" axis="0 1 0" damping="0.1"/>
      <geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1"/>
      <body pos=".5 0 0">
        <joint name="elbow" axis="0 1 0" damping="0.1"/><geom type="capsule" fromto="0 0 0 .5 0 0" size=".02" mass="1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="elbow" joint="elbow"/></actuator>
</mujoco>
"""


@functools.cache
def simulation(xml, joints, high):
    """(theta, qvel, commands) -> (qpos, qvel), one compiled program for tests with the same number of steps."""
    effects = [make("coulomb_friction", where=joint, high=high) for joint in joints]
    p = Physics(mujoco.MjModel.from_xml_string(xml), DT, ParameterSpace(), effects)

    def body(world, command):
        world, _ = control_step(p, world, command)
        return world, (world.qpos, world.qvel)

    return jax.jit(lambda theta, qvel, commands: jax.lax.scan(body, p.world(theta, qvel=qvel), commands)[1])


def run(xml, joints, theta, commands, qvel, high=20.0):
    """(qpos, qvel), `[T, n]`."""
    return [np.asarray(x) for x in simulation(xml, joints, high)(*map(np.float32, (theta, qvel, commands)))]


def slide(level, force, speed, steps=200, integrator="Euler", damping=0.0):
    xml = XML.format(integrator=integrator, damping=damping)
    q, v = run(xml, ("x",), [level], np.full((steps, 1), force), [speed], high=10.0)
    return q[:, 0], v[:, 0]


def test_a_sliding_mass_brakes_stops_and_stays():
    """From 1 m/s with Fc = 4 N, m = 2 kg: v = 1 - 2 t, at rest after 0.5 s and 0.25 m."""
    q, v = slide(level=4.0, force=0.0, speed=1.0)
    t = DT * np.arange(1, 201)
    np.testing.assert_allclose(v, np.maximum(1 - 2 * t, 0), atol=1e-5)
    assert q[-1] == pytest.approx(0.25, abs=0.002)  # semi-implicit Euler: within v dt_sub / 2
    assert np.ptp(q[60:]) < 1e-8


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_sticks_below_and_slips_above(integrator):
    """With viscous damping the integrators solve implicitly; sticking stays exact."""
    q, v = slide(level=4.0, force=3.9, speed=0.0, steps=400, integrator=integrator, damping=3.0)
    assert np.abs(v).max() < 1e-8 and np.abs(q).max() < 1e-8
    q, v = slide(level=4.0, force=5.0, speed=0.0, steps=400, integrator=integrator, damping=3.0)
    assert v[-1] == pytest.approx((5.0 - 4.0) / 3.0, rel=0.01)  # terminal speed (F - Fc) / c


def test_never_reverses_the_motion():
    for speed in (-0.3, 0.01, 2.0):
        _, v = slide(level=7.0, force=1.0 * np.sign(speed), speed=speed)
        assert (v * np.sign(speed) >= -1e-7).all()
        assert v[-1] == pytest.approx(0, abs=1e-7)


@pytest.mark.slow
def test_holds_an_arm_against_gravity_in_both_joints():
    """Shoulder 9.81 N m and elbow 2.45 N m of weight: held by 12 and 4 N m, let go by less. Effects see each other."""
    joints = ("shoulder", "elbow")
    q, _ = run(ARM, joints, [12.0, 4.0], np.zeros((50, 1)), [0, 0])
    assert np.abs(q).max() < 2e-2
    q, _ = run(ARM, joints, [5.0, 1.0], np.zeros((50, 1)), [0, 0])
    assert np.abs(q).max() > 0.3


@pytest.mark.slow
@pytest.mark.ci
def test_the_derivative_at_neutral_is_that_of_sliding():
    """From 1 m/s, 2 kg and 0.01 s: dv / dFc = -0.01 / 2, also at Fc = 0."""
    xml = XML.format(integrator="Euler", damping=0)
    p = Physics(mujoco.MjModel.from_xml_string(xml), DT, ParameterSpace(), [make("coulomb_friction", where="x")])

    def speed(theta):
        return control_step(p, p.world(theta, qvel=jnp.ones(1)), jnp.zeros(1))[0].qvel[0]

    assert jax.jit(jax.grad(speed))(jnp.zeros(1))[0] == pytest.approx(-0.005, rel=1e-4)


@pytest.mark.slow
def test_energy_only_leaves():
    xml = ARM.replace('damping="0.1"', "").replace('timestep="0.002"', 'timestep="0.002" gravity="0 0 0"')
    p = mujoco.MjModel.from_xml_string(xml)
    data = mujoco.MjData(p)
    q, v = run(xml, ("elbow",), [0.2], np.zeros((150, 1)), [2.0, -3.0])
    energy = []
    for x, w in zip(q, v, strict=True):
        data.qpos[:], data.qvel[:] = x, w
        mujoco.mj_forward(p, data)
        mujoco.mj_energyVel(p, data)
        energy.append(data.energy[1])
    assert np.diff(energy).max() < 1e-3 * energy[0]
    assert abs(v[-1, 1]) < 1e-2  # the elbow has locked; the whole turns on


def test_refusals():
    with pytest.raises(ValueError, match="no joint 'y'.*x"):
        run(XML.format(integrator="Euler", damping=0), ("y",), [0.0], [[0.0]], [0.0])


PULLEY = """
<mujoco>
  <option timestep="0.002" gravity="0 0 -10" integrator="{integrator}"/>
  <default><geom size=".1" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body><joint name="table" type="slide" axis="1 0 0" damping="{damping}"/><geom mass="2"/></body>
    <body><joint name="rope" type="slide" axis="0 0 -1"/><geom mass="1"/></body>
  </worldbody>
  <equality><joint joint1="table" joint2="rope" solref="0.004 1"/></equality>
  <actuator><motor name="table" joint="table"/></actuator>
</mujoco>
"""


@pytest.mark.parametrize(
    ("integrator", "damping"), [("implicitfast", 4.0), pytest.param("RK4", 0.0, marks=pytest.mark.slow)]
)
def test_it_holds_what_hangs_on_another_joint_of_a_loop(integrator, damping):
    """1 kg pulls 2 kg over a pulley by 10 N: 12 N of friction hold both, 4 N let both go with 6 N on 3 kg."""
    xml = PULLEY.format(integrator=integrator, damping=damping)
    away = {}
    for level in (12.0, 4.0):
        qpos, qvel = run(xml, ("table",), [level], np.zeros((60, 1)), np.zeros(2))
        away[level] = qvel[-1]
        np.testing.assert_allclose(*qpos[-1], atol=1e-4)
    rate = damping / 3
    gone = 2 * 0.6 if not rate else 2 * (1 - np.exp(-rate * 0.6)) / rate
    np.testing.assert_allclose(away[12.0], 0.0, atol=1e-5)
    np.testing.assert_allclose(away[4.0], gone, rtol=2e-3)


def softly(xml, joints, levels, seconds, commands, timestep=0.0005):
    """Motion `[T, n]` of MuJoCo C with frictionloss, as soft as `seconds`."""
    spec = mujoco.MjSpec.from_string(xml)
    spec.option.timestep = timestep
    for name, level in zip(joints, levels, strict=True):
        joint = spec.joint(name)
        joint.frictionloss, joint.solref_friction = level, [seconds, 1.0]
    model = spec.compile()
    data, rows = mujoco.MjData(model), []
    for row in commands:
        data.ctrl[:] = row
        mujoco.mj_step(model, data, round(DT / timestep))
        rows.append(data.qpos.copy())
    return np.array(rows)


@pytest.mark.parametrize(("seconds", "within"), [(0.02, 0.12), (0.1, 0.05)])
def test_relaxes_as_mujocos_soft_friction(seconds, within):
    """An arm of two joints: the change of its motion against rigid friction, to 12 and 5 % of its size."""
    joints, levels = ("shoulder", "elbow"), (6.0, 2.0)
    t = DT * np.arange(100)
    commands = 5 * np.sin(8 * t)[:, None]
    truth = softly(ARM, joints, levels, seconds, commands)
    effects = [make("coulomb_friction", where=j, high=20.0).with_all() for j in joints]
    p = Physics(mujoco.MjModel.from_xml_string(ARM.replace("0.002", "0.0005")), DT, ParameterSpace(), effects)
    assert p.space.names[1] == "shoulder.coulomb_friction.relaxation"

    def body(world, command):
        world, _ = control_step(p, world, command)
        return world, world.qpos

    def moved(relaxation):
        theta = jnp.array([levels[0], relaxation, levels[1], relaxation])
        return jax.lax.scan(body, p.world(theta), jnp.asarray(commands, jnp.float32))[1]

    rigid, soft = map(np.asarray, jax.jit(jax.vmap(moved))(jnp.array([0.0, seconds])))
    assert np.abs(truth - rigid).max() > 0.05
    assert np.abs(truth - soft).max() < within * np.abs(truth - rigid).max()
