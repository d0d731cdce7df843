"""Options of rsl_rl's PPO and distillation: distributions and limits of actions, deeper memories, groups, terms."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.stats

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.env import State
from bayessim_mjx.errors import UserError
from bayessim_mjx.keys import branch
from bayessim_mjx.rl import actions, distil, groups, networks, recurrent
from bayessim_mjx.rl.extension import Learner
from tests.rl import probes
from tests.rl.test_distil import linear

CONFIG = PPOConfig(
    num_envs=16, num_steps=8, num_epochs=1, num_minibatches=2, hidden_actor=(8,), hidden_critic=(8,), log_interval=60
)
A, B = jnp.array([1.3, 4.0]), jnp.array([2.5, 1.1])
LIMIT = 0.8


def change(**settings) -> PPOConfig:
    return dataclasses.replace(CONFIG, **settings)


def beta():
    """scipy's, on [-LIMIT, LIMIT]."""
    return scipy.stats.beta(np.asarray(A), np.asarray(B), loc=-LIMIT, scale=2 * LIMIT)


def test_beta_is_scipys():
    law, raw = actions.Beta(LIMIT), jnp.array([-0.5, 0.7])
    assert law.log_prob(A, B, raw) == pytest.approx(beta().logpdf(np.asarray(raw)).sum(), rel=1e-4)
    assert law.entropy(A, B) == pytest.approx(beta().entropy().sum(), rel=1e-4)
    np.testing.assert_allclose(law.mean(A, B), beta().mean(), rtol=1e-5)
    np.testing.assert_allclose(law.sd(A, B), beta().std(), rtol=1e-5)


def test_divergence_of_betas_is_the_mean_log_ratio():
    law, other = actions.Beta(LIMIT), (jnp.array([2.0, 2.0]), jnp.array([3.0, 1.5]))
    x = np.linspace(-LIMIT, LIMIT, 20_001)[1:-1, None]
    new = scipy.stats.beta(np.asarray(other[0]), np.asarray(other[1]), loc=-LIMIT, scale=2 * LIMIT)
    integral = (beta().pdf(x) * (beta().logpdf(x) - new.logpdf(x))).sum() * (x[1, 0] - x[0, 0])
    assert law.kl(A, B, *other) == pytest.approx(integral, rel=2e-3)
    assert law.kl(A, B, A, B) == 0


def test_samples_of_beta_have_its_moments_and_stay_inside():
    law, n = actions.Beta(LIMIT), 4000
    raw = law.made(law.noise(jax.random.PRNGKey(0), 1, n, 2)[0], jnp.tile(A, (n, 1)), jnp.tile(B, (n, 1)))
    assert raw.shape == (n, 2) and np.abs(raw).max() < LIMIT
    np.testing.assert_allclose(raw.mean(0), beta().mean(), atol=4 * LIMIT / np.sqrt(n))
    np.testing.assert_allclose(raw.std(0), beta().std(), rtol=0.06)
    np.testing.assert_allclose(
        law.drawn(jax.random.PRNGKey(1), jnp.tile(A, (n, 1)), B).mean(0), beta().mean(), atol=0.06
    )


@pytest.mark.slow
@pytest.mark.ci
def test_ppo_with_beta_finds_the_best_action():
    env, config = probes.ActionReward(), change(distribution="beta", num_envs=32, learning_rate=3e-3, num_epochs=4)
    policy, metrics = rl.train(env, config, jax.random.PRNGKey(0), iterations=40)
    obs = jnp.zeros((1, *env.observation_size["policy"]))
    assert policy.act(None, obs)[0, 0] == pytest.approx(0.5, abs=0.12)
    assert 0 < metrics["Policy/mean_std"] < 0.5 and np.isfinite(metrics["Loss/kl"])


def test_a_clamped_spread_stays_within_its_limits_and_comes_back():
    clamped = lambda x: actions.clamped(x, 0.5, 2.0)  # noqa: E731
    np.testing.assert_array_equal(clamped(jnp.array([0.1, 1.0, 9.0])), [0.5, 1.0, 2.0])
    slope = jax.grad(lambda x, sign: sign * clamped(x))
    # a gradient that is followed downhill: beyond the upper limit only what leads down passes
    assert [float(slope(x, s)) for x in (9.0, 0.1, 1.0) for s in (1.0, -1.0)] == [1, 0, 0, -1, 1, -1]
    actor = {"layers": [{"w": jnp.zeros((1, 2)), "b": jnp.zeros(2)}]}
    form = networks.Form(std_range=(0.5, 2.0))
    for more in ({"std": jnp.array([0.1, 9.0])}, {"log_std": jnp.log(jnp.array([0.1, 9.0]))}):
        spread = networks.gaussian(actor | more, jnp.zeros((1, 1)), form)[1]
        np.testing.assert_allclose(jnp.exp(spread), [0.5, 2.0], rtol=1e-6)
    dependent = {"layers": [{"w": jnp.zeros((1, 4)), "b": jnp.array([0, 0, 3.0, -3.0])}]}
    np.testing.assert_allclose(
        jnp.exp(networks.gaussian(dependent, jnp.zeros((1, 1)), form)[1]), [[2.0, 0.5]], rtol=1e-6
    )


