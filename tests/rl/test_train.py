"""The whole update: reproducible, resumable, compiled once; normaliser and terminal observations in the right place."""

import dataclasses
import importlib

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import memory, rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import networks, normalise, ppo, transitions, worlds
from bayessim_mjx.rl.catalogue import learner
from bayessim_mjx.rl.train import time as clock
from tests.rl import probes

# the package has a function of this name
training = importlib.import_module("bayessim_mjx.rl.train")


CONFIG = PPOConfig(
    num_envs=16, num_steps=8, num_epochs=2, num_minibatches=2, hidden_actor=(8,), hidden_critic=(8,), log_interval=2
)


TAGS = {
    "Loss/value", "Loss/surrogate", "Loss/entropy", "Loss/learning_rate", "Loss/kl", "Loss/clip_fraction",
    "Loss/explained_variance", "Policy/mean_std", "Policy/grad_norm", "Train/mean_reward", "Train/mean_episode_length",
    "env_steps",
}  # fmt: skip


WALK = probes.Walk()


def key(seed):
    return jax.random.PRNGKey(seed)


def assert_bitwise(a, b):
    assert jax.tree.structure(a) == jax.tree.structure(b)
    for (path, x), y in zip(jax.tree_util.tree_leaves_with_path(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_array_equal(x, y, err_msg=jax.tree_util.keystr(path))


def test_seeds_reproduce_bit_for_bit_and_differ_from_each_other():
    a, b, c = (rl.train(WALK, CONFIG, key(seed), iterations=2)[0] for seed in (1, 1, 2))
    assert_bitwise(a, b)
    assert any((x != y).any() for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(c), strict=True))


def test_in_half_precision_the_policy_that_acts_is_the_one_that_learns():
    """Else ratios of probabilities would not begin at 1, nor its KL at 0; with the same statistics, one minibatch."""
    config = dataclasses.replace(
        CONFIG, precision="bfloat16", num_epochs=1, num_minibatches=1, normalize_observations=False, schedule="fixed"
    )
    state = rl.init(WALK, config, key(0))
    moved = state.replace(params=jax.tree.map(lambda x: x + 0.3 * jax.random.normal(key(1), x.shape), state.params))
    after, metrics = rl.run(WALK, config, moved, iterations=1)
    assert abs(metrics["Loss/kl"]) < 1e-6 and metrics["Loss/clip_fraction"] == 0
    assert {x.dtype for x in jax.tree.leaves(after.params)} == {jnp.dtype("float32")}
    whole = dataclasses.replace(config, precision="float32")
    _, others = rl.run(WALK, whole, dataclasses.replace(moved, config=whole), iterations=1)
    assert 1e-6 < abs(others["Loss/value"] / metrics["Loss/value"] - 1) < 0.02


def test_training_in_two_halves_is_training_at_once():
    """The state goes through numpy in between, as through a checkpoint."""
    start = rl.init(WALK, CONFIG, key(0))
    whole, _ = rl.run(WALK, CONFIG, start, iterations=6)
    half, _ = rl.run(WALK, CONFIG, start, iterations=3)
    saved = jax.tree.map(np.array, jax.device_get(half))
    resumed, _ = rl.run(WALK, CONFIG, saved, iterations=3)
    assert_bitwise(whole, resumed)
    assert (int(whole.iteration), int(whole.env_steps)) == (6, 6 * 16 * 8)
    assert (half.key != start.key).any() and (whole.key != half.key).any()
    policy, _ = rl.train(WALK, CONFIG, key(9), state=half, iterations=3)
    assert_bitwise(policy, rl.policy_of(whole))


def test_one_program_for_every_seed_domain_and_number_of_iterations():
    env = probes.Clock()
    domains = [probes.Domain(jnp.array([low]), jnp.array([low + 1])) for low in (0.0, 5.0)]
    rl.train(env, CONFIG, key(0), domains[0], iterations=3)
    rl.train(env, CONFIG, key(1), domains[1], iterations=5)
    assert training._make_chunk(env, CONFIG, False)._cache_size() == 1
    update = rl.make_update(env, CONFIG)
    assert update is rl.make_update(env, dataclasses.replace(CONFIG))
    state = rl.init(env, CONFIG, key(0), domains[0])
    for domain in domains:
        state, _ = update(state, domain)
    assert update._cache_size() == 1
    assert env.traces == 1  # all these programs have the physics written out once


def test_worlds_that_do_not_fit_are_refused_before_they_are_made(monkeypatch):
    """The state of a world (and of its reset) and 16 steps of it, counted by hand."""
    world = sum(x.nbytes for x in jax.tree.leaves(jax.jit(WALK.reset)(key(0), jnp.asarray(WALK.space.nominal))))
    (size,) = WALK.observation_size["policy"]
    step = 2 * size + 3 * WALK.action_size + 8 + max(CONFIG.hidden_critic)
    needed = CONFIG.num_envs * (2 * world + CONFIG.num_steps * 4 * step)
    monkeypatch.setattr(memory, "installed", lambda: needed - 1)
    with pytest.raises(UserError, match=rf"ppo\.num_envs = {CONFIG.num_envs} .*needs at least"):
        rl.init(WALK, CONFIG, key(0))
    monkeypatch.setattr(memory, "installed", lambda: needed)
    ppo.check(WALK, CONFIG)


def test_metrics_carry_exactly_the_known_tags():
    seen = []
    state = rl.init(WALK, CONFIG, key(0))
    _, metrics = rl.make_update(WALK, CONFIG)(state, None)
    assert set(metrics) == TAGS
    rl.run(
        WALK, CONFIG, state, iterations=5, progress=lambda metrics, state: seen.append((metrics, int(state.iteration)))
    )
    assert [iteration for _, iteration in seen] == [2, 4, 5]
    assert all(set(m) - {"Perf/total_fps", "Perf/iteration_time"} == TAGS for m, _ in seen)
    assert [m["env_steps"] for m, _ in seen] == [256, 512, 640]
    assert all(np.isfinite(m["Loss/value"]) for m, _ in seen)


def test_loss_figures_are_averaged_over_the_log_interval():
    state, update, values = rl.init(WALK, CONFIG, key(0)), rl.make_update(WALK, CONFIG), []
    _, averaged = rl.run(WALK, CONFIG, state, iterations=2)
    for _ in range(2):
        state, metrics = update(state, None)
        values.append(metrics)
    assert averaged["Loss/value"] == pytest.approx(np.mean([m["Loss/value"] for m in values]), rel=1e-4)
    assert averaged["Loss/learning_rate"] == pytest.approx(float(values[-1]["Loss/learning_rate"]))


def test_speed_is_environment_steps_per_second_of_the_interval(monkeypatch):
    """A clock that goes on by 4 s at each look: two looks an interval."""
    looks = iter(range(0, 100, 4))
    monkeypatch.setattr(clock, "perf_counter", lambda: next(looks))
    _, metrics = rl.run(WALK, CONFIG, rl.init(WALK, CONFIG, key(0)), iterations=2)
    assert (metrics["Perf/total_fps"], metrics["Perf/iteration_time"]) == (2 * 16 * 8 / 4, 2.0)


def test_the_callers_state_survives():
    state = rl.init(WALK, CONFIG, key(0))
    rl.run(WALK, CONFIG, state, iterations=1)
    assert np.isfinite(np.asarray(state.params["actor"]["log_std"])).all()


def test_statistics_are_pooled_before_learning():
    """One minibatch per iteration: nothing is learnt before it, and its KL is of learning alone."""
    config = dataclasses.replace(CONFIG, num_epochs=1, num_minibatches=1)
    state, update = rl.init(WALK, config, key(0)), rl.make_update(WALK, config)
    seen = []
    for i in range(3):
        assert state.normalizer["policy"].count == i * 16 * 8
        _, data = jax.jit(lambda s: worlds.gather(learner(WALK, config), s, None, jax.random.split(s.key, 3)[1]))(state)
        seen.append(np.asarray(data["observation"]["policy"]).reshape(-1))
        state, metrics = update(state, None)
        assert metrics["Loss/kl"] < 1e-9
        np.testing.assert_allclose(state.normalizer["policy"].mean[0], np.concatenate(seen).mean(), atol=1e-4)
        np.testing.assert_allclose(state.normalizer["policy"].var[0], np.concatenate(seen).var(), rtol=1e-3)
    assert_bitwise(rl.policy_of(state).normalizer, state.normalizer["policy"])


def test_without_normalisation_statistics_stay_untouched():
    config = dataclasses.replace(CONFIG, normalize_observations=False)
    state, _ = rl.make_update(WALK, config)(rl.init(WALK, config, key(0)), None)
    assert state.normalizer["policy"].count == 0


def test_the_critic_has_its_own_observations_and_statistics():
    env = probes.Clock()
    state, _ = rl.make_update(env, CONFIG)(rl.init(env, CONFIG, key(0)), None)
    assert state.params["critic"]["layers"][0]["w"].shape == (2, 8)
    assert state.params["actor"]["layers"][0]["w"].shape == (1, 8)
    assert {g: m.mean.shape for g, m in state.normalizer.items()} == {"policy": (1,), "critic": (2,)}
    policy = rl.policy_of(state)
    obs = {"policy": jnp.ones(1), "critic": jnp.zeros(2)}
    np.testing.assert_array_equal(policy.act(None, obs), policy.act(None, {**obs, "critic": jnp.ones(2)}))


def test_a_policy_learns_with_the_statistics_that_it_will_act_with(monkeypatch):
    """Of the first update, too: and the probabilities of the actions stay those of the policy that acted."""
    env, batches = probes.Clock(), []
    config = dataclasses.replace(CONFIG, normalize_observations=True)
    state = rl.init(env, config, key(0))
    for _ in range(2):
        optimise = ppo.losses.optimise

        def spy(*args):
            batches.append(args[4])
            return optimise(*args)  # noqa: B023

        with monkeypatch.context() as patched:
            patched.setattr(ppo.losses, "optimise", spy)
            after, _ = ppo.update(env, config, state, None)
        _, data = worlds.gather(learner(env, config), state, None, jax.random.split(state.key, 3)[1])
        raw, batch = data["observation"], batches[-1]
        for group, seen in (("policy", batch.observation), ("critic", batch.critic_observation)):
            expected = normalise.normalise(after.normalizer[group], raw[group]).reshape(seen.shape)
            np.testing.assert_allclose(seen, expected, atol=1e-6)
        mean, log_std = rl.policy_of(state).distribution(raw)
        log_prob = networks.log_prob(mean.reshape(batch.mean.shape), log_std, batch.action)
        np.testing.assert_allclose(batch.log_prob, log_prob, atol=1e-5)
        state = after
    assert float(jnp.abs(after.normalizer["critic"].mean).max()) > 0.1  # or they could not have told


def test_advantages_bootstrap_from_the_true_last_observation():
    """Rows cut by the time limit: advantage = reward + gamma V(last observation, 4) - V(observation)."""
    env = probes.Clock()
    config = dataclasses.replace(CONFIG, gae_lambda=0.0, normalize_observations=False, reward_scale=2.0)
    state = rl.init(env, config, key(0))
    state = state.replace(env_states=jax.vmap(env.reset)(jax.random.split(key(1), 16), jnp.zeros((16, 1))))
    _, data = jax.jit(lambda s: worlds.gather(learner(env, config), s, None, s.key))(state)
    batch = transitions.batch(learner(env, config), state, data, state.normalizer)
    cut = np.asarray(data["truncated"]).reshape(-1) > 0
    assert cut.sum() == 32
    first = np.asarray(data["observation"]["critic"][:, :, 0]).reshape(-1)
    value = lambda time: networks.value(state.params, jnp.stack([time, 0 * time], -1), jax.nn.elu)  # noqa: E731
    reward = 2 * np.clip(batch.action[:, 0], -1, 1)
    expected = reward + 0.99 * value(jnp.asarray(first + 1)) - value(jnp.asarray(first))
    np.testing.assert_allclose(batch.advantage, expected, atol=1e-5)
    np.testing.assert_allclose(batch.returns, batch.advantage + batch.value, atol=1e-6)
    assert (first[cut] == 3).all() and (first[~cut] < 3).all()


def test_actions_are_clipped_for_the_environment_but_not_for_the_learner():
    env = probes.ActionReward()
    config = dataclasses.replace(CONFIG, init_std=3.0, action_clip=0.5)
    state = rl.init(env, config, key(0))
    _, data = worlds.gather(learner(env, config), state, None, key(1))
    action = np.asarray(data["extras"]["action"])[..., 0]
    assert np.abs(action).max() > 2
    np.testing.assert_allclose(data["reward"], -((np.clip(action, -0.5, 0.5) - 0.5) ** 2), atol=1e-6)


def test_first_episodes_do_not_all_end_together():
    state = rl.init(probes.Walk(), CONFIG, key(0))
    steps = np.asarray(state.env_states.info["steps"])
    assert len(set(steps.tolist())) > 5 and steps.min() >= 0 and steps.max() < 20
    np.testing.assert_array_equal(state.episodes.partial, steps > 0)


def test_theta_comes_from_the_domain():
    class Felt(probes.Clock):
        def step(self, state, action):
            return super().step(state, action).replace(reward=state.pipeline_state[0])

    env, domain = Felt(), probes.Domain(jnp.array([2.0]), jnp.array([3.0]))
    state = rl.init(env, CONFIG, key(0), domain)
    thetas = np.asarray(state.env_states.pipeline_state)
    assert ((thetas >= 2) & (thetas <= 3)).all() and thetas.std() > 0.1
    after, _ = rl.make_update(env, CONFIG)(state, probes.Domain(jnp.array([7.0]), jnp.array([8.0])))
    assert (np.asarray(after.env_states.pipeline_state) >= 7).all()  # 8 steps: every episode of at most 4 is a new one


def test_a_loss_that_is_not_finite_stops_the_run():
    with pytest.raises(FloatingPointError, match="after iteration 1"):
        rl.train(probes.Broken(), CONFIG, key(0), iterations=1)


def test_an_environment_without_the_group_policy_is_refused():
    class Odd(probes.Probe):
        observation_size = {"state": (1,)}

    with pytest.raises(ValueError, match=r"\['state'\].*'policy'"):
        rl.init(Odd(), CONFIG, key(0))


def test_speed_is_environment_steps_per_second(monkeypatch):
    """The clock stands half a second later whenever it is read: 2 iterations of 16 worlds of 8 steps in that time."""
    clock = iter(np.arange(0, 100, 0.5))
    monkeypatch.setattr("time.perf_counter", lambda: float(next(clock)))
    _, metrics = rl.run(WALK, CONFIG, rl.init(WALK, CONFIG, key(0)), iterations=2)
    assert (metrics["Perf/total_fps"], metrics["Perf/iteration_time"]) == (2 * 16 * 8 / 0.5, 0.25)


def test_a_start_compiles_the_program_of_the_run(monkeypatch, caplog):
    """Beside `init`, whose result it returns; the run then compiles nothing large."""
    monkeypatch.setattr(training, "cores", lambda: 2)
    env = probes.Walk()
    state = rl.start(env, CONFIG, key(0))
    with jax.log_compiles():
        rl.run(env, CONFIG, state, iterations=1)
    assert not [line for line in caplog.messages if "XLA compilation of jit(chunk)" in line]
    assert_bitwise(state, rl.init(env, CONFIG, key(0)))
