"""From trajectories of a toy pendulum to a posterior over length and damping, summaries included."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.inference import InferenceSettings, calibration, condition, fit, infer, init, summarizers
from bayessim_mjx.parameters import Parameter, ParameterSpace

SPACE = ParameterSpace([Parameter("length", 1.0, 0.3, 1.5), Parameter("damping", 0.1, 0.02, 0.5)])
DT, STEPS = 0.05, 30


def simulate(key: jax.Array, theta: jax.Array) -> tuple[jax.Array, jax.Array]:
    """q'' = -(9.81 / L) sin q - (b q' - u) / L^2 under random torques, measured with noise."""
    key_u, key_q, key_noise = jax.random.split(key, 3)
    torque = jax.random.uniform(key_u, (STEPS, 1), minval=-1.5, maxval=1.5)
    length, damping = theta[0], theta[1]

    def step(state, u):
        q, v = state
        v = v + DT * (-9.81 / length * jnp.sin(q) - (damping * v - u[0]) / length**2)
        q = q + DT * v
        return (q, v), jnp.stack([jnp.cos(q), jnp.sin(q), v])

    q0 = jax.random.uniform(key_q, minval=-2.0, maxval=2.0)
    first = jnp.stack([jnp.cos(q0), jnp.sin(q0), 0.0 * q0])
    _, states = jax.lax.scan(step, (q0, 0.0 * q0), torque)
    states = jnp.concatenate([first[None], states])
    return states + 0.02 * jax.random.normal(key_noise, states.shape), torque


@pytest.mark.slow
@pytest.mark.parametrize("name", ["summary_start", "summary_corrdiff"])
def test_length_and_damping_of_a_pendulum_are_found(name):
    summarize = summarizers.get(name)
    observe = jax.jit(jax.vmap(lambda key, theta: summarize(*simulate(key, theta))))
    rng = np.random.default_rng(0)
    thetas = jnp.asarray(rng.uniform(SPACE.low, SPACE.high, (3000, 2)), jnp.float32)
    x = observe(jax.random.split(jax.random.PRNGKey(0), 3000), thetas)
    settings = InferenceSettings(components=4, hiddenLayers=(64,), max_steps=1000)
    state = init(jax.random.PRNGKey(1), settings, SPACE, x.shape[1])
    state, info = fit(jax.random.PRNGKey(2), state, thetas, x)
    assert float(info.gain_truncated) > 0.8  # nats over the prior

    truth = np.asarray([0.8, 0.2], np.float32)
    real = observe(jax.random.split(jax.random.PRNGKey(3), 8), jnp.tile(truth, (8, 1)))
    one, all_ = infer(state, real[:1]), infer(state, real)
    assert float(all_.mean()[0]) == pytest.approx(0.8, abs=0.08)
    assert np.all(np.asarray(all_.sd()) < np.asarray(one.sd()))
    assert float(all_.contraction()[0]) > 0.95
    # calibrated at 3000 simulations: within 3 standard errors of nominal, and a little for what the fit itself varies
    fresh = jnp.asarray(rng.uniform(SPACE.low, SPACE.high, (500, 2)), jnp.float32)
    seen = observe(jax.random.split(jax.random.PRNGKey(4), 500), fresh)
    report = calibration.check(jax.random.PRNGKey(5), condition(state, seen), fresh)
    for nominal, (share, error) in report.coverage.items():
        assert share == pytest.approx(nominal, abs=3 * error + 0.03), report.table()