def test_a_spread_that_is_learnt_itself_begins_at_init_std():
    params = networks.init(jax.random.PRNGKey(0), networks.Sizes(3, 3, 2), change(std_type="scalar", init_std=0.7))
    assert "log_std" not in params["actor"]
    np.testing.assert_allclose(params["actor"]["std"], 0.7)
    np.testing.assert_allclose(
        networks.gaussian(params["actor"], jnp.zeros((1, 3)), jnp.tanh)[1], np.log(0.7), rtol=1e-6
    )
    slope = jax.grad(lambda a: networks.gaussian(a, jnp.zeros((1, 3)), jnp.tanh)[1].sum())(params["actor"])["std"]
    np.testing.assert_allclose(slope, 1 / 0.7, rtol=1e-6)


@pytest.mark.parametrize("cell", ["gru", "lstm"])
def test_two_recurrent_layers_are_one_after_the_other(cell):
    """By hand: each layer's own step function on the outputs of the one before."""
    actor = recurrent.stacked(jax.random.PRNGKey(0), 3, 4, cell, 2)
    assert set(actor) == {cell, f"{cell}_1"}
    numbers, step = {"gru": 4, "lstm": 8}[cell], {"gru": recurrent.gru, "lstm": recurrent.lstm}[cell]
    assert recurrent.memory_size(actor) == 2 * numbers
    low, high, memory = jnp.zeros((2, numbers)), jnp.zeros((2, numbers)), jnp.zeros((2, 2 * numbers))
    xs, seen = jax.random.normal(jax.random.PRNGKey(1), (4, 2, 3)), []
    for x in xs:
        low = step(actor[cell], low, x)
        high = step(actor[f"{cell}_1"], high, low[:, :4])
        memory = recurrent.memories(actor, recurrent.Remembered(x, memory))
        np.testing.assert_allclose(memory, jnp.concatenate([low, high], -1), atol=1e-6)
        seen.append(high[:, :4])
    steps = recurrent.Remembered(xs, jnp.zeros((4, 2, 2 * numbers)))
    whole = jax.tree.map(lambda x: x.swapaxes(0, 1), recurrent.sequences(steps, jnp.zeros((4, 2))))
    np.testing.assert_allclose(recurrent.features(actor, whole), jnp.stack(seen, 1), atol=1e-6)


def test_one_recurrent_layer_is_as_it_was():
    one = networks.init(jax.random.PRNGKey(0), networks.Sizes(3, 3, 1), change(memory=4))["actor"]
    alone = recurrent.init(branch(jax.random.split(jax.random.PRNGKey(0))[0], 1), 3, 4)
    assert set(one) == {"layers", "log_std", "gru"}
    jax.tree.map(np.testing.assert_array_equal, one["gru"], alone)


