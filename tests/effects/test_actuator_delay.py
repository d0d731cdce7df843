"""A delayed staircase, by hand: a free mass integrates the force, so its speed is the impulse."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics, control_step

XML = """
<mujoco>
  <option timestep="0.005" gravity="0 0 0"/>
  <worldbody>
    <body><joint name="a" type="slide"/><geom size=".1" mass="1" contype="0"/></body>
    <body><joint name="b" type="slide"/><geom size=".1" mass="1" contype="0"/></body>
  </worldbody>
  <actuator><motor name="a" joint="a"/><motor name="b" joint="b"/></actuator>
</mujoco>
"""
DT = 0.02


@functools.cache
def simulation(*places, **longest):
    """(theta, commands) -> speeds of delays at these places, compiled once for all tests that ask for it."""
    effects = [make("actuator_delay", where=where, **longest) for where in places]
    p = Physics(mujoco.MjModel.from_xml_string(XML), DT, ParameterSpace(), effects)

    def body(world, command):
        world, _ = control_step(p, world, command)
        return world, world.qvel

    return jax.jit(lambda theta, commands: jax.lax.scan(body, p.world(theta), commands)[1])


def speeds(run, theta, commands):
    """Speeds `[T, 2]` of the two masses after each control step."""
    return np.asarray(run(np.float32(theta), np.float32(commands)))


def delayed_impulse(commands, delay):
    """Integral of the delayed staircase, exactly; the first command held before t = 0."""
    edges = np.arange(len(commands) + 1) * DT
    total = np.concatenate([[0.0], np.cumsum(commands) * DT])
    late = np.interp(edges[1:] - delay, edges, total)
    return late + np.where(edges[1:] < delay, (edges[1:] - delay) * commands[0], 0) + delay * commands[0]


@pytest.mark.parametrize("delay", [0.0, 0.005, 0.0123, 0.02, 0.0311, 0.1])
def test_impulse_is_exact_for_any_delay(delay):
    commands = np.array([0.5, 1.0, -2.0, 3.0, 0.0, 0.0, 1.0, -1.0, 2.0, 0.3])
    v = speeds(simulation("all"), [delay], np.c_[commands, 2 * commands])
    want = delayed_impulse(commands, delay)
    np.testing.assert_allclose(v, np.c_[want, 2 * want], atol=1e-5)


@pytest.mark.parametrize("share", [0.25, 0.5, 0.6])
def test_a_step_by_runge_kutta_moves_positions_as_the_delayed_staircase_does(share):
    """A free mass after a unit step. A mean over each timestep would add h^2 share (1 - share) / 2."""
    h, delay = 0.005, share * 0.005
    model = mujoco.MjModel.from_xml_string(XML.replace('timestep="0.005"', 'timestep="0.005" integrator="RK4"'))
    p = Physics(model, DT, ParameterSpace(), [make("actuator_delay", where="all")])
    world = p.world(jnp.float32([delay]))
    commands = np.array([0.0, 1.0, 1.0])
    step = jax.jit(lambda world, u: control_step(p, world, jnp.full(2, u))[0])
    for u in commands:
        world = step(world, u)
    late = 2 * DT - delay
    assert float(world.qvel[0]) == pytest.approx(late, rel=1e-5)
    by_means = h**2 * share * (1 - share) / 2
    tolerance = 1e-3 * by_means if share in (0.25, 0.5) else by_means / 12  # edges of the parts are exact
    assert float(world.qpos[0]) - late**2 / 2 == pytest.approx(0.0, abs=tolerance + 1e-9)


def test_a_step_to_the_end_of_the_range_keeps_its_impulse():
    """By Runge and Kutta's method a stage beyond ctrlrange would be clipped, and what it carries lost."""
    xml = XML.replace('timestep="0.005"', 'timestep="0.005" integrator="RK4"')
    xml = xml.replace('<motor name="a" joint="a"/>', '<motor name="a" joint="a" ctrlrange="-1 1" ctrllimited="true"/>')
    p = Physics(mujoco.MjModel.from_xml_string(xml), DT, ParameterSpace(), [make("actuator_delay", where="all")])
    world = p.world(jnp.float32([0.002]))
    step = jax.jit(lambda world, u: control_step(p, world, jnp.full(2, u))[0])
    for u in (-1.0, 1.0, 1.0):
        world = step(world, u)
    want = delayed_impulse(np.array([-1.0, 1.0, 1.0]), 0.002)[-1]
    np.testing.assert_allclose(world.qvel, [want, want], atol=1e-6)


