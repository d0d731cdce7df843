"""The learned embedding: what it must not see, what it must be able to learn."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from scipy.special import ndtr

from bayessim_mjx.errors import UserError
from bayessim_mjx.inference import InferenceSettings, condition, fit, init
from bayessim_mjx.inference.summaries.learned import Embedding
from bayessim_mjx.inference.summarizers import summary_learned
from bayessim_mjx.parameters import Parameter, ParameterSpace

EMBEDDING = Embedding(steps=12, state_size=2, action_size=1, features=4, width=8, window=3)


pytestmark = [pytest.mark.usefixtures("strict"), pytest.mark.slow, pytest.mark.ci]


def trajectories(count: int, steps: int = 12, seed: int = 0) -> tuple[jax.Array, jax.Array]:
    rng = np.random.default_rng(seed)
    states = rng.normal(size=(count, steps + 1, 2)) * [10.0, 0.1] + [5.0, -3.0]
    return jnp.asarray(states, jnp.float32), jnp.asarray(rng.normal(size=(count, steps, 1)), jnp.float32)


def standardised(embedding: Embedding, rows: jax.Array) -> jax.Array:
    mean, rate = embedding.scales(rows, jnp.ones(len(rows), bool))
    return (rows - mean[None]) * rate[None]


def test_rows_come_back_as_the_trajectory_and_its_context():
    states, actions = trajectories(3)
    valid = jnp.ones((3, 12)).at[1, 5:].set(0.0)
    rows = jax.vmap(summary_learned)(states, actions, valid)
    assert rows.shape == (3, EMBEDDING.row_size)
    s, change, a, v, context = EMBEDDING.unpack(jnp.concatenate([rows, jnp.full((3, 2), 7.0)], axis=1))
    np.testing.assert_array_equal(s[0], states[0])
    np.testing.assert_array_equal(a[0], actions[0])
    np.testing.assert_array_equal(s[1, 6:], jnp.tile(states[1, 5], (7, 1)))
    np.testing.assert_array_equal(change[1], jnp.diff(s[1], axis=0))
    np.testing.assert_array_equal(v, valid)
    np.testing.assert_array_equal(context, np.full((3, 2), 7.0))


def test_scales_are_those_of_the_channels_and_leave_the_mask_alone():
    states, actions = trajectories(2000)
    rows = jnp.concatenate([jax.vmap(summary_learned)(states, actions), states[:, 0, :1]], axis=1)
    unusable = rows.at[0].set(1e9)
    mean, rate = EMBEDDING.scales(unusable, jnp.arange(2000) > 0)
    s, change, a, valid, context = EMBEDDING.unpack(mean[None])
    np.testing.assert_allclose(s[0], np.tile([5.0, -3.0], (13, 1)), atol=0.3)
    np.testing.assert_array_equal(valid, 0 * valid)
    s, change, a, valid, context = EMBEDDING.unpack(1 / rate[None])
    np.testing.assert_allclose(s[0], np.tile([10.0, 0.1], (13, 1)), rtol=0.03)
    np.testing.assert_allclose(change[0], np.sqrt(2) * s[0, 1:], rtol=0.03)
    np.testing.assert_allclose(a[0], np.ones((12, 1)), rtol=0.03)
    np.testing.assert_array_equal(valid, np.ones((1, 12)))
    np.testing.assert_allclose(context, [[10.0]], rtol=0.05)
    # a constant channel is dropped; steps after an end have no say
    still = jax.vmap(summary_learned)(states.at[..., 0].set(5.0), actions, jnp.ones((2000, 12)).at[:, 1:].set(0.0))
    _, rate = EMBEDDING.scales(still.at[:, 4:26].set(1e4), jnp.ones(2000, bool))
    assert float(rate[0]) == 0.0 and float(1 / rate[1]) == pytest.approx(0.1, rel=0.05)


@pytest.mark.parametrize("window", [1, 3])
def test_what_comes_after_the_end_does_not_count(window):
    embedding = dataclasses.replace(EMBEDDING, window=window)
    states, actions = trajectories(4)
    valid = jnp.ones((4, 12)).at[:, 7:].set(0.0)
    params = jax.jit(embedding.init)(jax.random.PRNGKey(0), jnp.zeros((1, embedding.row_size)))
    apply = jax.jit(embedding.apply)

    def rows(states, actions):
        parts = states, jnp.diff(states, axis=1), actions, valid
        return jnp.concatenate([part.reshape(4, -1) for part in parts], axis=1)

    x = apply(params, rows(states, actions))
    assert x.shape == (4, 4) == (4, embedding.size(embedding.row_size)) and bool(jnp.all(jnp.isfinite(x)))
    np.testing.assert_array_equal(x, apply(params, rows(states.at[:, 8:].set(1e3), actions.at[:, 7:].set(-9.0))))
    assert not np.allclose(x, apply(params, rows(states.at[:, 7].add(1.0), actions)))
    assert not np.allclose(x, apply(params, rows(states, actions.at[:, 6].add(1.0))))
    np.testing.assert_allclose(jax.vmap(embedding.apply, (None, 0))(params, rows(states, actions)), x, atol=1e-5)
    context = jnp.concatenate([rows(states, actions), jnp.full((4, 2), 3.0)], axis=1)
    np.testing.assert_allclose(apply(params, context), np.concatenate([x, np.full((4, 2), 3.0)], axis=1), atol=1e-6)


def test_an_ensemble_maps_over_keys_and_parameters():
    rows = jnp.ones((5, EMBEDDING.row_size))
    members = jax.jit(jax.vmap(EMBEDDING.init, (0, None)))(jax.random.split(jax.random.PRNGKey(0), 3), rows)
    x = jax.jit(jax.vmap(EMBEDDING.apply, (0, None)))(members, rows)
    assert x.shape == (3, 5, 4) and not np.allclose(x[0], x[1])


@pytest.mark.parametrize("window", [1, 3])
def test_it_learns_a_gain_that_no_single_step_shows(window):
    """s' = s + g a + noise: least squares gives the answer, and the embedding must come near it on unseen data."""
    embedding = dataclasses.replace(EMBEDDING, window=window, features=1, width=16)

    def simulate(seed: int) -> tuple[jax.Array, jax.Array, np.ndarray]:
        rng = np.random.default_rng(seed)
        gain, actions = rng.uniform(-1, 1, (1500, 1)), rng.normal(size=(1500, 12, 1))
        change = gain[:, None] * actions + 0.5 * rng.normal(size=(1500, 12, 1))
        states = np.concatenate([np.zeros((1500, 1, 1)), np.cumsum(change, axis=1)], axis=1)
        squares = np.sum(actions * change, axis=1) / (np.sum(actions**2, axis=1) + 0.5**2 * 3)
        states = jnp.asarray(np.concatenate([states, 0 * states], axis=2), jnp.float32)
        rows = jax.vmap(summary_learned)(states, jnp.asarray(actions, jnp.float32))
        return standardised(embedding, rows), jnp.asarray(gain, jnp.float32), np.mean((squares - gain) ** 2)

    rows, gain, _ = simulate(0)
    params = jax.jit(embedding.init)(jax.random.PRNGKey(1), rows)
    optimiser = optax.adam(1e-2)

    def loss(params, rows, gain):
        return jnp.mean((embedding.apply(params, rows) - gain) ** 2)

    @jax.jit
    def train(params):
        def step(carry, i):
            at = (jnp.arange(250) + 250 * i) % 1500
            gradient = jax.grad(loss)(carry[0], rows[at], gain[at])
            with jax.numpy_dtype_promotion("standard"):
                updates, state = optimiser.update(gradient, carry[1], carry[0])
            return (optax.apply_updates(carry[0], updates), state), None

        return jax.lax.scan(step, (params, optimiser.init(params)), jnp.arange(250))[0][0]

    unseen, truth, best = simulate(1)
    assert float(loss(train(params), unseen, truth)) < 1.6 * best < 0.2 * np.var(truth)


