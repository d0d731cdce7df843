"""Gymnasium's boxes of observations and actions."""

import gymnasium
import jax
import numpy as np

from bayessim_mjx.env import Env


def boxes(env: Env, group: str = "policy") -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """(observations of `group`, actions in [-1, 1]) of one world.

    Observations are float32 without bounds; those that the task gives as bytes (a picture `[H, W, C]`) are uint8 from 0
    to 255, by which other libraries know a picture.
    """
    shape, box = env.observation_size[group], gymnasium.spaces.Box
    picture = len(shape) > 1 and _kind(env, group) == np.uint8
    seen = box(0, 255, shape, np.uint8) if picture else box(-np.inf, np.inf, shape, np.float32)
    return seen, box(-1.0, 1.0, (env.action_size,), np.float32)


def _kind(env: Env, group: str) -> np.dtype:
    return jax.eval_shape(env.reset, jax.random.PRNGKey(0)).obs[group].dtype
