"""Pendulum: MuJoCo's step is the published equation; golden numbers of the equation itself."""

import jax
import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.physics import control_step

DT, G = 0.05, 10.0


def published(angle, speed, torque, m, l):  # noqa: E741
    """One step of gym's Pendulum-v1 in double precision: (angle, speed)."""
    speed = speed + (-3 * G / (2 * l) * np.sin(angle + np.pi) + 3 * torque / (m * l**2)) * DT
    return angle + speed * DT, np.clip(speed, -8, 8)


def acceleration(env, angle, theta=None):
    """theta_dd at rest without torque, from one step."""
    world = env.physics.world(env.space.nominal if theta is None else theta, np.array([angle]), np.zeros(1))
    _, data = jax.jit(lambda w: control_step(env.physics, w, np.zeros(1, np.float32)))(world)
    return float(data.qacc[0])


def test_accelerations_at_rest(compiled):
    env = compiled("Pendulum").env
    assert acceleration(env, np.pi) == pytest.approx(0, abs=1e-5)  # hangs
    assert acceleration(env, np.pi / 2) == pytest.approx(15, rel=1e-5)  # 3 g / (2 l), away from upright


@pytest.mark.parametrize("theta", [(1.0, 1.0), (1.0, 0.5), (0.5, 1.7), (2.0, 0.05)])
def test_a_step_is_the_published_equation(compiled, theta):
    """Relative to how far the angle moves: light, short rods are flung hundreds of radians in a step."""
    task, rng = compiled("Pendulum"), np.random.default_rng(1)
    angle, speed, action = rng.uniform(-3, 3, 8), rng.uniform(-8, 8, 8), rng.uniform(-1, 1, 8)
    thetas = np.tile(np.float32(theta), (8, 1))
    state = task.reset_to(np.float32(angle)[:, None], np.float32(speed)[:, None], thetas)
    world = task.step(state, np.float32(action)[:, None]).pipeline_state
    want_angle, want_speed = published(angle, speed, 2 * action, *theta)
    np.testing.assert_allclose(world.qpos[:, 0], want_angle, rtol=2e-5, atol=1e-4)
    np.testing.assert_allclose(world.qvel[:, 0], want_speed, rtol=2e-5, atol=5e-4)


def test_period_of_small_swings(compiled):
    """T = 2 pi sqrt(2 l / 3 g) = 1.622 s at the bottom; semi-implicit Euler shortens it by (w dt)^2 / 24 = 0.16 %."""
    env = compiled("Pendulum").env
    world = env.physics.world(env.space.nominal, np.array([np.pi + 0.01]), np.zeros(1))
    step = jax.jit(lambda w: control_step(env.physics, w, np.zeros(1, np.float32))[0])
    deviation = []
    for _ in range(200):
        deviation.append(float(world.qpos[0]) - np.pi)
        world = step(world)
    deviation = np.array(deviation)
    down = np.flatnonzero((deviation[:-1] > 0) & (deviation[1:] <= 0))
    crossing = down + deviation[down] / (deviation[down] - deviation[down + 1])
    assert np.diff(crossing).mean() * DT == pytest.approx(1.622, rel=5e-3)


def test_reward_is_that_of_the_state_before(compiled):
    task = compiled("Pendulum")
    angles = np.float32([0, np.pi / 2, np.pi, -np.pi / 2, 2 * np.pi, 7, 0.3, -9])
    speeds = np.float32([0, 1, -2, 8, 0, 0, 0.5, 3])
    state = task.reset_to(angles[:, None], speeds[:, None])
    reward = task.step(state, np.full((8, 1), 0.5, np.float32)).reward
    wrapped = np.arctan2(np.sin(angles), np.cos(angles))
    # 0.001 u^2 with u = 2 * 0.5
    np.testing.assert_allclose(reward, -(wrapped**2 + 0.1 * speeds**2 + 0.001), atol=2e-5)


def test_resets_are_uniform():
    env = registry.make("Pendulum")
    qpos, qvel = jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 4000))
    for sample, high in ((qpos, np.pi), (qvel, 1.0)):
        sample = np.asarray(sample) / high
        assert np.abs(sample).max() <= 1
        assert abs(sample.mean()) < 0.04 and sample.std() == pytest.approx(3**-0.5, abs=0.02)


def test_extreme_rods_stay_finite(compiled):
    """m = l = 0.01: 6e6 rad/s^2; the speed saturates and nothing becomes NaN."""
    task = compiled("Pendulum")
    state = task.reset(jax.random.split(jax.random.PRNGKey(0), 8), np.full((8, 2), 0.01, np.float32))
    for i in range(50):
        state = task.step(state, np.full((8, 1), (-1.0) ** i, np.float32))
        assert not state.done.any() and np.isfinite(state.obs["policy"]).all()
        assert np.abs(state.obs["policy"][:, 2]).max() <= 8


def test_mjx_agrees_with_mujoco_for_100_steps(compiled, both_engines):
    """Tolerance 1e-3 rad and rad/s: float32 against double, errors grow by up to e^(3.9/s * 5 s) near upright."""
    env, rng = compiled("Pendulum").env, np.random.default_rng(3)
    for _ in range(3):
        commands = rng.uniform(-2, 2, (100, 1))
        fast, exact = both_engines(env, rng.uniform(-3, 3, 1), rng.uniform(-1, 1, 1), commands)
        for x, y in zip(fast, exact, strict=True):
            np.testing.assert_allclose(x, y, atol=1e-3)


def test_the_episode_ends_by_time_only():
    env = registry.make("Pendulum", episodeLength=5)
    step, state = jax.jit(env.step), env.reset(jax.random.PRNGKey(0))
    ends = []
    for _ in range(5):
        state = step(state, np.ones(1, np.float32))
        ends.append((float(state.done), float(state.info["truncated"])))
    assert ends == [(0, 0)] * 4 + [(0, 1)]