def test_one_actuator_alone():
    commands = np.array([0.0, 1.0, 1.0, 1.0])
    v = speeds(simulation("b", high=0.05), [0.04], np.c_[commands, commands])
    np.testing.assert_allclose(v[:, 0], delayed_impulse(commands, 0.0), atol=1e-6)
    np.testing.assert_allclose(v[:, 1], delayed_impulse(commands, 0.04), atol=1e-6)


def test_delays_add():
    commands = np.array([0.0, 1.0, -1.0, 2.0, 0.0, 1.0])
    v = speeds(simulation("a", "all"), [0.015, 0.025], np.c_[commands, commands])
    np.testing.assert_allclose(v[:, 0], delayed_impulse(commands, 0.04), atol=1e-5)
    np.testing.assert_allclose(v[:, 1], delayed_impulse(commands, 0.025), atol=1e-5)


@pytest.mark.slow
def test_the_gradient_exists():
    """d(speed)/d(delay) after a command step of 1 N is -1 N / 1 kg."""
    p = Physics(mujoco.MjModel.from_xml_string(XML), DT, ParameterSpace(), [make("actuator_delay", where="all")])

    def speed(delay):
        world = p.world(delay[None])
        for command in (0.0, 1.0, 1.0):
            world, _ = control_step(p, world, jnp.full(2, command))
        return world.qvel[0]

    assert jax.jit(jax.grad(speed))(jnp.float32(0.013)) == pytest.approx(-1, abs=1e-4)


def test_refusals():
    with pytest.raises(ValueError, match="no actuator 'c'.*a, b"):
        simulation("c")
    with pytest.raises(ValueError, match="high = 0"):
        make("actuator_delay", where="a", high=0.0)
    with pytest.raises(ValueError, match="did you mean actuator_delay"):
        make("actuator_dely", where="a")
    with pytest.raises(ValueError, match="no setting .*hihg"):
        make("actuator_delay", where="a", hihg=1.0)


def test_behind_a_rate_limit_part_of_a_sub_step_delays_the_ramp():
    """Before it, it is lost: the command between two others, in the sub-step where they meet, begins the ramp early."""
    commands, delay, slowness, fine = np.array([0.0, 0.0, 1.0, 1.0, 1.0]), 0.0025, 0.015, 1e-6
    true = np.repeat(commands, round(DT / fine))
    ramp = np.concatenate([np.zeros(round(delay / fine)), true])[: len(true)]
    u = np.minimum(np.cumsum(ramp) * fine / slowness, 1.0)  # a single step upwards
    want = np.cumsum(u)[round(DT / fine) - 1 :: round(DT / fine)] * fine
    error = {}
    for names in (("rate_limit", "actuator_delay"), ("actuator_delay", "rate_limit")):
        p = Physics(mujoco.MjModel.from_xml_string(XML), DT, ParameterSpace(), [make(n, where="a") for n in names])
        theta = {"rate_limit": slowness, "actuator_delay": delay}
        world, speed = p.world(np.float32([theta[n] for n in names])), []
        for c in commands:
            world, _ = control_step(p, world, np.float32([c, 0.0]))
            speed.append(float(world.qvel[0]))
        error[names] = np.abs(np.array(speed) - want).max()
    last, first = error.values()
    assert last < 1e-5 and first == pytest.approx(delay, rel=0.01)