def test_gradients_flow_back_so_many_steps_and_no_further():
    """d output_t / d x_s is not 0 exactly where s and t lie in the same piece and s comes first."""
    actor = {"gru": recurrent.init(jax.random.PRNGKey(0), 1, 3)}
    memory = jax.random.normal(jax.random.PRNGKey(1), (6, 1, 3))

    def outputs(x):
        cut = recurrent.sequences(recurrent.Remembered(x, memory), jnp.zeros((6, 1)), 2)
        return recurrent.features(actor, jax.tree.map(lambda leaf: leaf.swapaxes(0, 1), cut))[0].sum(-1)

    flows = np.asarray(jax.jacobian(outputs)(jnp.ones((6, 1, 1))))[:, :, 0, 0] != 0
    t, s = np.indices((6, 6))
    np.testing.assert_array_equal(flows, (s <= t) & (s // 2 == t // 2))


@pytest.mark.slow
@pytest.mark.ci
def test_a_student_with_a_memory_imitates():
    config = change(memory=8, gradient_length=4, num_epochs=2, learning_rate=3e-3, init_std=0.3, schedule="fixed")
    env = recurrent.remembering(probes.Walk(), config.memory_size)
    teacher = linear([-0.4], 0.1)
    state, metrics = rl.run(env, config, rl.init(env, config, jax.random.PRNGKey(0)), teacher=teacher, iterations=60)
    assert metrics["Loss/behavior"] < 0.02
    obs = {"policy": jnp.array([[0.7]]), "memory": jnp.zeros((1, 8))}
    assert rl.policy_of(state).act(None, obs)[0, 0] == pytest.approx(-0.18, abs=0.12)
    assert set(metrics) - {"Perf/total_fps", "Perf/iteration_time"} == set(distil.TAGS)


class Parts(probes.Walk):
    """A walk whose reward is the sum of two parts, and that shows a group of its own."""

    observation_size = {"policy": (1,), "secret": (2,)}

    def reset(self, key, theta=None):
        return self._told(super().reset(key, theta), jnp.zeros(()))

    def step(self, state, action):
        own = {"policy": state.obs["policy"]}
        return self._told(super().step(state.replace(obs=own), action), action[0])

    def _told(self, state: State, action) -> State:
        secret = {"secret": jnp.stack([state.reward, 7 * jnp.ones(())])}
        metrics = {"reward_move": state.reward, "reward_effort": -0.5 * action**2, "speed": action}
        info = {**state.info, "final_observation": {**state.info["final_observation"], **secret}}
        reward = state.reward - 0.5 * action**2
        return state.replace(reward=reward, metrics=metrics, obs={**state.obs, **secret}, info=info)


def test_parts_of_the_reward_are_logged_and_add_up():
    from bayessim_mjx.rl import ppo, worlds

    state = rl.init(Parts(), CONFIG, jax.random.PRNGKey(0))
    _, data = jax.jit(lambda s: worlds.gather(Learner(Parts(), CONFIG, ()), s, None, jax.random.PRNGKey(1)))(state)
    parts = [data["metrics"]["reward_move"], data["metrics"]["reward_effort"]]
    np.testing.assert_allclose(sum(parts), data["reward"], rtol=1e-5)
    _, metrics = ppo.make_update(Parts(), CONFIG)(state)
    assert {tag for tag in metrics if tag.startswith("Reward/")} == {"Reward/move", "Reward/effort"}
    assert {tag for tag in metrics if tag.startswith("Metric/")} == {"Metric/speed"}


def test_each_network_sees_the_groups_that_it_is_given():
    env = groups.for_policy(Parts(), ("policy", "secret"))
    assert env.observation_size["policy"] == (3,) and env.observation_names[-2:] == ("secret_0", "secret_1")
    state = env.reset(jax.random.PRNGKey(0))
    for action in (0.3, -0.2):
        plain = state.obs["_policy"]
        state = env.step(state, jnp.array([action]))
        expected = jnp.concatenate([state.obs["_policy"], state.obs["secret"]])
        np.testing.assert_array_equal(state.obs["policy"], expected)
        assert state.obs["_policy"] != plain and state.obs["secret"][1] == 7
    config = change(actor_groups=("policy", "secret"), critic_groups=("secret",))
    trained, _ = rl.run(env, config, rl.init(env, config, jax.random.PRNGKey(0)), iterations=1)
    assert trained.params["actor"]["layers"][0]["w"].shape == (3, 8)
    assert trained.params["critic"]["layers"][0]["w"].shape == (2, 8)
    with pytest.raises(UserError, match="ppo.actor_groups = .*are train and play"):
        rl.init(Parts(), config, jax.random.PRNGKey(0))
    with pytest.raises(UserError, match=r"ppo.critic_groups = \['secrt'\]: no group 'secrt'; there are policy, secret"):
        rl.init(Parts(), change(critic_groups=("secrt",)), jax.random.PRNGKey(0))


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"std_range": (1.0,)}, r"ppo.std_range = \[1.0\]: expected \[least, greatest\]"),
        ({"std_range": (0.1, 0.5)}, "ppo.init_std = 1.0 lies outside ppo.std_range"),
        ({"std_type": "scalar", "state_dependent_std": True}, "ppo.std_type = 'scalar'"),
        ({"distribution": "beta", "action_bound": "tanh"}, "ppo.action_bound = 'tanh': not with ppo.distribution=beta"),
        ({"distribution": "beta", "std_range": (0.1, 2.0)}, "ppo.std_range = .*not with ppo.distribution=beta"),
        ({"memory_layers": 2}, "ppo.memory_layers = 2: there is no recurrent layer"),
        ({"gradient_length": 2}, "ppo.gradient_length = 2: there is no recurrent layer"),
        ({"activation": "maxout"}, "ppo.activation = 'maxout'.*lrelu, mish"),
        ({"critic_groups": ("a",), "symmetry": {"use_data_augmentation": True}}, "ppo.critic_groups.*mirror maps"),
    ],
)
def test_what_does_not_go_together_is_refused(settings, words):
    with pytest.raises(UserError, match=words):
        change(**settings)
