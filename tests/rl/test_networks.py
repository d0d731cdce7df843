"""Networks, the Gaussian, and the policy that is handed out."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import networks, normalise
from bayessim_mjx.rl.networks import Policy


def made(policy, critic, action, hidden_actor, hidden_critic, init_std, **changes):
    """Parameters for observations of `policy` and `critic` numbers."""
    config = PPOConfig(hidden_actor=hidden_actor, hidden_critic=hidden_critic, init_std=init_std, **changes)
    return networks.init(jax.random.PRNGKey(0), networks.Sizes(policy, critic, action), config)


def test_weights_are_orthogonal_and_the_first_policy_is_nearly_its_noise():
    params = made(5, 7, 2, (16, 16), (8,), 0.5)
    w = np.asarray(params["actor"]["layers"][1]["w"])
    np.testing.assert_allclose(w @ w.T, 2 * np.eye(16), atol=1e-5)
    obs = jax.random.normal(jax.random.PRNGKey(1), (100, 5))
    assert jnp.abs(networks.mean_action(params, obs, jax.nn.elu)).max() < 0.1
    np.testing.assert_allclose(jnp.exp(params["actor"]["log_std"]), 0.5, rtol=1e-6)
    assert params["critic"]["layers"][0]["w"].shape == (7, 8)


SPREADS = (
    {"state_dependent_std": True, "weight_init": "lecun_uniform"},
    {"distribution": "beta"},
    {"distribution": "beta", "weight_init": "lecun_uniform"},
    {"memory": 6, "memory_layers": 3, "weight_init": "lecun_uniform"},
)


@pytest.mark.parametrize("hidden", [(16,), (16, 16), (16, 16, 16)])
@pytest.mark.parametrize("changes", SPREADS)
def test_no_two_first_weights_are_drawn_alike(changes, hidden):
    """Random numbers are the same only where two draws have one key; a row has several, which chance repeats never."""
    params = made(6, 7, 6, hidden, hidden, 0.5, **changes)
    columns = [tuple(c) for w in jax.tree.leaves(params) if w.ndim == 2 for c in np.round(np.float64(w.T), 6) if any(c)]
    assert len(set(columns)) == len(columns) > 12


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
    params = made(3, 3, 2, (8,), (8,), 1.0)
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


def squashed(**changes):
    return policy(squash=True, action_clip=2.0, **changes)


def test_squashed_actions_stay_within_their_bounds_and_the_mode_is_the_squashed_mean():
    p, obs = squashed(), jnp.array([0.1, -0.2, 0.3])
    np.testing.assert_allclose(p.act(None, obs), 2 * np.tanh(p.distribution(obs)[0]), rtol=1e-6)
    actions = jax.vmap(lambda k: p.act(k, obs))(jax.random.split(jax.random.PRNGKey(1), 1000))
    assert 1.9 < jnp.abs(actions).max() < 2.0


def test_the_density_of_squashed_actions_integrates_to_one():
    """Change of variables: p(a) da over a in (-2, 2)^2, midpoints; the Gaussian's own density would not do."""
    p, obs = squashed(), jnp.array([0.1, -0.2, 0.3])
    line = -2 + (np.arange(400) + 0.5) / 100
    actions = np.stack(np.meshgrid(line, line), -1)
    density = np.exp(p.log_prob(obs, jnp.arctanh(jnp.asarray(actions, jnp.float32) / 2)))
    assert density.sum() * 0.01**2 == pytest.approx(1.0, abs=1e-3)


def test_squashed_log_prob_by_hand():
    """u = 1: N(1; 0, 1) / (2 (1 - tanh(1)^2)) = 0.2419707 / 0.8399487 in each of the two dimensions."""
    p = squashed(normalize=False)
    p = p.replace(actor=jax.tree.map(jnp.zeros_like, p.actor))
    assert p.log_prob(jnp.zeros(3), jnp.ones(2)) == pytest.approx(2 * np.log(0.2419707 / 0.8399487), rel=1e-5)
    far = networks.log_slope(jnp.array([[40.0], [-40.0]]), 1.0)  # 1 - tanh^2 is 0 in float32 there
    np.testing.assert_allclose(far, 2 * np.log(2) - 80, rtol=1e-6)


@pytest.mark.parametrize("mean, std", [(0.0, 1.0), (1.5, 0.5), (-0.7, 2.0)])
def test_squashed_entropy_equals_the_integral(mean, std):
    u = np.linspace(mean - 12 * std, mean + 12 * std, 200_001)
    density = stats.norm(mean, std).pdf(u)
    log_a = np.log(density + 1e-300) - (np.log(2) + 2 * (np.log(2) - u - np.logaddexp(0, -2 * u)))
    expected = -np.trapezoid(density * log_a, u)
    entropy = networks.squashed_entropy(jnp.array([mean]), jnp.log(jnp.array([std])), 2.0)
    assert entropy == pytest.approx(expected, abs=5e-3)


