"""The losses and the epochs of minibatches, called with numbers whose results are known by hand."""

import dataclasses
import math

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.config import PPOConfig
from bayessim_mjx.rl import losses, networks
from bayessim_mjx.rl.extension import Learner

CONFIG = PPOConfig(
    num_envs=4, num_steps=4, num_epochs=1, num_minibatches=1, schedule="fixed", hidden_actor=(8,), hidden_critic=(8,)
)


def config(**changes):
    return dataclasses.replace(CONFIG, **changes)


def example(size=16, seed=0, cfg=CONFIG):
    """Parameters, and a batch that they collected themselves: old and new policy agree."""
    keys = jax.random.split(jax.random.PRNGKey(seed), 5)
    params = networks.init(keys[0], networks.Sizes(3, 2, 2), dataclasses.replace(cfg, init_std=0.7))
    obs, critic_obs = jax.random.normal(keys[1], (size, 3)), jax.random.normal(keys[2], (size, 2))
    act = networks.activation(cfg.activation)
    mean, log_std = networks.mean_action(params, obs, act), params["actor"]["log_std"]
    action = mean + jnp.exp(log_std) * jax.random.normal(keys[3], mean.shape)
    advantage = jax.random.normal(keys[4], (size,))
    value = networks.value(params, critic_obs, act)
    batch = losses.Batch(
        obs, critic_obs, action, mean, networks.log_prob(mean, log_std, action), value, advantage, value + advantage
    )
    return params, batch


def optimise(params, batch, cfg, rate=1e-3, seed=1):
    state = losses.optimiser_init(params)
    return losses.optimise(jax.random.PRNGKey(seed), params, state, jnp.float32(rate), batch, Learner(None, cfg))


def change(old, new):
    return np.concatenate([np.ravel(b - a) for a, b in zip(jax.tree.leaves(old), jax.tree.leaves(new), strict=True)])


@pytest.mark.parametrize(
    "ratio, advantage, expected", [(1.5, 1, -1.2), (1.5, -1, 1.5), (0.5, 1, -0.5), (0.5, -1, 0.8), (1.1, 2, -2.2)]
)
def test_surrogate_is_clipped_only_where_that_is_pessimistic(ratio, advantage, expected):
    new, old = jnp.array([math.log(ratio) - 3.0]), jnp.array([-3.0])
    assert losses.surrogate_loss(new, old, jnp.array([float(advantage)]), 0.2) == pytest.approx(expected, rel=1e-5)


def test_what_is_worse_than_expected_keeps_its_gradient_however_likely_it_became():
    """min(A r, A clip(r)) with A < 0 is A r: slope -A r up to e^3, -A e^3 from there on; with A > 0 it is clipped."""
    old = jnp.array([-3.0, -3.0, -5.9, -6.1, -200.0, -200.0, -0.0])
    new, advantage = jnp.array([-2.9, -2.9, -3.0, -3.0, 0.0, 0.0, -200.0]), jnp.array([-1.0, 1, -1, -1, -1, 1, 1])

    def each(new, old, advantage):
        return jax.value_and_grad(losses.surrogate_loss)(new, old, advantage, 0.2)

    value, slope = jax.vmap(each)(new[:, None], old[:, None], advantage[:, None])
    edge = math.exp(3)
    np.testing.assert_allclose(
        value, [math.exp(0.1), -math.exp(0.1), math.exp(2.9), edge * 1.1, edge * 198, -1.2, 0], rtol=1e-5, atol=1e-30
    )
    np.testing.assert_allclose(
        slope[:, 0], [math.exp(0.1), -math.exp(0.1), math.exp(2.9), edge, edge, 0, 0], rtol=1e-5, atol=1e-30
    )


@pytest.mark.parametrize(
    "value, clip, expected",
    [(2.0, 0.2, 1.0), (1.0, 0.2, 0.64), (1.0, None, 0.0), (0.1, 0.2, 0.81), (-1.0, 0.2, 4.0)],
)
def test_value_loss_takes_the_worse_of_value_and_clipped_value(value, clip, expected):
    """Old value 0, return 1."""
    loss = losses.value_loss(jnp.array([value]), jnp.zeros(1), jnp.ones(1), clip)
    assert loss == pytest.approx(expected, abs=1e-6)


