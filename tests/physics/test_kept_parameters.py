"""Worlds that keep their parameters from episode to episode (`frequency` in `task.randomization_params`)."""

import jax
import jax.numpy as jnp
import numpy as np

from bayessim_mjx import registry
from bayessim_mjx.config import from_dict
from bayessim_mjx.distributions import Distribution
from bayessim_mjx.rollout.collection import next_episodes


def test_worlds_that_keep_their_parameters_derive_nothing_anew() -> None:
    """Inverse weights come of a factorised mass matrix: a reset makes one, an episode with the same theta none."""
    params = from_dict({"task_name": "Cartpole"}).to_dict()["task"]["randomization_params"]
    task = {"randomize": True, "randomization_params": {**params, "frequency": 9}}
    env = registry.make("Cartpole", config=from_dict({"task_name": "Cartpole", "task": task}))
    thetas = Distribution.prior(env.space, 1).sample(jax.random.PRNGKey(1), 8)
    ended, keys = jnp.arange(4) % 2 == 0, [jax.random.split(jax.random.PRNGKey(i), 4) for i in (2, 3)]
    reset = jax.jit(jax.vmap(env.reset))
    state, fresh = (reset(key, theta) for key, theta in zip(keys, (thetas[:4], thetas[4:]), strict=True))
    following = jax.jit(lambda state, fresh: next_episodes(env, ended, state, fresh))
    assert reset.lower(keys[0], thetas[:4]).compile().as_text().count("potrf")
    assert not following.lower(state, fresh).compile().as_text().count("potrf")
    found, derived = following(state, fresh).pipeline_state, reset(keys[1], thetas[:4]).pipeline_state
    assert len(derived.fields) > 3
    for name, values in derived.fields.items():
        np.testing.assert_array_equal(found.fields[name][ended], values[ended])
        np.testing.assert_array_equal(found.fields[name][~ended], fresh.pipeline_state.fields[name][~ended])
    np.testing.assert_array_equal(found.theta, jnp.where(ended[:, None], thetas[:4], thetas[4:]))