def test_divergence_of_squashed_policies_is_that_of_their_gaussians():
    """KL = E log p / q, the slopes cancel: by quadrature over actions against the closed form 0.443147."""
    u = np.linspace(-9, 9, 100_001)
    p, q = stats.norm(0, 1), stats.norm(1, 2)
    slope = 1 - np.tanh(u) ** 2 + 1e-300
    a_density_p, a_density_q = p.pdf(u) / slope, q.pdf(u) / slope
    divergence = np.trapezoid(a_density_p * np.log(a_density_p / a_density_q) * slope, u)
    assert networks.kl(jnp.zeros(1), jnp.zeros(1), jnp.ones(1), jnp.log(2.0) * jnp.ones(1)) == pytest.approx(
        divergence, abs=1e-5
    )


def test_a_spread_that_depends_on_the_state_begins_at_init_std_and_stays_bounded():
    params = made(3, 3, 2, (8,), (8,), 0.3, state_dependent_std=True)
    x = jax.random.normal(jax.random.PRNGKey(1), (50, 3))
    mean, log_std = networks.gaussian(params["actor"], x, jnp.tanh)
    assert mean.shape == log_std.shape == (50, 2)
    np.testing.assert_allclose(jnp.exp(log_std), 0.3, rtol=1e-5)
    layers = params["actor"]["layers"]
    layers = [*layers[:-1], {"w": layers[-1]["w"] + 10.0, "b": layers[-1]["b"]}]
    _, log_std = networks.gaussian({"layers": layers}, x, jnp.tanh)
    assert log_std.std() > 1 and jnp.abs(log_std).max() <= 5


def test_lecun_uniform_weights_have_the_variance_of_one_over_their_inputs():
    params = made(50, 80, 30, (400,), (300,), 0.5, state_dependent_std=True, weight_init="lecun_uniform")
    for layer in [*params["actor"]["layers"], *params["critic"]["layers"]]:
        inputs = layer["w"].shape[0]
        assert float(jnp.abs(layer["w"]).max()) <= (3 / inputs) ** 0.5
        assert float(layer["w"].var()) * inputs == pytest.approx(1, abs=0.15)
    spread = networks.gaussian(params["actor"], jnp.zeros((1, 50)), jnp.tanh)[1]
    np.testing.assert_allclose(jnp.exp(spread), 0.5, rtol=1e-5)


def test_means_are_the_same_with_either_kind_of_spread():
    plain, dependent = (made(3, 3, 2, (8,), (8,), 0.3, state_dependent_std=flag) for flag in (False, True))
    x = jnp.ones((4, 3))
    mean = networks.mean_action(plain, x, jnp.tanh)
    np.testing.assert_allclose(networks.mean_action(dependent, x, jnp.tanh), mean, rtol=1e-5)


def test_a_shared_trunk_is_trained_by_both():
    """By hand: trunk tanh(x), critic head 3, actor head 2; values move the trunk's weights."""
    one = lambda w: {"w": jnp.array([[w]]), "b": jnp.zeros(1)}  # noqa: E731
    params = {"actor": {"layers": [one(1.0), one(2.0)], "log_std": jnp.zeros(1)}, "critic": {"head": [one(3.0)]}}
    x = jnp.array([0.5])
    assert networks.value(params, x, jnp.tanh) == pytest.approx(3 * np.tanh(0.5), rel=1e-5)
    assert networks.mean_action(params, x, jnp.tanh)[0] == pytest.approx(2 * np.tanh(0.5), rel=1e-5)
    slope = jax.grad(lambda p: networks.value(p, x, jnp.tanh))(params)["actor"]["layers"]
    assert slope[0]["w"][0, 0] == pytest.approx(3 * 0.5 * (1 - np.tanh(0.5) ** 2), rel=1e-5)
    assert slope[1]["w"][0, 0] == 0
    params = made(5, 5, 2, (8, 6), (3,), 1.0, shared_trunk=True)
    assert params["critic"]["head"][0]["w"].shape == (6, 1)


@pytest.mark.parametrize("activation", ["elu", "tanh"])
def test_half_precision_rounds_what_layers_are_given_and_keeps_sums_gradients_and_results(activation):
    """Beside numpy in float64 on the rounded numbers, of a perceptron without a hidden layer: the sum is exact."""
    params = made(40, 40, 3, (), (), 1.0, activation=activation)["critic"]
    x = jax.random.normal(jax.random.PRNGKey(1), (200, 40))
    whole, half = (
        networks.form(PPOConfig(activation=activation, precision=precision)) for precision in ("float32", "bfloat16")
    )
    layers = params["layers"]
    rounded = [np.asarray(v.astype(jnp.bfloat16), np.float64) for v in (x, layers[0]["w"])]
    got = networks.mlp(layers, x, half)
    assert got.dtype == jnp.float32
    np.testing.assert_allclose(got, rounded[0] @ rounded[1], rtol=1e-5, atol=1e-5)
    assert jnp.abs(got - networks.mlp(layers, x, whole)).max() > 1e-4  # it is not what float32 gives

    deep = made(40, 40, 3, (64, 64), (64, 64), 1.0, activation=activation)["critic"]["layers"]

    def loss(layers, form):
        return (networks.mlp(layers, x, form) ** 2).mean()

    gradients = [jax.grad(loss)(deep, form) for form in (whole, half)]
    for a, b in zip(*map(jax.tree.leaves, gradients), strict=True):
        assert b.dtype == jnp.float32
        assert jnp.linalg.norm(a - b) < 0.02 * jnp.linalg.norm(a) + 1e-4