def test_loss_is_the_weighted_sum_with_entropy_subtracted():
    params, batch = example()
    parts = losses.loss(params, params["actor"]["log_std"], batch, Learner(None, CONFIG))[1]
    cfg = config(value_loss_coef=3.0, entropy_coef=0.5)
    total, _ = losses.loss(params, params["actor"]["log_std"], batch, Learner(None, cfg))
    expected = parts["Loss/surrogate"] + 3 * parts["Loss/value"] - 0.5 * parts["Loss/entropy"]
    assert total == pytest.approx(float(expected), rel=1e-5)
    # mean ratio 1: the surrogate is minus the mean advantage, the value error the mean squared advantage
    assert parts["Loss/surrogate"] == pytest.approx(-float(batch.advantage.mean()), abs=1e-6)
    assert parts["Loss/value"] == pytest.approx(float((batch.advantage**2).mean()), rel=1e-5)
    assert parts["Loss/entropy"] == pytest.approx(2 * (math.log(0.7) + 0.5 * math.log(2 * math.pi * math.e)), rel=1e-5)


def test_entropy_bonus_widens_the_policy():
    params, batch = example()
    batch = batch.replace(advantage=jnp.zeros_like(batch.advantage))
    after, *_ = optimise(params, batch, config(entropy_coef=0.1, num_epochs=5))
    assert (after["actor"]["log_std"] > params["actor"]["log_std"]).all()


def test_reported_kl_is_of_the_old_policy_from_the_new():
    """Old N(0, 1), new N(1, 2^2): log 2 + (1 + 1) / 8 - 1/2; the other way round it would be 1.307."""
    params, batch = example()
    layers = params["actor"]["layers"]
    layers = [*layers[:-1], {"w": 0 * layers[-1]["w"], "b": jnp.array([1.0, 0.0])}]
    params["actor"] = {"layers": layers, "log_std": jnp.log(jnp.array([2.0, 1.0]))}
    metrics = losses.loss(params, jnp.zeros(2), batch.replace(mean=jnp.zeros((16, 2))), Learner(None, CONFIG))[1]
    assert metrics["Loss/kl"] == pytest.approx(math.log(2) + 0.25 - 0.5, rel=1e-5)


def test_clip_fraction_counts_ratios_outside():
    params, batch = example()
    shift = jnp.zeros(16).at[:4].set(0.3)  # ratio exp(-0.3) = 0.74
    metrics = losses.loss(params, jnp.zeros(2), batch.replace(log_prob=batch.log_prob + shift), Learner(None, CONFIG))[
        1
    ]
    assert metrics["Loss/clip_fraction"] == pytest.approx(0.25)


@pytest.mark.parametrize(
    "kl, rate, expected",
    [(0.021, 3e-4, 2e-4), (0.019, 3e-4, 3e-4), (0.006, 3e-4, 3e-4), (0.004, 2e-4, 3e-4), (0.0, 2e-4, 2e-4),
     (1.0, 1.2e-5, 1e-5), (1e-4, 9e-3, 1e-2)],
)  # fmt: skip
def test_adaptive_rate_steps_by_one_and_a_half_within_its_bounds(kl, rate, expected):
    assert losses.adapt(jnp.float32(rate), jnp.float32(kl), 0.01) == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize("rate", [1e-3, 1e-5])
def test_learning_rate_is_applied(rate):
    """Adam's first step is the rate times the sign of the gradient."""
    params, batch = example()
    after, _, new_rate, _ = optimise(params, batch, CONFIG, rate)
    assert np.abs(change(params, after)).max() == pytest.approx(rate, rel=0.02)
    assert new_rate == np.float32(rate)


def test_first_minibatch_leaves_the_adaptive_rate_alone_and_later_ones_obey_it():
    params, batch = example()
    cfg = config(schedule="adaptive", desired_kl=1e-9, num_epochs=3)
    after, _, rate, metrics = optimise(params, batch, cfg)
    assert metrics["Loss/kl"][0] < 1e-10
    assert (metrics["Loss/kl"][1:] > 2e-9).all()
    np.testing.assert_allclose(metrics["Loss/learning_rate"], 1e-3 / np.array([1, 1.5, 2.25]), rtol=1e-5)
    # the same three steps, each at a fixed rate
    expected, state = params, losses.optimiser_init(params)
    for step in range(3):
        fixed, number = config(schedule="fixed"), jnp.float32(1e-3 / 1.5**step)
        batch_ = batch.replace(advantage=batch.advantage)
        expected, state, _, _ = losses.optimise(
            jax.random.PRNGKey(step), expected, state, number, batch_, Learner(None, fixed)
        )
    np.testing.assert_allclose(change(params, after), change(params, expected), atol=2e-6)
    assert rate == pytest.approx(1e-3 / 2.25, rel=1e-5)


