"""Networks, the Gaussian, and the policy that is handed out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from bayessim_mjx.rl import networks, normalise
from bayessim_mjx.rl.networks import Policy


def test_weights_are_orthogonal_and_the_first_policy_is_nearly_its_noise():
    params = networks.init(jax.random.PRNGKey(0), 5, 7, 2, (16, 16), (8,), 0.5)
    w = np.asarray(params["actor"]["layers"][1]["w"])
    np.testing.assert_allclose(w @ w.T, 2 * np.eye(16), atol=1e-5)
    obs = jax.random.normal(jax.random.PRNGKey(1), (100, 5))
    assert jnp.abs(networks.mean_action(params, obs, jax.nn.elu)).max() < 0.1
    np.testing.assert_allclose(jnp.exp(params["actor"]["log_std"]), 0.5, rtol=1e-6)
    assert params["critic"]["layers"][0]["w"].shape == (7, 8)


def test_log_prob_and_entropy_equal_scipys():
    mean, std, x = np.array([0.3, -1.0]), np.array([0.5, 2.0]), np.array([1.0, 0.0])
    normal = stats.norm(mean, std)
    assert networks.log_prob(mean, jnp.log(std), x) == pytest.approx(normal.logpdf(x).sum(), rel=1e-5)
    assert networks.entropy(jnp.log(std)) == pytest.approx(normal.entropy().sum(), rel=1e-5)


def test_kl_is_zero_for_equal_and_known_for_different_gaussians():
    zero, one = jnp.zeros(1), jnp.ones(1)
    assert networks.kl(one, 0.3 * one, one, 0.3 * one) == 0
    assert networks.kl(zero, zero, one, jnp.log(2) * one) == pytest.approx(0.443147, rel=1e-5)
    assert networks.kl(one, jnp.log(2) * one, zero, zero) == pytest.approx(1.306853, rel=1e-5)


def policy(**changes):
    params = networks.init(jax.random.PRNGKey(0), 3, 3, 2, (8,), (8,), 1.0)
    return Policy(params["actor"], normalise.init(3), **changes)


def test_the_deterministic_action_is_the_mean_and_samples_spread_about_it():
    p, obs = policy(), jnp.array([0.1, -0.2, 0.3])
    mean, _ = p.distribution(obs)
    np.testing.assert_array_equal(p.act(None, obs), mean)
    np.testing.assert_array_equal(p.replace(deterministic=True)(jax.random.PRNGKey(5), {"policy": obs}), mean)
    keys = jax.random.split(jax.random.PRNGKey(1), 2000)
    actions = jax.vmap(lambda k: p.replace(action_clip=100.0).act(k, obs))(keys)
    np.testing.assert_allclose(actions.mean(0), mean, atol=0.08)
    np.testing.assert_allclose(actions.std(0), 1, atol=0.05)
    assert jnp.abs(jax.vmap(lambda k: p.act(k, obs))(keys)).max() == 1.0


def test_the_policy_normalises_with_its_own_statistics():
    moments = normalise.update(normalise.init(3), 5 + 2 * jax.random.normal(jax.random.PRNGKey(0), (100, 3)))
    raw = jnp.array([1.0, 2.0, 9.0])
    inside = policy().replace(normalizer=moments).act(None, raw)
    outside = policy(normalize=False).act(None, normalise.normalise(moments, raw))
    np.testing.assert_array_equal(inside, outside)
    assert (inside != policy().act(None, raw)).any()


def test_unknown_activation_is_refused_by_name():
    with pytest.raises(ValueError, match=r"ppo.activation = 'foo'.*elu"):
        networks.activation("foo")
