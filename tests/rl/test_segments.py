"""Advantages over segments, estimated anew in every minibatch: against sums by hand and against the whole batch's."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import losses, segments, transitions, worlds
from bayessim_mjx.rl.catalogue import learner

CONFIG = PPOConfig(
    num_envs=4, num_steps=6, num_epochs=2, num_minibatches=2, segment=3, normalize_advantage_per_minibatch=True,
    schedule="fixed", hidden_actor=(8,), hidden_critic=(), gamma=0.5, gae_lambda=0.8, use_clipped_value_loss=False,
)  # fmt: skip
IDENTITY = [{"w": jnp.ones((1, 1)), "b": jnp.zeros(1)}]  # a critic that says what it sees


def batch(seen, future):
    """A batch of segments with the critic's observations [S, L] and nothing of interest besides."""
    seen = jnp.asarray(seen, jnp.float32)
    blank = jnp.zeros(seen.shape)
    return losses.Batch(seen[..., None], seen[..., None], *[blank[..., None]] * 2, *[blank] * 4, future=future)


def future(reward, terminated, truncated, next_value, last):
    rows = (jnp.asarray(x, jnp.float32) for x in (reward, terminated, truncated, next_value))
    return segments.Future(*rows, jnp.asarray(last, jnp.float32)[:, None])


def estimates(seen, ahead, scale=1.0):
    """Advantages and returns by a critic that says `scale` times what it sees."""
    params = {"critic": {"layers": [{"w": scale * IDENTITY[0]["w"], "b": IDENTITY[0]["b"]}]}}
    found = segments.renewed(params, batch(seen, ahead), CONFIG)[0]
    assert found.future is None and found.observation.shape == (np.size(seen), 1)
    return np.asarray(found.advantage), np.asarray(found.returns)


def test_segments_are_steps_in_a_row_of_one_world():
    x = jnp.arange(6)[:, None] * 10 + jnp.arange(2)  # step t of world n is 10 t + n
    expected = [[0, 10, 20], [1, 11, 21], [30, 40, 50], [31, 41, 51]]
    ahead = segments.ended(segments.Future(x, x, x, x, x[..., None]), 3)
    found = segments.cut(losses.Batch(*[x] * 8, future=ahead), 3)
    np.testing.assert_array_equal(found.future.reward, expected)
    np.testing.assert_array_equal(found.value, expected)
    np.testing.assert_array_equal(found.future.last[:, 0], [20, 21, 50, 51])


def test_sums_by_hand():
    # V = 1, 2, 3 and 4 after the end; delta = r + V'/2 - V = 1, 0.5, 0; gamma lambda = 0.4
    free = estimates([[1, 2, 3]], future([[1, 1, 1]], [[0, 0, 0]], [[0, 0, 0]], [[9, 9, 9]], [4]))
    np.testing.assert_allclose(free, [[1.2, 0.5, 0.0], [2.2, 2.5, 3.0]], rtol=1e-6)
    # a termination is worth nothing afterwards: delta_1 = 1 - 2, and nothing later counts before it
    ended = estimates([[1, 2, 3]], future([[1, 1, 1]], [[0, 1, 0]], [[0, 0, 0]], [[9, 9, 9]], [4]))
    np.testing.assert_allclose(ended[0], [1 - 0.4, -1.0, 0.0], atol=1e-6)
    # where an episode is cut off, the critic that collected says what the true next observation is worth: 9
    cut = estimates([[1, 2, 3]], future([[1, 1, 1]], [[0, 0, 0]], [[0, 1, 0]], [[7, 9, 7]], [4]))
    np.testing.assert_allclose(cut[0], [1 + 0.4 * 3.5, 1 + 4.5 - 2, 0.0], rtol=1e-6)


def test_a_critic_that_has_learnt_since_gives_other_advantages():
    ahead = future([[1, 1, 1]], [[0, 0, 0]], [[0, 0, 0]], [[9, 9, 9]], [4])
    advantage, returns = estimates([[1, 2, 3]], ahead, scale=2.0)  # V = 2, 4, 6 and 8; delta = 1, 0, -1
    np.testing.assert_allclose(advantage, [1 - 0.16, -0.4, -1.0], rtol=1e-6)
    np.testing.assert_allclose(returns, advantage + np.array([2, 4, 6]), rtol=1e-6)


def test_what_targets_are_made_of_gets_no_gradient():
    ahead = future([[1, 1, 1]], [[0, 0, 0]], [[0, 0, 0]], [[9, 9, 9]], [4])

    def total(params):
        found = segments.renewed(params, batch([[1, 2, 3]], ahead), CONFIG)[0]
        return found.advantage.sum() + found.returns.sum()

    gradient = jax.grad(total)({"critic": {"layers": IDENTITY}})
    assert all(not np.any(leaf) for leaf in jax.tree.leaves(gradient))


def test_the_values_to_learn_from_are_the_critics_and_keep_their_gradient():
    ahead = future([[1, 1, 1]], [[0, 0, 0]], [[0, 0, 0]], [[9, 9, 9]], [4])
    shared = {"critic": {"layers": IDENTITY}}
    values, gradient = jax.value_and_grad(lambda p: segments.renewed(p, batch([[1, 2, 3]], ahead), CONFIG)[1].sum())(
        shared
    )
    assert float(values) == 6.0
    assert float(gradient["critic"]["layers"][0]["w"].sum()) == 6.0  # d/dw of sum w x


def test_one_segment_of_all_steps_is_the_estimate_of_the_whole_batch():
    from tests.rl import probes

    config = dataclasses.replace(CONFIG, segment=6, hidden_critic=(8,), gamma=0.9)
    env = probes.Walk()
    env.dt = 1.0
    state = rl.init(env, config, jax.random.PRNGKey(0))
    _, data = worlds.gather(learner(env, config), state, None, jax.random.PRNGKey(1))
    cut = transitions.batch(learner(env, config), state, data, state.normalizer)
    uncut = learner(env, dataclasses.replace(config, segment=0))
    whole = transitions.batch(uncut, state, data, state.normalizer)
    assert cut.advantage.shape == (4, 6) and cut.future.last.shape[0] == 4
    renewed = segments.renewed(state.params, cut, config)[0]
    for name in ("advantage", "returns"):  # step-major there, world-major here
        of_whole = getattr(whole, name).reshape(6, 4).T.reshape(-1)
        np.testing.assert_allclose(getattr(renewed, name), of_whole, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"segment": 4}, "ppo.segment = 4 has to divide ppo.num_steps = 6"),
        ({"num_minibatches": 9}, "fewer segments than ppo.num_minibatches = 9"),
        ({"normalize_advantage_per_minibatch": False}, "normalize_advantage_per_minibatch=True"),
        ({"memory": 4}, "not with ppo.memory"),
    ],
)
def test_what_does_not_go_together_is_refused(changes, words):
    with pytest.raises(UserError, match=words):
        dataclasses.replace(CONFIG, **changes)