def test_adaptive_rate_rises_where_the_policy_hardly_moves():
    params, batch = example()
    _, _, rate, _ = optimise(params, batch, config(schedule="adaptive", desired_kl=10.0, num_epochs=3))
    assert rate == pytest.approx(1e-3 * 2.25, rel=1e-5)


def test_gradient_is_clipped_by_its_global_norm():
    clipped, norm = losses.clip_norm(jnp.array([3.0, 4.0]), 1.0)
    np.testing.assert_allclose(clipped, [0.6, 0.8], rtol=1e-5)
    assert norm == 5.0
    np.testing.assert_array_equal(losses.clip_norm(jnp.array([3.0, 4.0]), 10.0)[0], [3.0, 4.0])


def test_the_optimiser_sees_the_clipped_gradient():
    """Adam's first moment after one step is a tenth of the gradient."""
    params, batch = example()
    _, state, _, metrics = optimise(params, batch, config(max_grad_norm=0.01))
    assert metrics["Policy/grad_norm"][0] > 0.1
    assert jnp.linalg.norm(state.mu) == pytest.approx(0.001, rel=1e-3)
    _, state, _, metrics = optimise(params, batch, config(max_grad_norm=1e6))
    assert jnp.linalg.norm(state.mu) == pytest.approx(0.1 * float(metrics["Policy/grad_norm"][0]), rel=1e-3)


@pytest.mark.parametrize("per_minibatch", [False, True])
def test_advantages_are_standardised(per_minibatch):
    """A shift and a factor on all advantages change nothing."""
    params, batch = example()
    cfg = config(normalize_advantage_per_minibatch=per_minibatch, num_minibatches=2, num_epochs=2)
    moved = batch.replace(advantage=5 + 3 * batch.advantage)
    a, b = optimise(params, batch, cfg)[0], optimise(params, moved, cfg)[0]
    np.testing.assert_allclose(change(params, a), change(params, b), atol=1e-6)
    x = losses.standardise(batch.advantage)
    assert (float(x.mean()), float(x.std())) == pytest.approx((0.0, 1.0), abs=1e-5)


def test_standardising_per_minibatch_or_per_batch_differs():
    params, batch = example()
    a, b = (
        optimise(params, batch, config(normalize_advantage_per_minibatch=flag, num_minibatches=4))[0]
        for flag in (False, True)
    )
    assert np.abs(change(a, b)).max() > 1e-6


def test_minibatches_are_fresh_permutations_of_everything():
    index = losses.minibatches(jax.random.PRNGKey(0), 3, 20, 4).reshape(3, 20)
    for row in index:
        assert sorted(row.tolist()) == list(range(20))
    assert all((index[i] != index[j]).any() for i, j in [(0, 1), (0, 2), (1, 2)])


def test_the_remainder_is_left_out_at_random():
    index = losses.minibatches(jax.random.PRNGKey(0), 8, 10, 3).reshape(8, 9)
    left = [set(range(10)) - set(row.tolist()) for row in index]
    assert all(len(s) == 1 for s in left)
    assert len(set.union(*left)) > 1


def test_how_epochs_are_shuffled_does_not_change_their_order(monkeypatch):
    together = losses.minibatches(jax.random.PRNGKey(1), 3, 50, 2)
    monkeypatch.setattr(losses, "MANY", 50)
    np.testing.assert_array_equal(losses.minibatches(jax.random.PRNGKey(1), 3, 50, 2), together)


def test_every_transition_is_used_once_per_epoch():
    """At rate 0 nothing moves: the minibatches' mean losses average to that of the whole batch, in each epoch."""
    params, batch = example()
    *_, metrics = optimise(params, batch, config(num_epochs=2, num_minibatches=8), rate=0.0)
    whole = float((batch.advantage**2).mean())
    np.testing.assert_allclose(metrics["Loss/value"].reshape(2, 8).mean(1), whole, rtol=1e-5)
    assert metrics["Loss/value"].std() > 0
