"""Cartpole against the equations of motion, by hand."""

import jax
import numpy as np
import pytest

from bayessim_mjx import registry
from bayessim_mjx.physics import control_step, mjx

G, L, INERTIA = 9.81, 0.47, 0.0836 + 0.47**2  # m/s^2, m, kg m^2 about the hinge (pole 1 kg, cart 1 kg)


forward = jax.jit(mjx.forward)


def accelerations(env, angle, force):
    """(cart, pole) accelerations at rest, model without parameters."""
    data = env.physics.template.replace(qpos=np.float32([0.0, angle]), ctrl=np.float32([force]))
    return np.asarray(forward(env.physics.model, data).qacc)


def test_golden_accelerations(compiled):
    env = compiled("Cartpole").env
    cart, pole = accelerations(env, 0.01, 0.0)
    assert pole == pytest.approx(0.2376, rel=5e-4) and cart == pytest.approx(0.0558, rel=1e-3)
    cart, pole = accelerations(env, 0.0, 400.0)
    assert cart == pytest.approx(400 / (2 - L**2 / INERTIA), rel=1e-4) == pytest.approx(313.8, rel=1e-3)
    assert pole == pytest.approx(cart * L / INERTIA, rel=1e-4) == pytest.approx(484, rel=1e-3)


def test_heavy_cart_leaves_the_pole_a_pendulum(compiled):
    """With the cart 20 times as heavy, theta_dd tends to m g l sin(theta) / I = 15.14 theta (within 1/21)."""
    env = compiled("Cartpole").env
    theta = env.space.vector({"cart_mass_mult": 20.0})
    world = env.physics.world(theta, np.array([0.0, 0.01]), np.zeros(2))
    pole = forward(env.physics.model_of(world), env.physics.data_of(world)).qacc[1]
    assert pole / 0.01 == pytest.approx(G * L / INERTIA, rel=0.06)


def test_damping_and_stiffness_do_what_they_say(compiled):
    """Against the coupled equations of motion in double precision, implicit in the damping as MuJoCo's Euler is."""
    env = compiled("Cartpole").env
    names = {"slider_to_cart_stiffness": 2.0, "cart_to_pole_stiffness": 0.4}
    damping = {"slider_to_cart_damping": 60.0, "cart_to_pole_damping": 20.0}
    world = env.physics.world(env.space.vector(names | damping), np.array([0.5, 0.3]), np.array([1.0, -2.0]))
    step = jax.jit(lambda w: control_step(env.physics, w, np.float32([30.0]))[0])
    q, v, h = np.array([0.5, 0.3]), np.array([1.0, -2.0]), 1 / 120
    for _ in range(60):
        world = step(world)
        for _ in range(2):
            coupling = -L * np.cos(q[1])  # theta about +x tips to -y
            mass = np.array([[2.0, coupling], [coupling, INERTIA]])
            bias = np.array([L * np.sin(q[1]) * v[1] ** 2, -G * L * np.sin(q[1])])
            c = np.diag([60.0, 20.0])
            force = np.array([30.0 - 2.0 * q[0], -0.4 * q[1]]) - c @ v - bias
            v = v + h * np.linalg.solve(mass + h * c, force)
            q = q + h * v
    np.testing.assert_allclose(world.qpos, q, atol=1e-4)
    np.testing.assert_allclose(world.qvel, v, atol=1e-4)


def test_inert_parameters_do_not_move_anything(compiled):
    """Friction, restitution and the slider's mass: seven of thirteen cannot be identified."""
    env = compiled("Cartpole").env
    inert = [n for n in env.space.names if "friction" in n or "restitution" in n or n.startswith("slider_mass")]
    assert len(inert) == 7 and len(env.space) == 13
    task = compiled("Cartpole")
    theta = np.asarray(env.space.vector(env.real_parameters))
    other = env.space.vector(env.space.as_dict(theta) | {n: float(env.space.low[env.space.index(n)]) for n in inert})
    keys = np.tile(np.asarray(jax.random.PRNGKey(1)), (8, 1))
    state = task.reset(keys, np.stack([theta, other] * 4))
    for _ in range(20):
        state = task.step(state, np.full((8, 1), 0.3, np.float32))
    qpos = np.asarray(state.pipeline_state.qpos)
    assert np.ptp(qpos[0] - task.env.mj_model.qpos0) > 0.01  # it moved
    np.testing.assert_allclose(qpos[1], qpos[0], atol=1e-6)  # other lanes of vector code may round otherwise


def test_order_of_parameters_is_bayessimigs():
    names = registry.make("Cartpole").space.names
    assert names[:3] == ("slider_mass_mult", "cart_mass_mult", "pole_mass_mult")
    assert names[3:5] == ("slider_friction_mult", "slider_restitution")
    assert names[9:] == (
        "slider_to_cart_stiffness", "cart_to_pole_stiffness", "slider_to_cart_damping", "cart_to_pole_damping",
    )  # fmt: skip


def test_rewards_and_ends(compiled):
    task = compiled("Cartpole")
    qpos = np.float32([[0, 0], [0.5, 0.3], [3.2, 0], [-3.2, 0], [0, 1.7], [0, -1.7], [2.9, 0], [0, 1.4]])
    qvel = np.float32([[0, 0], [1, -2]] + [[0, 0]] * 6)
    after = task.step(task.reset_to(qpos, qvel), np.zeros((8, 1), np.float32))
    q, v = np.asarray(after.pipeline_state.qpos), np.asarray(after.pipeline_state.qvel)
    alive = 1 - q[:, 1] ** 2 - 0.01 * np.abs(v[:, 0]) - 0.005 * np.abs(v[:, 1])
    fallen = np.array([0, 0, 1, 1, 1, 1, 0, 0], bool)
    assert np.array_equal(after.done, fallen)
    np.testing.assert_allclose(after.reward, np.where(fallen, -2, alive), atol=1e-6)
    np.testing.assert_allclose(after.obs["policy"], np.stack([q[:, 0], v[:, 0], q[:, 1], v[:, 1]], 1))


def test_resets_are_uniform():
    env = registry.make("Cartpole")
    qpos, qvel = jax.vmap(env.initial)(jax.random.split(jax.random.PRNGKey(0), 4000))
    for sample in (np.asarray(qpos) / 0.1, np.asarray(qvel) / 0.25):
        assert np.abs(sample).max() <= 1 + 1e-6
        assert np.abs(sample.mean(0)).max() < 0.04 and sample.std() == pytest.approx(3**-0.5, abs=0.02)


def test_mjx_agrees_with_mujoco_for_100_steps(compiled, both_engines):
    """Tolerance 2e-3 of some metres, 2e-2 of some 10/s: the falling pole multiplies float32's error."""
    env, rng = compiled("Cartpole").env, np.random.default_rng(3)
    for _ in range(3):
        commands = rng.uniform(-40, 40, (100, 1))
        fast, exact = both_engines(env, rng.uniform(-0.1, 0.1, 2), rng.uniform(-0.25, 0.25, 2), commands)
        np.testing.assert_allclose(fast[0], exact[0], atol=2e-3)
        np.testing.assert_allclose(fast[1], exact[1], atol=2e-2)


def test_reset_distance_is_a_setting():
    env = registry.make("Cartpole", resetDist=1.0)
    state = env.step(env.reset_to(np.float32([1.1, 0]), np.zeros(2, np.float32)), np.zeros(1, np.float32))
    assert state.done == 1 and state.reward == -2
