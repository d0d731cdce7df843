"""Compiled once per session and task: the environments, and rollouts in MJX and in MuJoCo C to compare."""

import functools
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.compat import program
from bayessim_mjx.physics import control_step

WORLDS = 8


@functools.cache
def _compiled(name):
    env = registry.make(name)
    env.nuisance = None  # noise has no mirror image and no value known beforehand
    step = program(jax.vmap(env.step), env)
    reset = program(jax.vmap(env.reset), env)

    @jax.jit
    def reset_to(qpos, qvel, thetas):
        return jax.vmap(env.reset_to)(qpos, qvel, thetas)

    def begin(qpos, qvel, theta=None):
        theta = env.space.nominal if theta is None else theta
        return reset_to(qpos, qvel, np.broadcast_to(theta, (len(qpos), len(env.space))))

    return SimpleNamespace(env=env, reset=reset, reset_to=begin, step=step, worlds=WORLDS)


@pytest.fixture
def compiled():
    """name -> env with jitted reset(keys, thetas), reset_to(qpos, qvel, theta), step(states, actions) of 8 worlds."""
    return _compiled


@functools.cache
def _mjx_rollout(env):
    def run(world, commands):
        def body(world, command):
            world, data = control_step(env.physics, world, command)
            return world, (world.qpos, world.qvel)

        return jax.lax.scan(body, world, commands)[1]

    return program(run, env)


@pytest.fixture
def both_engines():
    """(env, qpos, qvel, commands [T, nu]) -> ((qpos, qvel) of MJX, of MuJoCo C), `[T, n]` each, nominal model."""

    def run(env, qpos, qvel, commands):
        qpos, qvel, commands = (np.asarray(x, np.float32) for x in (qpos, qvel, commands))
        world = env.physics.world(env.space.nominal, qpos, qvel).replace(fields={})
        fast = _mjx_rollout(env)(world, jnp.asarray(commands))
        data = mujoco.MjData(env.mj_model)
        data.qpos[:], data.qvel[:] = qpos, qvel
        exact = []
        for command in commands:
            data.ctrl[:] = command
            mujoco.mj_step(env.mj_model, data, nstep=env.physics.substeps)
            if env.physics.max_qvel is not None:
                data.qvel[:] = np.clip(data.qvel, -env.physics.max_qvel, env.physics.max_qvel)
            exact.append((data.qpos.copy(), data.qvel.copy()))
        return [np.asarray(x) for x in fast], [np.stack(x) for x in zip(*exact, strict=True)]

    return run
