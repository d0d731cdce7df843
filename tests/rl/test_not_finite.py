"""Numbers of a task that are not finite: 0 for the learner, counted by part, and told to the user."""

import importlib
import warnings
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
import pytest

from bayessim_mjx import rl
from bayessim_mjx.config import PPOConfig
from bayessim_mjx.env import Task
from bayessim_mjx.errors import UserError

training = importlib.import_module("bayessim_mjx.rl.train")
XML = """<mujoco model="slider"><option timestep="0.01"/><worldbody><body name="block">
<joint name="rail" type="slide" axis="1 0 0"/><geom size="0.1" mass="1"/></body></worldbody>
<actuator><motor name="push" joint="rail" ctrlrange="-5 5"/></actuator></mujoco>"""
CONFIG = PPOConfig(
    num_envs=8, num_steps=4, num_epochs=1, num_minibatches=1, hidden_actor=(4,), hidden_critic=(4,), log_interval=1
)
CLEAN = {"not_finite_reward": 0, "not_finite_observation_policy": 0, "not_finite_metric_height": 0}


class Slider(Task):
    """A block on a rail starts at 0 m with 1 m/s: after k control steps it is at k/50 m."""

    control_dt, default_episode_length, observation_names = 0.02, 50, ("position",)

    def spec(self) -> mujoco.MjSpec:
        return mujoco.MjSpec.from_string(XML)

    def initial(self, key: jax.Array) -> Any:
        return jnp.zeros(1), jnp.ones(1)

    def command(self, action: jax.Array) -> jax.Array:
        return 0 * action

    def observe(self, world: Any, data: Any, action: jax.Array) -> Any:
        return {"policy": world.qpos}

    def reward(self, before: Any, after: Any, data: Any, action: jax.Array) -> Any:
        return after.qpos[0], jnp.zeros((), bool), {"height": after.qpos[0]}


class FarReward(Slider):
    """Its reward is the root of a negative number beyond 5 cm, from the third step on."""

    def reward(self, before: Any, after: Any, data: Any, action: jax.Array) -> Any:
        return jnp.sqrt(0.05 - after.qpos[0]), jnp.zeros((), bool), {"height": jnp.log(-after.qpos[0])}


class Lost(Slider):
    """Its observation divides by 0 at reset alone."""

    def observe(self, world: Any, data: Any, action: jax.Array) -> Any:
        return {"policy": 1 / world.qpos}


def stepped(env: Task, steps: int) -> list:
    state, step, found = jax.jit(env.reset)(jax.random.PRNGKey(0)), jax.jit(env.step), []
    for _ in range(steps):
        state = step(state, jnp.zeros(1))
        found.append(state)
    return found


def counts(state: Any) -> dict[str, float]:
    return {name: float(x) for name, x in state.metrics.items() if name.startswith("not_finite_")}


def test_each_part_is_counted_where_it_is_no_number_and_pays_0():
    states = stepped(FarReward(), 4)
    assert [counts(s)["not_finite_reward"] for s in states] == [0, 0, 1, 1]
    assert [counts(s)["not_finite_metric_height"] for s in states] == [1] * 4
    assert all(counts(s)["not_finite_observation_policy"] == 0 for s in states)
    assert [float(s.reward) for s in states[2:]] == [0, 0] and all(s.metrics["height"] == 0 for s in states)
    assert [counts(s) for s in stepped(Slider(), 2)] == [CLEAN] * 2
    assert counts(jax.jit(Lost().reset)(jax.random.PRNGKey(0)))["not_finite_observation_policy"] == 1


def test_a_world_that_diverged_counts_nowhere():
    env = FarReward()
    state = jax.jit(env.reset_to)(np.zeros(1, np.float32), np.float32([1e6]))  # faster than `speed_limit`
    after = jax.jit(env.step)(state, jnp.zeros(1))
    assert after.done == 1 and not any(counts(after).values())


def test_training_refuses_a_task_that_is_no_number_as_it_begins():
    env = Lost()
    with pytest.raises(UserError, match=r"task Lost: .*observation group 'policy' in 100 % of the worlds, at reset"):
        training.not_finite.at_reset(env, rl.init(env, CONFIG, jax.random.PRNGKey(0)))
    with pytest.raises(UserError) as error:
        rl.train(FarReward(), CONFIG, jax.random.PRNGKey(0), iterations=1)
    text = str(error.value)
    assert text.startswith("task FarReward: not finite are the reward in ") and "the metric 'height' in 100 % " in text
    assert "the steps of the first 1 iteration" in text and "own_task.md" in text


def test_later_it_is_told_once_with_its_first_iteration_and_has_a_curve():
    env, seen = FarReward(), {}
    kept: list[dict] = []
    metrics = [{f"Train/{name}": 0.0 for name in CLEAN} for _ in range(3)]
    metrics[1]["Train/not_finite_reward"] = 0.25
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for i, row in enumerate(metrics):
            training.not_finite.watch(env, row, 10 * (i + 1), i == 0, seen)
            kept.append(row)
    (only,) = caught
    assert "FarReward: the reward is not finite in 25 % of the steps, first before iteration 20." in str(only.message)
    assert kept == [{}, {"Train/not_finite_reward": 0.25}, {"Train/not_finite_reward": 0.0}]
    assert seen == {"Train/not_finite_reward": 20}


def test_an_evaluation_warns_of_them():
    env = FarReward()
    policy = rl.policy_of(rl.init(env, CONFIG, jax.random.PRNGKey(0)))
    with pytest.warns(UserWarning, match=r"the reward is not finite in 100 % of the episodes") as caught:
        found = rl.evaluate(env, policy, jax.random.PRNGKey(1), jnp.zeros((2, 0)))
    assert set(found) == {"return", "length"} and len(caught) == 2  # and the metric
