"""Students of a teacher that is known: what they imitate, what they cannot know, and that they can go on with PPO."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.errors import UserError
from bayessim_mjx.rl import catalogue, distil, normalise, privileged, worlds
from bayessim_mjx.rl.networks import Policy
from tests.rl import probes
from tests.rl.test_privileged import DOMAIN, Luck

CONFIG = PPOConfig(
    num_envs=32, num_steps=8, num_epochs=2, num_minibatches=4, learning_rate=3e-3, hidden_actor=(16,),
    hidden_critic=(4,), init_std=0.3, max_iterations=60, log_interval=60,
)  # fmt: skip
WALK = probes.Walk()


def linear(weights, bias=0.0):
    """A policy whose action is weights . observation + bias, clipped to +- 1."""
    layers = [{"w": jnp.asarray(weights, jnp.float32)[:, None], "b": jnp.array([bias])}]
    return Policy({"layers": layers, "log_std": jnp.zeros(1)}, normalise.init(len(weights)), normalize=False)


def student(env, teacher, domain=None):
    return rl.run(env, CONFIG, rl.init(env, CONFIG, jax.random.PRNGKey(0), domain), domain, teacher=teacher)


def test_a_student_learns_its_teachers_actions_where_it_goes_itself():
    teacher = linear([-0.4], 0.1)
    state, metrics = student(WALK, teacher)
    assert metrics["Loss/behavior"] < 5e-3
    obs = jnp.linspace(-1.5, 1.5, 7)[:, None]
    np.testing.assert_allclose(rl.policy_of(state).act(None, obs), teacher.act(None, obs), atol=0.12)
    assert (int(state.iteration), metrics["env_steps"]) == (60, 60 * 32 * 8)
    assert set(metrics) - {"Perf/total_fps", "Perf/iteration_time"} == set(distil.TAGS)


def test_what_the_student_does_not_see_it_averages():
    """The teacher's action is half of theta in [-1, 1]: the student's squared error stays its variance, 1 / 12."""
    env = privileged.for_teacher(Luck())
    assert env.observation_size == {"policy": (1,), "teacher": (2,)}
    state, metrics = student(env, linear([0.0, 0.5], 0.25), DOMAIN)
    assert rl.policy_of(state).act(None, jnp.zeros(1))[0] == pytest.approx(0.25, abs=0.06)
    assert metrics["Loss/behavior"] == pytest.approx(1 / 12, rel=0.1)


def test_a_student_learns_with_the_statistics_that_it_will_act_with(monkeypatch):
    """Of the first update, whose observations are far from the statistics that it begins with."""
    env, batches = probes.Clock(), []

    def learnt(key, params, opt_state, rate, batch, *_):
        batches.append(batch)
        return params, opt_state, rate, {"Loss/behavior": jnp.zeros(1)}

    monkeypatch.setattr(distil.losses, "descend", learnt)
    state, teacher = rl.init(env, CONFIG, jax.random.PRNGKey(0)), linear([0.2], 0.1)
    after, _ = distil.update(env, CONFIG, state, None, teacher)
    _, data = worlds.gather(catalogue.learner(env, CONFIG), state, None, jax.random.split(state.key, 3)[1])
    observation, (seen, target) = data["observation"]["policy"], batches[0]
    will_see = normalise.normalise(after.normalizer["policy"], observation)
    np.testing.assert_allclose(seen, will_see.reshape(seen.shape), atol=1e-6)
    np.testing.assert_allclose(target, teacher.act(None, observation).reshape(target.shape), atol=1e-6)
    assert float(jnp.abs(after.normalizer["policy"].mean).max()) > 0.1  # or they could not have told


def test_the_loss_by_hand():
    """Action 2 and target -0.5, error 2.5: squared 6.25, Huber 2.5 - 1/2; squashed 0.964028."""
    params = {"actor": linear([1.0], 1.0).actor}
    value = lambda **c: distil.loss(params, jnp.ones((1, 1)), jnp.full((1, 1), -0.5), dataclasses.replace(CONFIG, **c))  # noqa: E731
    assert value() == pytest.approx(6.25)
    assert value(distil_loss="huber") == pytest.approx(2.0)
    assert value(action_bound="tanh") == pytest.approx((np.tanh(2) + 0.5) ** 2, rel=1e-5)


def test_teacher_and_critic_stay_and_ppo_goes_on_from_the_student():
    env, teacher = WALK, linear([-0.4], 0.1)
    before = jax.tree.map(np.array, teacher)
    start = rl.init(env, CONFIG, jax.random.PRNGKey(0))
    state, _ = rl.run(env, CONFIG, start, iterations=2, teacher=teacher)
    jax.tree.map(np.testing.assert_array_equal, before, jax.tree.map(np.array, teacher))
    jax.tree.map(np.testing.assert_array_equal, state.params["critic"], start.params["critic"])
    assert state.normalizer["policy"].count == 2 * 32 * 8
    further, metrics = rl.run(env, CONFIG, state, iterations=1)
    assert int(further.iteration) == 3 and np.isfinite(metrics["Loss/value"])


@pytest.mark.slow
@pytest.mark.ci
def test_a_policy_that_sees_theta_is_a_teacher():
    """Reward -(a - theta / 8)^2 can only be had by who sees theta."""

    class Tuned(Luck):
        def step(self, state, action):
            return super().step(state, action).replace(reward=-((action[0] - state.pipeline_state[0] / 8) ** 2))

    env = privileged.for_policy(Tuned())
    config = dataclasses.replace(CONFIG, policy_theta=True, gamma=0.9, schedule="fixed")
    policy, _ = rl.train(env, config, jax.random.PRNGKey(0), DOMAIN)
    actions = policy.act(None, jnp.array([[0.0, -1.0], [0.0, 1.0]]))[:, 0]
    np.testing.assert_allclose(actions, [0.25, 0.75], atol=0.1)
    with pytest.raises(UserError, match="ppo.policy_theta = True trains a teacher"):
        rl.init(Tuned(), config, jax.random.PRNGKey(0))


def test_what_cannot_work_is_refused():
    with pytest.raises(UserError, match="ppo.teacher = .*: a student has no use for ppo.rnd"):
        PPOConfig(teacher="somewhere", rnd={"weight": 1.0})
    with pytest.raises(UserError, match="ppo.teacher: there are no parameters"):
        privileged.for_teacher(probes.Walk())
