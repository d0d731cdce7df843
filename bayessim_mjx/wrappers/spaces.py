"""Gymnasium's boxes of observations and actions."""

import gymnasium
import numpy as np

from bayessim_mjx.env import Env


def boxes(env: Env, group: str = "policy") -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """(observations of `group`, without bounds; actions in [-1, 1]) of one world."""
    (size,) = env.observation_size[group]
    return (
        gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32),
        gymnasium.spaces.Box(-1.0, 1.0, (env.action_size,), np.float32),
    )
