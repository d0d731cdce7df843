"""Worlds that restart by themselves, on a counter whose episodes can be computed by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx.distributions import Distribution
from bayessim_mjx.errors import UserError
from bayessim_mjx.wrappers.worlds import Worlds, domain_of, worlds
from tests.wrappers.toys import Counter

ENV = Counter()  # one object: its programs are compiled once


def played(theta, steps, action=0.0):
    batch_of = Worlds(ENV, None, 3, seed=1)
    batch_of.set_theta(theta)
    first = batch_of.reset()
    return first, [batch_of.step(jnp.full((3, 1), action)) for _ in range(steps)], batch_of


def test_lives_time_limits_returns_and_last_observations():
    first, batches, last = played([[2.0], [5.0], [9.0]], 5, action=0.5)
    np.testing.assert_array_equal(first["policy"][:, 0], 0)
    terminated = np.array([b.terminated for b in batches])
    truncated = np.array([b.truncated for b in batches])
    np.testing.assert_array_equal(terminated, [[0, 0, 0], [1, 0, 0], [0, 0, 0], [1, 0, 0], [0, 1, 0]])
    np.testing.assert_array_equal(truncated, [[0, 0, 0]] * 4 + [[0, 0, 1]])  # a death on the last step is no time-out
    np.testing.assert_array_equal(batches[1].lengths, [2, 2, 2])
    np.testing.assert_allclose(batches[4].returns, [1.5, 7.5, 7.5])  # 1 + the action, since the episode's beginning
    np.testing.assert_array_equal(batches[1].final["policy"][:, 0], [2, 2, 2])  # what the step led to
    np.testing.assert_array_equal(batches[1].obs["policy"][:, 0], [0, 2, 2])  # and where the worlds go on
    np.testing.assert_array_equal(batches[4].final["critic"][:, 0], [1, 5, 5])
    np.testing.assert_array_equal(batches[1].metrics["age"], [2, 2, 2])
    np.testing.assert_array_equal(last.lengths, [1, 0, 0])


def test_no_episode_begins_as_an_earlier_one():
    _, batches, _ = played(1.0 * np.ones(1), 12)  # all worlds end in every step
    starts = np.array([b.obs["policy"][:, 1] for b in batches])
    assert len(np.unique(starts)) == starts.size


def test_episodes_in_store_are_drawn_anew_when_a_world_needs_its_second_and_not_sooner():
    """Three worlds whose episodes of five steps end one after the other: a store lasts for five steps."""
    some, stores = Worlds(ENV, None, 3, seed=1), []
    some.set_lengths(jnp.array([4, 3, 2]))
    for _ in range(16):
        some.step(jnp.zeros((3, 1)))
        stores.append(tuple(np.asarray(some._running.store[0].obs["policy"][:, 1])))
    drawn = [i + 1 for i in range(1, 16) if stores[i] != stores[i - 1]]
    assert drawn == [6, 11, 16] and len(set(stores)) == 4


def test_theta_is_drawn_anew_in_each_episode():
    many = Worlds(ENV, Distribution.prior(ENV.space, 1), 64, seed=0)
    many.reset()
    seen = [np.asarray(many.theta)[:, 0]]
    for _ in range(10):
        before = np.asarray(many.theta)[:, 0]
        batch = many.step(jnp.zeros((64, 1)))
        after, ended = np.asarray(batch.theta)[:, 0], np.asarray(batch.terminated | batch.truncated)
        np.testing.assert_array_equal(after[~ended], before[~ended])
        assert (after[ended] != before[ended]).all()
        np.testing.assert_array_equal(after, batch.obs["policy"][:, 2])  # as the world itself says
        seen.append(after[ended])
    drawn = np.concatenate(seen)
    assert abs(drawn.mean() - 5.0) < 4 * (8 / 12**0.5) / len(drawn) ** 0.5  # uniform from 1 to 9


def test_theta_that_is_given_holds_from_the_next_episode_on():
    _, _, some = played([9.0], 3)
    some.set_theta([2.0])
    lives = [np.asarray(some.step(jnp.zeros((3, 1))).theta)[:, 0] for _ in range(2)]
    np.testing.assert_array_equal(lives, [[9, 9, 9], [2, 2, 2]])  # the fifth step ended what ran


def test_time_limits_can_be_spread_out():
    some = Worlds(ENV, None, 3)
    some.set_lengths(jnp.array([0, 2, 4]))
    ends = [np.asarray(some.step(jnp.zeros((3, 1))).truncated) for _ in range(5)]
    np.testing.assert_array_equal(np.argmax(ends, 0), [4, 2, 0])


def test_the_same_seed_gives_the_same_worlds():
    one, two, three = (Worlds(ENV, None, 2, seed).reset()["policy"] for seed in (3, 3, 4))
    np.testing.assert_array_equal(one, two)
    assert (np.asarray(one) != np.asarray(three)).any()


@pytest.mark.parametrize(
    ("act", "words"),
    [
        (lambda w: w.step(jnp.zeros((2, 1))), "step before reset"),
        (lambda w: (w.reset(), w.step(jnp.zeros((3, 1)))), r"actions have shape \[3, 1\]; expected \[2, 1\]"),
        (lambda w: w.set_theta([1.0, 2.0, 3.0]), r"theta has shape \[3\]; expected \[1\] or \[2, 1\]"),
        (lambda w: Worlds(ENV, None, 0), "num_envs = 0"),
        (lambda w: worlds(ENV, episodeLength=3), "episodeLength: settings go with a task's name"),
        (lambda w: worlds("Pendulun"), "Did you mean Pendulum"),
        (lambda w: domain_of(ENV, "posteriour"), "domain = 'posteriour': allowed are nominal, prior"),
    ],
)
def test_what_is_wrong_is_said(act, words):
    with pytest.raises(UserError, match=words):
        act(Worlds(ENV, None, 2))


def test_a_folder_that_is_no_run_is_refused(tmp_path):
    with pytest.raises(UserError, match="neither a run nor a checkpoint"):
        worlds(tmp_path)


def test_a_saved_distribution_is_a_domain(tmp_path):
    narrow = Distribution.gaussian(ENV.space, jnp.array([3.0]), jnp.array([0.01]))
    path = narrow.save(tmp_path / "posterior.npz")
    theta = np.asarray(Worlds(ENV, domain_of(ENV, path), 8).reset()["policy"])[:, 2]
    np.testing.assert_allclose(theta, 3.0, atol=0.1)
    assert domain_of(ENV, "nominal") is None and domain_of(ENV, None) is None


def test_a_run_names_its_task_its_settings_and_its_posterior(tmp_path):
    """A checkpoint as `main` writes it: the domain beside a policy."""
    from bayessim_mjx import runs
    from bayessim_mjx.config import load
    from bayessim_mjx.registry import make

    config = load("Pendulum", overrides=["env.episodeLength=7"])
    env = make("Pendulum", config=config)
    low, high = np.asarray(env.space.low), np.asarray(env.space.high)
    mean, sd = low + 0.25 * (high - low), 1e-3 * (high - low)
    domain = Distribution.gaussian(env.space, mean, sd, config.bayessim.components)
    run = runs.Run.create(tmp_path, "Pendulum", "", config, ["test"])
    run.save(0, {"state": {"domain": domain}})
    found = worlds(run.path, 5)
    assert found.env.episode_length == 7 and found.num_envs == 5
    np.testing.assert_allclose(found.domain.mean(), domain.mean(), rtol=1e-5)
    assert worlds(run.path, 5, domain="nominal").domain is None
    np.testing.assert_allclose(worlds("Pendulum", 5, domain=run.path).domain.mean(), domain.mean(), rtol=1e-5)
    key = jax.random.PRNGKey(0)
    np.testing.assert_allclose(found.domain.sample(key, 9).mean(0), domain.mean(), atol=5e-3 * (high - low).max())


def test_auto_goes_by_the_number_of_worlds_that_step_together(monkeypatch):
    """Whoever makes them: `auto` takes what was faster for so many, and a run's own number counts no more."""
    from bayessim_mjx.env import task
    from bayessim_mjx.wrappers import brax, gymnasium

    seen = []
    chosen = task.choose("Pendulum", 1)
    monkeypatch.setattr(task, "choose", lambda name, number, effects: seen.append(number) or chosen)
    worlds("Pendulum", 4096, impl="auto")
    gymnasium.make_vec("Pendulum", 2048, impl="auto")
    gymnasium.make("Pendulum", impl="auto")
    brax.ours("Pendulum", impl="auto")
    assert seen == [4096, 2048, 1, None]
