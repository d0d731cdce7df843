"""`env.impl=warp`: refused in words where it cannot work; where warp-lang is installed, the motion is that of MJX."""

import copy
import importlib.util

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import config, registry
from bayessim_mjx.effects import make
from bayessim_mjx.errors import UserError
from bayessim_mjx.parameters import ParameterSpace
from bayessim_mjx.physics import Physics, control_step
from bayessim_mjx.physics.warp import wrenches

INSTALLED = importlib.util.find_spec("warp") is not None


def warp(test):
    """Of those that simulate by Warp on the CPU: their seconds are those of compiling its kernels."""
    return pytest.mark.slow(
        pytest.mark.ci(pytest.mark.skipif(not INSTALLED, reason="warp-lang is not installed")(test))
    )


@pytest.mark.skipif(INSTALLED, reason="warp-lang is installed")
def test_without_the_package_the_extra_is_named():
    with pytest.raises(UserError, match=r"env.impl = 'warp'.*bayessim-mjx\[warp\]"):
        registry.make("Pendulum", impl="warp")


def test_other_implementations_and_foreign_environments_are_refused():
    with pytest.raises(UserError, match="env.impl = 'cpp': allowed are jax, warp, auto"):
        registry.make("Pendulum", impl="cpp")
    with pytest.raises(UserError, match="env.impl = 'warp': brax:ant is not simulated here"):
        registry.make("brax:ant", config=config.load("Pendulum", overrides=["env.impl=warp"]))


def test_effects_inside_the_timestep_are_refused():
    with pytest.raises(UserError, match="env.impl = 'warp': coulomb_friction acts inside the timestep"):
        registry.make("Pendulum", impl="warp", effects=[make("coulomb_friction", where="all")])


def test_auto_is_a_setting_of_every_task():
    env = registry.make("Pendulum", impl="auto")
    assert env.settings["impl"] == "auto" and env.physics.warp is None and env.chosen.impl == "jax"
    assert registry.make("Pendulum").chosen is None
    assert config.load("Ant", overrides=["env.impl=auto"]).env.impl == "auto"


def motions(env, thetas, steps=5):
    """Positions and velocities [N, T, nq + nv] from random states, in worlds of their own physics."""

    def one(theta, key):
        def step(world, i):
            world, _ = control_step(env.physics, world, env.command(0.5 * jnp.sin(jnp.arange(env.action_size) + i)))
            return world, jnp.concatenate([world.qpos, world.qvel])

        return jax.lax.scan(step, env.physics.world(theta, *env.initial(key)), jnp.arange(steps))[1]

    return jax.jit(jax.vmap(one))(thetas, jax.random.split(jax.random.PRNGKey(0), len(thetas)))


@warp
@pytest.mark.parametrize("name", ["Pendulum", "Cartpole"])
def test_the_motion_is_that_of_the_other_implementation(name):
    """In every world that of its own parameters, and a delay on the way to the actuators acts as well."""
    effects = [make("actuator_delay", where="all")]
    ours, warp = (registry.make(name, impl=impl, effects=effects) for impl in ("jax", "warp"))
    low, high = (jnp.asarray(x, jnp.float32) for x in (ours.space.low, ours.space.high))
    thetas = low + (high - low) * jax.random.uniform(jax.random.PRNGKey(1), (4, len(ours.space)))
    expected = motions(ours, thetas)
    np.testing.assert_allclose(motions(warp, thetas), expected, rtol=1e-4, atol=1e-4)
    assert np.ptp(expected[:, -1], axis=0).max() > 0.1  # worlds differ


@warp
def test_a_humanoid_moves_as_in_mujoco_once_its_solver_has_converged():
    """Four iterations, as the task allows, end elsewhere in MuJoCo too; Warp's go on until they have converged."""
    worlds, steps = 4, 10
    env = registry.make("Humanoid", impl="warp", numEnvs=worlds)
    qpos, qvel = jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), worlds))

    def speeds(model):
        found = []
        for world in range(worlds):
            data = mujoco.MjData(model)
            data.qpos[:], data.qvel[:] = qpos[world], qvel[world]
            mujoco.mj_step(model, data, steps * env.physics.substeps)
            found.append(data.qvel.copy())
        return np.array(found)

    def warp(qpos, qvel):
        world = env.physics.world(jnp.asarray(env.space.nominal, jnp.float32), qpos, qvel)
        held = jnp.zeros((steps, env.mj_model.nu))
        return jax.lax.scan(lambda w, u: (control_step(env.physics, w, u)[0], None), world, held)[0].qvel

    converged = copy.copy(env.mj_model)
    converged.opt.iterations, converged.opt.ls_iterations, converged.opt.tolerance = 200, 100, 1e-12
    exact = speeds(converged)
    few, many = (np.abs(x - exact).max(1) for x in (speeds(env.mj_model), jax.jit(jax.vmap(warp))(qpos, qvel)))
    assert np.median(many) < 1e-3 < np.median(few) and np.all(many < 0.5 * few)