@pytest.mark.slow
def test_the_fit_trains_it_end_to_end():
    """s' = s + g a + noise: nearly all that twelve steps say, far more than the first alone (a fixed summary)."""
    space = ParameterSpace([Parameter("gain", 0.0, -1.0, 1.0)])
    embedding = Embedding(steps=12, state_size=1, action_size=1, features=4, width=16, window=1)

    def simulate(seed: int, n: int) -> tuple[jax.Array, jax.Array]:
        rng = np.random.default_rng(seed)
        gain, actions = rng.uniform(-1, 1, (n, 1)), rng.normal(size=(n, 12, 1))
        change = gain[:, None] * actions + 0.5 * rng.normal(size=(n, 12, 1))
        states = np.concatenate([np.zeros((n, 1, 1)), np.cumsum(change, axis=1)], axis=1)
        gain, states, actions = (jnp.asarray(v, jnp.float32) for v in (gain, states, actions))
        return gain, jax.vmap(summary_learned)(states, actions)

    settings = InferenceSettings(
        components=1, hiddenLayers=(16,), min_steps=300, max_steps=300, lr=1e-2, batch=128, embedding=embedding
    )
    state = init(jax.random.PRNGKey(2), settings, space, embedding.row_size)
    state, _ = fit(jax.random.PRNGKey(3), state, *simulate(0, 1500))
    gain, rows = simulate(1, 300)
    found = float(jnp.mean(jax.vmap(lambda q, theta: q.log_gain(theta))(condition(state, rows), gain)))
    # the first step: I(g; change | a) = E_a[h(change) - h(noise)], change being uniform on [-|a|, |a|] plus noise
    a, x = np.abs(np.random.default_rng(2).normal(size=(500, 1))), np.linspace(-6, 6, 1201)
    density = (ndtr((x + a) / 0.5) - ndtr((x - a) / 0.5)) / (2 * a)
    entropy = -np.trapezoid(density * np.log(np.maximum(density, 1e-300)), x, axis=1)
    fixed = float(np.mean(entropy) - 0.5 * np.log(2 * np.pi * np.e * 0.5**2))
    # all twelve: ln 2 - E[ln(0.5 sqrt(2 pi e) / |a|)] = 1.17, |a|^2 chi-square with 12 degrees of freedom
    assert fixed < 0.4 and 0.95 < found < 1.35, (fixed, found)


def test_bad_sizes_are_refused():
    with pytest.raises(UserError, match="window = 13: a trajectory of 12 steps"):
        dataclasses.replace(EMBEDDING, window=13)
    with pytest.raises(UserError, match="features = 0"):
        dataclasses.replace(EMBEDDING, features=0)
    with pytest.raises(UserError, match=r"rows of 40 columns; 12 steps of 2 states and 1 actions need 74"):
        EMBEDDING.apply({}, jnp.zeros((1, 40)))
