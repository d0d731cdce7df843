"""Where a motor behind play or a spring is in the middle of a recording of its link."""

import functools

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx.effects import make
from bayessim_mjx.effects.support.motion import Motion
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics, begin, control_step, past_of, retraced

MODEL = """
<mujoco>
  <option timestep=".002" integrator="{}"/>
  <worldbody><body>
    <joint name="link" axis="0 1 0" damping=".05" armature=".02"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".02" mass="1" contype="0" conaffinity="0"/>
  </body></worldbody>
  <actuator><motor joint="link"/></actuator>
</mujoco>
"""
DT, ROWS, BEFORE = 0.02, 100, 5
TIME = DT * np.arange(ROWS)
COMMAND = (1.2 * np.sin(2 * np.pi * (1 + TIME) * TIME))[:, None].astype(np.float32)


def robot(xml, effect):
    return Physics(mujoco.MjModel.from_xml_string(xml), DT, ParameterSpace([]), [make(effect, where="link")])


@functools.cache
def recorded(name, value, integrator="Euler"):
    """(physics, theta, its worlds, `Motion`s around the rows) of a robot with one effect."""
    physics = robot(MODEL.format(integrator), name)
    theta = jnp.asarray(value, jnp.float32)

    def step(world, command):
        after = control_step(physics, world, command)[0]
        return after, world

    _, worlds = jax.jit(lambda w: jax.lax.scan(step, w, jnp.asarray(COMMAND)))(physics.world(theta))
    near = np.arange(BEFORE, ROWS - BEFORE)[:, None] + np.arange(-BEFORE, BEFORE + 1)
    commands = np.repeat(COMMAND[near][:, :, None], physics.substeps, 2)
    return physics, theta, worlds, Motion(worlds.qpos[near], worlds.qvel[near], jnp.asarray(commands), start=BEFORE)


def twists(how, physics, theta, motion):
    found = jax.jit(jax.vmap(functools.partial(how, physics, theta)))(motion)
    return np.asarray(found.memory[0]["twist"])[:, 0], found


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast"])
def test_a_motor_is_where_the_recorded_motion_brought_it(integrator):
    gap = 0.03
    physics, theta, worlds, motion = recorded("backlash", (gap,), integrator)
    true = np.asarray(worlds.memory[0]["twist"])[BEFORE : ROWS - BEFORE, 0]
    assert (np.abs(true) < 0.9 * gap).mean() > 0.1 and true.min() < -0.9 * gap and true.max() > 0.9 * gap
    off = np.abs(twists(retraced, physics, theta, motion)[0] - true)
    assert np.mean(off < 0.1 * gap) > 0.8  # in the others the motor has touched neither side for 0.1 s
    unknown, start = twists(begin, physics, theta, motion)
    assert np.all(unknown == 0) and np.all(start.memory[0]["fresh"])


def test_a_spring_is_wound_up_as_the_recorded_motion_left_it():
    """Of 4 Hz and lightly damped: in 0.1 s what is not known of its swing decays by a third only."""
    physics, theta, worlds, motion = recorded("joint_elasticity", (0.1, 0.1))
    true = np.asarray(worlds.memory[0]["twist"])[BEFORE : ROWS - BEFORE, 0]
    off = twists(retraced, physics, theta, motion)[0] - true
    assert np.sqrt(np.mean(off**2)) < 0.65 * np.std(true)