@warp
def test_solvers_that_end_at_their_limit_print_nothing(capfd):
    """One line for a world and timestep each would be 180 000 of them in a training of Humanoid."""
    env = registry.make("Humanoid", impl="warp", numEnvs=8)
    motion = motions(env, jnp.tile(jnp.asarray(env.space.nominal, jnp.float32), (8, 1)), steps=60)
    jax.block_until_ready(motion)
    assert jnp.isfinite(motion).all()
    assert "limit reached" not in "".join(capfd.readouterr())


BALL = """
<mujoco><option timestep="0.002"/><worldbody>
  <geom type="plane" size="5 5 1"/>
  <body pos="0 0 0.1"><freejoint/><geom type="sphere" size="0.1" mass="2"/></body>
</worldbody></mujoco>
"""


@warp
def test_contacts_of_many_worlds_and_what_they_carry():
    """A ball of 2 kg is carried by 2 g; pushed sidewise it rolls as in the other implementation, in every world."""
    model = mujoco.MjModel.from_xml_string(BALL)
    ours, warp = (Physics(model, 0.02, ParameterSpace(), impl=impl) for impl in ("jax", "warp"))
    assert warp.warp.room(4) == 256  # one contact for each of the least number of worlds

    def roll(physics, speed):
        def step(world, _):
            world, data = control_step(physics, world, jnp.zeros(0))
            return world, (world.qpos, wrenches(physics.model, data)[1])

        world = physics.world(jnp.zeros(0), qvel=jnp.zeros(6).at[0].set(speed))
        return jax.lax.scan(step, world, None, 25)[1]

    speeds = jnp.array([0.0, 0.5, 1.0, 1.0])
    (expected, _), (qpos, wrench) = (jax.jit(jax.vmap(lambda v, p=p: roll(p, v)))(speeds) for p in (ours, warp))
    np.testing.assert_allclose(qpos, expected, atol=1e-4)
    np.testing.assert_allclose(wrench[:, -1, 5], 2 * 9.81, rtol=1e-3)
    assert qpos[2, -1, 0] > 0.2


def height(physics):
    def fall(start):
        world = physics.world(jnp.zeros(0), jnp.asarray(physics.mj_model.qpos0, jnp.float32).at[2].set(start))
        return control_step(physics, world, jnp.zeros(0))[0].qpos[2]

    return fall


@warp
def test_as_many_worlds_have_room_as_vmap_makes_of_one():
    """Nobody says how many: 300 on the ground, 2 by 200, and one; all touch it, and what carries them is found."""
    physics = Physics(mujoco.MjModel.from_xml_string(BALL), 0.002, ParameterSpace(), impl="warp")
    fall, one = height(physics), jnp.linspace(0.09, 0.095, 300)
    many = jax.jit(jax.vmap(fall))(one)
    assert np.isfinite(many).all() and np.ptp(many) > 0.004
    grid = jax.vmap(jax.jit(jax.vmap(fall)))(jnp.stack([one[:200], one[100:]]))
    np.testing.assert_allclose(grid, np.stack([many[:200], many[100:]]), atol=1e-6)
    np.testing.assert_allclose(fall(one[7]), many[7], atol=1e-6)
    shared = jax.vmap(lambda _: fall(one[7]))(jnp.arange(300))  # what is the same in all of them
    np.testing.assert_allclose(shared, many[7], atol=1e-6)


# two balls touch the ground, and the model has room for one contact
CROWD = BALL.replace("<option", '<custom><numeric name="max_contact_points" data="1"/></custom><option').replace(
    "</worldbody>", '<body pos="1 0 0.09"><freejoint/><geom type="sphere" size="0.1" mass="2"/></body></worldbody>'
)


@warp
def test_where_contacts_have_no_room_worlds_diverge():
    physics = Physics(mujoco.MjModel.from_xml_string(CROWD), 0.002, ParameterSpace(), impl="warp")
    step = jax.jit(jax.vmap(height(physics)))
    assert np.isfinite(step(jnp.full(128, 0.095))).all()
    assert np.isnan(step(jnp.full(129, 0.095))).all()
