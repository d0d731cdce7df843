"""Effects that no world of a call has are left out by branches: the same motion, bit for bit."""

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.diagnosis.fitting.centred_commands import Centred
from bayessim_mjx.effects import load
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Drive, Physics, control_step

ARM = """<mujoco><option timestep="0.005" integrator="implicitfast"/>
  <default><geom type="capsule" size=".03" contype="0" conaffinity="0"/></default><worldbody>
  <body><joint name="shoulder" axis="0 1 0" damping=".1"/><geom fromto="0 0 0 .3 0 0"/>
    <body pos=".3 0 0"><joint name="elbow" axis="0 1 0" damping=".1"/><geom fromto="0 0 0 .2 0 0"/></body></body>
  </worldbody>
  <actuator><motor name="s" joint="shoulder"/><motor name="e" joint="elbow"/></actuator></mujoco>"""
# one of each hook: the command, the actuator, a force, a force with a memory, the sensor
ON = {
    "actuator_delay": ("s", "e"), "actuator_deadband": ("s", "e"), "coulomb_friction": ("shoulder", "elbow"),
    "backlash": ("shoulder", "elbow"), "sensor_delay": ("shoulder", "elbow"),
}  # fmt: skip


@pytest.fixture(scope="module")
def physics():
    model = mujoco.MjModel.from_xml_string(ARM)
    stack = [load(name)(where) for name, where in ON.items()]
    return Physics(model, 0.01, ParameterSpace(()), (*stack, Centred()))


def motion(physics, theta, active):
    """qpos and what sensors show, over 20 control steps."""
    drive = Drive(active=active)

    def step(world, command):
        world, _ = control_step(physics, world, command, drive)
        return world, (world.qpos, world.measurement["qpos"])

    commands = 2.0 * jnp.sin(jnp.arange(20.0))[:, None] * jnp.array([1.0, -0.5])
    return jax.lax.scan(step, physics.world(theta, jnp.array([0.3, -0.4])), commands)[1]


@pytest.fixture(scope="module")
def both(physics):
    """The compiled programs: all hooks computed, and those of active effects; many worlds, one set of branches."""
    plain = jax.jit(jax.vmap(lambda theta: motion(physics, theta, None)))
    some = jax.jit(jax.vmap(lambda theta, active: motion(physics, theta, active), in_axes=(0, None)))
    return plain, some


def middle(physics, *names):
    theta = np.array(physics.neutral)
    for i, p in enumerate(physics.space.parameters):
        if p.name.split(".")[1] in names:
            theta[i] = p.low + 0.3 * (p.high - p.low)
    return theta


def test_what_acts_is_what_is_not_neutral(physics):
    thetas = np.stack([physics.neutral, middle(physics, "backlash"), middle(physics, *ON)])
    centring = [False] * len(ON) + [True]  # without a number to be neutral it always acts
    assert physics.acting(thetas).tolist() == [centring, [n == "backlash" for n in ON] + [True], [True] * 6]


@pytest.mark.parametrize("names", [(), *[(name,) for name in ON], ("actuator_delay", "coulomb_friction")])
@pytest.mark.slow
@pytest.mark.ci
def test_the_motion_is_the_same_bit_for_bit(physics, both, names):
    thetas = np.stack([physics.neutral, middle(physics, *names), 0.5 * (physics.neutral + middle(physics, *names))])
    plain, some = both
    expected, got = plain(thetas), some(thetas, physics.acting(thetas).any(0))
    for a, b in zip(expected, got, strict=True):
        np.testing.assert_array_equal(a, b)
    assert (not names) == np.array_equal(expected[1][0], expected[1][1])  # these effects do act


def test_what_is_not_active_is_not_computed(physics, both):
    thetas, neutral = (np.stack([one] * 3) for one in (middle(physics, *ON), physics.neutral))
    none = both[1](thetas, np.array([False] * len(ON) + [True]))
    np.testing.assert_array_equal(none[0], both[0](neutral)[0])


def test_a_branch_stays_a_branch_for_many_worlds(physics):
    active = np.ones(6, bool)
    run = jax.vmap(lambda theta, on: motion(physics, theta, on), in_axes=(0, None))
    program = str(jax.make_jaxpr(run)(np.stack([physics.neutral] * 2), active))
    assert program.count(" cond[") >= len(ON)