@pytest.mark.parametrize(("name", "value"), [("backlash", (0.03, 0.0, 1.0)), ("joint_elasticity", (0.1, 0.1, 1.0))])
def test_a_link_is_where_its_motors_recorded_motion_brought_it(name, value):
    """What is shown goes on as it was recorded: simulated from its middle, the motor is nearer to what it did."""
    physics = Physics(
        mujoco.MjModel.from_xml_string(MODEL.format("Euler")),
        DT,
        ParameterSpace([]),
        [make(name, where="link").with_all()],
    )
    theta, ahead = jnp.asarray(value, jnp.float32), 5

    def step(world, command):
        after = control_step(physics, world, command)[0]
        return after, world

    _, worlds = jax.jit(lambda w: jax.lax.scan(step, w, jnp.asarray(COMMAND)))(physics.world(theta))
    shown = worlds.measurement
    near = np.arange(BEFORE, ROWS - BEFORE)[:, None] + np.arange(-BEFORE, BEFORE + 1)
    commands = np.repeat(COMMAND[near][:, :, None], physics.substeps, 2)
    motion = Motion(shown["qpos"][near], shown["qvel"][near], jnp.asarray(commands), start=BEFORE)

    def goes_on(how, one):
        def step(k, world):
            return control_step(physics, world, one.command[BEFORE + k])[0]

        start = how(physics, theta, one)
        return physics.sense((theta,), start.memory, {"qpos": start.qpos, "qvel": start.qvel})[1], jax.lax.fori_loop(
            0, ahead, step, start
        ).measurement

    off = {}
    for how in (begin, retraced):
        first, after = jax.jit(jax.vmap(functools.partial(goes_on, how)))(motion)
        np.testing.assert_allclose(first["qpos"], motion.qpos[:, BEFORE], atol=1e-5)
        off[how] = np.sqrt(np.mean((np.asarray(after["qpos"]) - motion.qpos[:, BEFORE + ahead]) ** 2))
    assert off[retraced] < {"backlash": 0.6, "joint_elasticity": 0.8}[name] * off[begin], off


def test_a_start_is_as_measured_and_without_such_effects_nothing_is_retraced():
    physics, theta, worlds, motion = recorded("backlash", (0.03,))
    one = jax.tree.map(lambda x: x[20], motion)
    found = retraced(physics, theta, one)
    np.testing.assert_array_equal(found.qpos, one.qpos[BEFORE])
    np.testing.assert_array_equal(found.qvel, one.qvel[BEFORE])
    other = robot(MODEL.format("Euler"), "coulomb_friction")
    assert past_of(other, other.world(jnp.zeros(len(other.space))), one).steps == 0
    assert past_of(physics, found, one.replace(start=0)).steps == 0


def test_inactive_effects_are_not_taken_along():
    physics, theta, worlds, motion = recorded("backlash", (0.03,))
    one = jax.tree.map(lambda x: x[20], motion)
    start = begin(physics, theta, one)
    active, inactive = (past_of(physics, start, one, jnp.array([on])) for on in (True, False))
    assert bool(active.wanted) and active.first == 0
    assert not bool(inactive.wanted) and inactive.first == BEFORE


@pytest.mark.parametrize("integrator", ["Euler", "implicitfast", "RK4"])
def test_noise_of_the_recorded_link_is_not_taken_for_slip_of_a_heavy_motor(integrator):
    """The link is a hundredth of its motor and lies on the teeth: what is left of their slip is what they really do.

    A motor that kept its own speed against the noise of each recorded one was off by about that noise.
    """
    xml = MODEL.format(integrator).replace('mass="1"', 'mass=".01"')
    physics, theta = robot(xml, "backlash"), jnp.array([0.01])
    gravity = 0.05 * np.ones_like(COMMAND)  # a constant push beside, which keeps the link on one side for long

    def step(world, command):
        after = control_step(physics, world, command)[0]
        return after, world

    command = jnp.asarray(0.1 * COMMAND + gravity)
    _, worlds = jax.jit(lambda w: jax.lax.scan(step, w, command))(physics.world(theta))
    noise, rng = 0.02, np.random.default_rng(0)
    near = np.arange(BEFORE, ROWS - BEFORE)[:, None] + np.arange(-BEFORE, BEFORE + 1)
    qvel = np.asarray(worlds.qvel) + noise * rng.normal(size=worlds.qvel.shape)
    commands = np.repeat(np.asarray(command)[near][:, :, None], physics.substeps, 2)
    motion = Motion(worlds.qpos[near], jnp.asarray(qvel[near], jnp.float32), jnp.asarray(commands), start=BEFORE)
    rows = slice(BEFORE, ROWS - BEFORE)
    true = np.asarray(worlds.memory[0]["speed"] - worlds.qvel)[rows, 0]
    found = twists(retraced, physics, theta, motion)[1]
    slip = np.asarray(found.memory[0]["speed"] - found.qvel)[:, 0]
    assert np.median(np.abs(true)) < 1e-3  # they move together nearly always
    assert np.median(np.abs(slip - true)) < 0.1 * noise
